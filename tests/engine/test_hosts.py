"""Hosts that are no Sersic profiles: what is told of them, how they are lensed, what is refused."""

from __future__ import annotations

import base64
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits

from engine import (
    Analysis,
    Deflector,
    Expansion,
    Grid,
    Host,
    HostShape,
    MadeGalaxy,
    Realization,
    SpecError,
    expand,
    read_host_image,
    realization_from_dict,
    run,
    simulate_realization,
)
from engine.catalogue import load_camera
from engine.comparison import estimate_beside
from engine.conventions import FloatArray, pixel_centres
from engine.figures import hosts_figure
from engine.host_files import host_image
from engine.lensing.lens_equation import solve_lens_equation
from engine.lensing.power_law import PowerLawLens, source_position
from engine.light.galaxy import (
    Component,
    Galaxy,
    brightness_at,
    flux_within,
    galaxy_of,
    half_light_ellipse,
    light_on_grid,
    render_light,
)
from engine.light.pixels import PixelLight, render_pixels
from engine.light.sersic import SersicProfile, flux_in_circle
from engine.result import Estimate, Quantity
from engine.simulation.host import host_light
from engine.simulation.made import made_components
from engine.simulation.scene import build_scene, check_deflector, power_law_lens, source_place
from engine.spec.deflector import MassMultipole, MassSatellite
from engine.spec.light import SersicLight
from tests.engine.conftest import cut

GALAXIES = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "galaxies" / "cosmos_f814w.fits"
LENS = PowerLawLens(1.2, 0.8, 0.4, 2.0)
KINDS = [MadeGalaxy(kind="bulge_disc")] + [
    MadeGalaxy(kind=kind, seed=3)  # type: ignore[arg-type]
    for kind in ("clumpy", "companion", "spiral", "irregular", "merger")
]


def gaussian(rows: int = 40, columns: int = 36, width: float = 5.0) -> FloatArray:
    """A round galaxy whose nucleus is at column 16, row 21."""
    y, x = np.mgrid[:rows, :columns]
    return np.asarray(np.exp(-((x - 16.0) ** 2 + (y - 21.0) ** 2) / (2.0 * width**2)))


IMAGE = host_image(gaussian(), (16.0, 21.0))


def realization(host: Host | None = None, deflector: Deflector | None = None) -> Realization:
    host = Host(n=2.0, r_eff=0.39, magnitude=21.0) if host is None else host
    return Realization(system=cut(), l_eta=1.0, host=host, deflector=deflector)


# What is asked for.


def test_what_uses_none_of_it_has_the_digest_that_it_had() -> None:
    """Results of years are known by these digests; they are those of the version before there was any of it."""
    plain = Realization(system="HE0435", l_eta=1.0, host=Host(n=2, r_eff=0.39, magnitude=21))
    assert plain.digest == "a89bc559c7ef9ce4b565071fab827c4f2eb82c037a4f5b999a4a02a9d5eb34a1"
    assert "deflector" not in plain.to_dict()
    assert set(plain.to_dict()["host"]) == {"n", "r_eff", "magnitude", "q", "position_angle"}


@pytest.mark.parametrize(
    "host",
    [
        Host(image=IMAGE, r_eff=0.4, magnitude=21.0),
        Host(made=MadeGalaxy(kind="spiral", seed=3), r_eff=0.4, magnitude=21.0, name="mine"),
        Host(n=2.0, r_eff=0.4, magnitude=21.0, name="mine"),
    ],
)
def test_a_realization_is_read_back_from_its_json(host: Host) -> None:
    deflector = Deflector(multipoles=(MassMultipole(4, 0.02),), satellites=(MassSatellite(0.1, (1.9, -0.8)),))
    spec = realization(host, deflector)
    again = realization_from_dict(json.loads(json.dumps(spec.to_dict())))
    assert (again, again.digest) == (spec, spec.digest)
    assert spec.digest != realization(host).digest != realization().digest


def changed(**values: Any) -> dict[str, Any]:
    return {"system": "HE0435", "l_eta": 1.0, "host": {"r_eff": 0.4, "magnitude": 21.0, **values}}


def as_image(values: FloatArray, nucleus: tuple[float, float] = (16.0, 21.0)) -> dict[str, Any]:
    text = base64.b64encode(values.astype("<f4").tobytes()).decode()
    return {"pixels": text, "shape": list(values.shape), "nucleus": list(nucleus)}


BAD_PIXEL = gaussian()
BAD_PIXEL[3, 3] = np.nan


@pytest.mark.parametrize(
    ("host", "field"),
    [
        ({}, "host.n"),
        ({"n": 2.0, "made": {"kind": "spiral"}}, "host.n"),
        ({"made": {"kind": "sprial"}}, "host.made.kind"),
        ({"made": {"kind": "irregular", "share": 0.3}}, "host.made.share"),
        ({"made": {"kind": "bulge_disc", "seed": 1}}, "host.made.seed"),
        ({"made": {"kind": "spiral", "distance": 1.0}}, "host.made.distance"),
        ({"image": as_image(gaussian()), "q": 0.5}, "host.q"),
        ({"image": as_image(BAD_PIXEL)}, "host.image.pixels"),
        ({"image": as_image(-gaussian())}, "host.image.pixels"),
        ({"image": as_image(0.0 * gaussian())}, "host.image.pixels"),
        ({"image": as_image(gaussian() + 0.1)}, "host.image.pixels"),
        ({"image": as_image(gaussian(), (60.0, 3.0))}, "host.image.nucleus"),
        ({"image": as_image(gaussian(width=0.8))}, "host.image.pixels"),
        ({"image": as_image(gaussian(width=0.8) + gaussian(width=40.0))}, "host.image.pixels"),
        ({"image": as_image(gaussian(8, 8))}, "host.image.shape[0]"),
        ({"image": {**as_image(gaussian()), "shape": [36, 36]}}, "host.image.pixels"),
        ({"image": {**as_image(gaussian()), "pixels": "no base 64!"}}, "host.image.pixels"),
    ],
)
def test_what_is_no_host_is_refused_by_its_field(host: dict[str, Any], field: str) -> None:
    with pytest.raises(SpecError) as refused:
        realization_from_dict(changed(**host))
    assert refused.value.field == field


def test_hosts_and_deflectors_are_axes_of_a_grid() -> None:
    hosts = (HostShape(made=MadeGalaxy(kind="spiral", seed=1)), HostShape(image=IMAGE, name="mine"))
    more = Deflector(multipoles=(MassMultipole(4, 0.02),))
    grid = Grid(
        systems=("HE0435", "HE0047"), n=(2.0,), hosts=hosts, r_eff=(0.3, 0.4), magnitude=(21.0,), l_eta=(1.0,),
        deflectors=(Deflector(), more),
    )  # fmt: skip
    runs = expand(grid)
    assert len(runs) == len(Expansion(grid)) == 2 * 3 * 2 * 2
    assert len({run.label for run in runs}) == len({run.realization.digest for run in runs}) == len(runs)
    assert runs[0].label == "HE0435/n2_r0.3_m21_l1"
    assert runs[-1].label == "HE0047/mine_r0.4_m21_l1_m4"
    # A deflector that has nothing more is none, so that results from before it are results of it.
    assert {run.realization.deflector for run in runs} == {None, more}
    # What a run can be refused for as a whole is looked at once for each.
    samples = [(run.realization.system, run.realization.deflector) for run in Expansion(grid).samples]
    assert samples == [("HE0435", None), ("HE0435", more), ("HE0047", None), ("HE0047", more)]
    assert sum(Expansion(grid).shares) == len(runs)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"hosts": ()}, "hosts"),
        ({"hosts": (HostShape(n=1.0), HostShape(n=2.0))}, "hosts"),
        ({"hosts": (HostShape(n=1.0, name="n2"),)}, "hosts"),
        ({"deflectors": (Deflector(), Deflector())}, "deflectors"),
        ({"n": None}, "n"),
        ({"preset": "h0licow-vi", "systems": None, "r_eff": None, "hosts": (HostShape(n=1.0),)}, "hosts"),
    ],
)
def test_a_grid_that_could_not_tell_its_hosts_apart_is_refused(change: dict[str, Any], field: str) -> None:
    grid = Grid(systems=("HE0435",), n=(2.0,), r_eff=(0.3,), magnitude=(21.0,), l_eta=(1.0,))
    with pytest.raises(SpecError) as refused:
        expand(replace(grid, **change))
    assert refused.value.field == field


# What it looks like.


def test_the_definitions_are_those_of_a_sersic_profile() -> None:
    profile = SersicProfile(3.0, 0.7, 2.5, 0.6, 0.8)
    radius, q, phi = half_light_ellipse((profile,), 1.0)
    # Cells are a hundredth of the radius; moments of a steep profile on them are good to a thousandth.
    assert radius == pytest.approx(0.7, rel=1e-3)
    assert q == pytest.approx(0.6, abs=1e-3)
    assert math.remainder(phi - 0.8, math.pi) == pytest.approx(0.0, abs=1e-3)
    galaxy = Galaxy((profile,), 0.7, 0.6, 0.8)
    assert flux_within(galaxy, 0.5) == pytest.approx(flux_in_circle(profile, 0.5), rel=1e-3)


@pytest.mark.parametrize("made", KINDS, ids=lambda made: made.kind)
def test_a_made_galaxy_has_the_size_and_the_light_that_are_asked_for(made: MadeGalaxy) -> None:
    light = host_light(Host(made=made, r_eff=0.4, magnitude=21.0), cut(), 25.0, 0.1, -0.2)
    assert isinstance(light, Galaxy)
    assert (light.r_eff, light.n, light.x, light.y) == (0.4, None, 0.1, -0.2)
    assert light.flux == pytest.approx(10.0**1.6, rel=1e-12)
    # By another way than it was found: brute force on fine cells, of 8e-3 half-light radii.
    side, cells = 0.0032, 1000
    axis = pixel_centres(cells, side)
    flux = render_light(light, light.x + axis, light.y + axis, side)
    c, s = math.cos(light.phi), math.sin(light.phi)
    u, v = c * axis + s * axis[:, None], c * axis[:, None] - s * axis
    inside = light.q * u * u + v * v / light.q <= 0.4**2
    assert flux[inside].sum() == pytest.approx(0.5 * light.flux, rel=5e-3)
    edges = pixel_centres(41, 0.05)
    means = light_on_grid(light, light.x + edges, light.y + edges).reshape(40, 40)
    direct = render_light(light, light.x + pixel_centres(40, 0.05), light.y + pixel_centres(40, 0.05), 0.05)
    assert means * 0.05**2 == pytest.approx(direct, abs=2e-3 * direct.max())


@pytest.mark.parametrize("made", KINDS, ids=lambda made: made.kind)
def test_a_made_galaxy_is_the_same_bits_each_time_and_another_one_with_another_seed(made: MadeGalaxy) -> None:
    def bits(one: MadeGalaxy) -> list[bytes]:
        found: list[bytes] = []
        for part in made_components(one, 0.7, 0.3):
            found += [
                value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode()
                for value in vars(part).values()
            ]
        return found

    assert bits(made) == bits(made)
    if made.kind != "bulge_disc":
        assert bits(made) != bits(replace(made, seed=4))


def test_the_light_of_an_image_is_bilinear_between_its_pixels() -> None:
    values = np.random.default_rng(2).uniform(0.0, 1.0, (5, 7))
    light = PixelLight(values, 0.2, 3.0, 2.0, 0.7, 0.5, 0.1, -0.1)
    c, s = math.cos(0.5), math.sin(0.5)
    for column, row in ((3.0, 2.0), (1.25, 0.5), (5.75, 3.5), (-0.5, 2.0), (6.5, 4.5), (9.0, 2.0)):
        u, v = (column - 3.0) * 0.2 / math.sqrt(0.7), (row - 2.0) * 0.2 * math.sqrt(0.7)
        x, y = 0.1 + c * u - s * v, -0.1 + s * u + c * v
        expected = sum(
            values[j, i] * max(0.0, 1.0 - abs(column - i)) * max(0.0, 1.0 - abs(row - j))
            for j in range(5)
            for i in range(7)
        )
        assert float(brightness_at(light, np.array(x), np.array(y))) == pytest.approx(expected, abs=1e-12)


def plainly(
    light: PixelLight, x: FloatArray, y: FloatArray, side: float, lens: PowerLawLens | None, rays: int
) -> FloatArray:
    """The kernels' oracle: every sub-ray of every pixel at once, by array operations."""
    offsets = ((np.arange(rays) + 0.5) / rays - 0.5) * side
    px, py = np.meshgrid(np.add.outer(x, offsets).ravel(), np.add.outer(y, offsets).ravel())
    if lens is not None:
        px, py = source_position(lens, px, py)
    found = brightness_at(light, px, py) * (side / rays) ** 2
    return np.asarray(found.reshape(y.size, rays, x.size, rays).sum(axis=(1, 3)))


@pytest.mark.parametrize("lens", [None, LENS])
def test_an_image_is_rendered_as_by_plain_arrays(lens: PowerLawLens | None) -> None:
    light = PixelLight(gaussian(), 0.03, 16.0, 21.0, 0.8, 0.3, 0.05, 0.02)
    x, y = pixel_centres(50, 0.06), pixel_centres(46, 0.06)
    # 3 sub-rays to a pixel of the galaxy: 0.06 arcsec over 0.03 sqrt(0.8) are 7.
    assert render_pixels(light, x, y, 0.06, lens) == pytest.approx(plainly(light, x, y, 0.06, lens, 7), abs=1e-14)


@pytest.mark.parametrize("kind", ["spiral", "irregular", "merger"])
@pytest.mark.parametrize("r_eff", [0.1, 0.39])
def test_sub_rays_conserve_the_flux_to_a_thousandth_of_a_magnitude(kind: str, r_eff: float) -> None:
    """In the image, of all of it; and by pixel, against six times as many sub-rays along a side."""
    made = made_components(MadeGalaxy(kind=kind, seed=3), 0.7, 0.3)  # type: ignore[arg-type]
    galaxy = galaxy_of(made, 1.0, r_eff, 0.05, 0.03)
    light = next(part for part in galaxy.components if isinstance(part, PixelLight))
    # Half a sub-pixel of F160W's simulations along the ring: that of all cameras is smaller.
    side = 0.0325
    x, y = pixel_centres(120, side), pixel_centres(120, side)
    ours, finer = render_pixels(light, x, y, side, LENS), render_pixels(light, x, y, side, LENS, 18.0)
    assert 2.5 * abs(math.log10(ours.sum() / finer.sum())) < 1e-3
    assert np.abs(ours - finer).max() < 5e-3 * finer.max()
    # Seen directly all its light is there.
    axis = pixel_centres(400, 0.02 * r_eff / 0.1)
    direct = render_pixels(light, 0.05 + axis, 0.03 + axis, 0.02 * r_eff / 0.1)
    assert 2.5 * abs(math.log10(direct.sum() / light.flux)) < 1e-3


def test_a_simulated_image_host_is_that_of_finer_sub_pixels() -> None:
    """What convolving light that stands at the middle of sub-pixels costs, where there is no cusp to be placed."""
    host = Host(made=MadeGalaxy(kind="irregular", seed=1), r_eff=0.39, magnitude=20.5)
    usual = realization(host)
    system = cut()
    camera = load_camera(system.camera)  # type: ignore[arg-type]
    finer = replace(usual, camera=replace(camera, name="finer", oversampling=2 * camera.oversampling))
    one, other = (simulate_realization(spec).arc for spec in (usual, finer))
    assert np.abs(one - other).max() < 2e-3 * one.max()
    assert 2.5 * abs(math.log10(one.sum() / other.sum())) < 1e-3


def test_a_position_angle_turns_an_image_east_of_north() -> None:
    values = 1e-3 * gaussian()
    values[30:34, 15:18] += 1.0  # a bar to the North of the nucleus
    values[19:24, 14:19] += 2.0
    image = host_image(values, (16.0, 21.0))
    for angle, (east, north) in ((0.0, (0.0, 1.0)), (90.0, (1.0, 0.0)), (180.0, (0.0, -1.0))):
        light = host_light(Host(image=image, r_eff=0.4, magnitude=21.0, position_angle=angle), cut(), 25.0, 0.0, 0.0)
        assert isinstance(light, Galaxy)
        (part,) = light.components
        assert isinstance(part, PixelLight)
        away = 11.0 * part.side
        # x of the image frame is West.
        bar = part.values[31, 16]
        assert float(brightness_at(part, np.array(-away * east), np.array(away * north))) > 0.9 * bar


# Files.


def write(path: Path, *images: FloatArray) -> Path:
    fits.HDUList([fits.PrimaryHDU(), *(fits.ImageHDU(one, name=f"G{i}") for i, one in enumerate(images))]).writeto(path)
    return path


def test_a_file_is_read_isolated_binned_and_without_its_background(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    y, x = np.mgrid[:300, :280]
    galaxy = np.exp(-np.hypot(x - 150.0, y - 140.0) / 12.0)
    neighbour = 0.5 * np.exp(-np.hypot(x - 30.0, y - 250.0) / 4.0)
    path = write(tmp_path / "g.fits", galaxy + neighbour + rng.normal(3.0, 0.004, galaxy.shape))
    image = read_host_image(path)
    values = image.array()
    assert image.shape == (100, 93)
    assert values.sum() == pytest.approx(1.0, rel=1e-6)
    # Binned by 3, the nucleus is at 49.67, 46.33 of the new pixels' centres, give or take one.
    assert np.hypot(image.nucleus[0] - 49.67, image.nucleus[1] - 46.33) < 1.5
    assert not values[75:, :20].any()
    binned = galaxy[:300, :279].reshape(100, 3, 93, 3).sum(axis=(1, 3))
    inner = slice(20, 70), slice(25, 75)
    assert np.corrcoef(values[inner].ravel(), binned[inner].ravel())[0, 1] > 0.999
    assert read_host_image(path).digest == image.digest
    # Another place of the AGN is another host.
    assert read_host_image(path, nucleus=(151.0, 141.0)).digest != image.digest


def test_files_that_hold_no_galaxy_are_refused_by_field(tmp_path: Path) -> None:
    flat, small = np.ones((40, 40)), gaussian()[:10]
    two = write(tmp_path / "two.fits", gaussian(), gaussian())
    cases: list[tuple[Path, dict[str, Any], str]] = [
        (write(tmp_path / "flat.fits", flat), {}, "nucleus"),
        (write(tmp_path / "flat2.fits", flat), {"isolate": False}, "pixels"),
        (write(tmp_path / "pedestal.fits", gaussian() + 0.1), {"isolate": False, "background": "none"}, "pixels"),
        (write(tmp_path / "nan.fits", BAD_PIXEL), {}, "pixels"),
        (write(tmp_path / "small.fits", small), {}, "shape"),
        (write(tmp_path / "cube.fits", np.ones((3, 40, 40))), {}, "extension"),
        (write(tmp_path / "none.fits"), {}, "extension"),
        (two, {}, "extension"),
        (two, {"extension": "G7"}, "extension"),
        (two, {"extension": 1, "nucleus": (500.0, 3.0)}, "nucleus"),
    ]
    text = tmp_path / "no.fits"
    text.write_text("no FITS file")
    cases.append((text, {}, "file"))
    for path, options, field in cases:
        with pytest.raises(SpecError) as refused:
            read_host_image(path, **options)
        assert refused.value.field == field, path.name
    assert read_host_image(two, extension="G1").shape == (40, 36)
    with pytest.raises(FileNotFoundError):
        read_host_image(tmp_path / "absent.fits")


@pytest.mark.skipif(not GALAXIES.is_file(), reason="galaxies of COSMOS are not at hand: shared/data/galaxies")
def test_real_galaxies_are_hosts() -> None:
    for number in range(6):
        image = read_host_image(GALAXIES, extension=f"COSMOS{number}")
        spec = realization(Host(image=image, r_eff=0.39, magnitude=21.0))
        scene = build_scene(spec)
        assert isinstance(scene.host, Galaxy)
        assert 0.3 < scene.host.q < 0.9
        assert len(json.dumps(spec.to_dict())) < 95_000


# Truth.


def test_an_index_has_no_truth_where_the_host_is_no_profile() -> None:
    known = Quantity(1.0, 0.1)
    names = ("magnitude", "r_eff", "r_eff_galfit", "n", "q", "position_angle", "x", "y")
    counts = dict.fromkeys(("at_bound", "n_at_bound", "r_eff_at_bound", "failed"), 0)
    found = Estimate("image", "wide", **dict.fromkeys(names, known), draws=1, **counts)  # type: ignore[arg-type]
    host = build_scene(realization(Host(image=IMAGE, r_eff=0.39, magnitude=21.0))).host
    beside = estimate_beside(found, host, 25.0)
    assert beside.n.bias is None
    assert (beside.r_eff.truth, beside.r_eff_galfit.truth) == (0.39, pytest.approx(0.39 / math.sqrt(host.q)))
    assert beside.q.truth == pytest.approx(1.0, abs=2e-3)
    profile = build_scene(realization()).host
    assert estimate_beside(found, profile, 25.0).n.truth == 2.0


def test_a_simulation_of_an_image_says_what_it_was_made_of() -> None:
    spec = realization(Host(image=IMAGE, r_eff=0.39, magnitude=21.0, name="mine"))
    simulation = simulate_realization(spec)
    record = simulation.observation.provenance
    assert (record["HOST"], record["DEFLECT"]) == ("mine", "plain")
    assert "HOST_N" not in record
    assert realization_from_dict(json.loads(str(record["SPEC"]))) == spec
    again = simulate_realization(spec)
    assert again.observation.image.tobytes() == simulation.observation.image.tobytes()
    assert len(hosts_figure([simulation]).axes) == 2


# Deflectors.

MORE = Deflector(satellites=(MassSatellite(0.1, (1.9, -0.8)),), multipoles=(MassMultipole(4, 0.01),))


def test_satellites_and_multipoles_keep_the_images_about_where_they_were() -> None:
    spec = realization(
        deflector=Deflector(satellites=(MassSatellite(0.1, (1.9, -0.8)),), multipoles=(MassMultipole(4, 0.01),))
    )
    usual, other = build_scene(realization()), build_scene(spec)
    moved = [math.hypot(a.x - b.x, a.y - b.y) for a, b in zip(usual.agn, other.agn, strict=True)]
    # What is left is the tide of a mass of 0.1 arcsec at 2.1, a shear of 0.024 that turns the images along the ring.
    assert 1e-3 < max(moved) < 0.3
    # Had the source stayed, it would be outside the astroid, which goes with the satellite.
    assert len(solve_lens_equation(other.lens, usual.host.x, usual.host.y)) == 2
    # Every image is one of the source by the whole mass.
    place = source_place(cut().mass_model("recommended", 1.0), other.lens)
    for image in other.agn:
        x, y = source_position(other.lens, np.array(image.x), np.array(image.y))
        assert math.hypot(float(x) - place[0], float(y) - place[1]) < 1e-9
    assert (other.host.x, other.host.y) == place
    # The axis of a multipole is the mass's where nothing else is said.
    mass = cut().mass_model("recommended", 1.0)
    given = power_law_lens(mass, Deflector(multipoles=(MassMultipole(4, 0.01, mass.position_angle),)))
    assert given == power_law_lens(mass, Deflector(multipoles=(MassMultipole(4, 0.01),)))


def test_a_deflector_that_makes_other_images_is_refused() -> None:
    """Beside image A of HE0435, a satellite splits it."""
    spec = realization(deflector=Deflector(satellites=(MassSatellite(0.1, (1.5, 0.6)),)))
    for refuse in (check_deflector, build_scene):
        with pytest.raises(SpecError, match=r"deflector.*6, of magnifications"):
            refuse(spec)


def test_light_beside_the_deflectors_own_is_added_to_it() -> None:
    extra = SersicLight(20.0, 0.5, 1.0, 0.8, 10.0, (0.3, -0.2))
    usual, other = (simulate_realization(realization(deflector=one)) for one in (None, Deflector(light=(extra,))))
    added = other.high_resolution_image.sum() - usual.high_resolution_image.sum()
    # All but its wings beyond the field, which hold a hundredth of an exponential's light at six scale lengths.
    flux = 10.0 ** (0.4 * (usual.scene.camera.zero_point - 20.0))
    assert 0.97 * flux < added < flux
    assert other.arc == pytest.approx(usual.arc, abs=1e-12)


def test_a_sum_of_profiles_is_rendered_as_its_parts() -> None:
    parts: tuple[Component, ...] = (
        SersicProfile(1.0, 0.4, 1.0, 0.7, 0.3),
        SersicProfile(0.5, 0.1, 4.0, 0.9, 0.3, 0.2, 0.1),
    )
    galaxy = Galaxy(parts, 0.4, 0.7, 0.3)
    x = pixel_centres(40, 0.06)
    ours = render_light(galaxy, x, x, 0.06, LENS)
    assert ours == pytest.approx(
        sum(render_light(Galaxy((p,), 0.4, 0.7, 0.3), x, x, 0.06, LENS) for p in parts), abs=1e-14
    )


def test_the_analysis_of_such_a_sky_is_not_told_of_an_index() -> None:
    """A faint host that a profile fits well enough: the run ends with an answer, and without a bias of n."""
    host = Host(made=MadeGalaxy(kind="bulge_disc"), r_eff=0.3, magnitude=22.5)
    result = run(replace(realization(host), analysis=Analysis(estimators=("image",))))
    found = result.estimate("image", "wide")
    assert (found.n.bias, found.r_eff.truth) == (None, 0.3)
    assert found.magnitude.truth == pytest.approx(22.5)
    assert {one.index_prior for one in result.estimates} == {"wide", "free"}
