"""Measuring the host in images: our own without being told what is in them, and other people's."""

import ast
import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from engine import (
    EngineError,
    Host,
    ImageMeasurement,
    ObservationError,
    PosteriorError,
    Realization,
    SpecError,
    load_system,
    measure_image,
    read_external_observation,
    simulate_realization,
)
from engine.figures import measurement_figure
from engine.imaging.observation import Observation
from engine.measurement_files import write_measurement
from engine.parametric.fit import fit_parametric
from engine.simulation.simulate import Simulation
from tests.engine.conftest import cut

SHARED_DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data"


@pytest.fixture(scope="module")
def found(wide: Simulation) -> ImageMeasurement:
    return measure_image(wide.observation, inversion=False)


def test_an_image_is_measured_without_being_told_what_is_in_it(wide: Simulation, found: ImageMeasurement) -> None:
    scene = wide.scene
    assert len(found.agn) == len(scene.agn)
    assert found.status == "ok"
    # The bounds are those of the errors that the measurement itself gives, tripled.
    assert found.host.magnitude.mean == pytest.approx(20.5, abs=3 * found.host.magnitude.sd)
    assert found.host.magnitude.interval95[0] < 20.5 < found.host.magnitude.interval95[1]
    assert found.host.r_eff.mean == pytest.approx(0.39, abs=3 * found.host.r_eff.sd)
    assert found.host.n.mean == pytest.approx(2.0, abs=3 * found.host.n.sd)
    assert found.host.magnitude.sd < 0.1
    for name in ("theta_E", "q", "slope"):
        assert found.lens[name].mean == pytest.approx(getattr(scene.lens, name), abs=3 * found.lens[name].sd + 1e-3)
    assert 0.9 < found.chi2_per_dof < 1.15
    assert found.noise_scale == pytest.approx(1.0, abs=0.05)
    assert "gamma1" not in found.lens, "the lens has no shear, and the data do not ask for any"


def test_fit_and_inversion_tell_their_chi2_in_the_same_noise(wide: Simulation) -> None:
    # A noise map of half the noise, exposures unknown: to the inversion the rest is what the fit misses.
    seen = wide.observation
    halved = replace(seen, noise=0.5 * seen.noise, response=None, covariance=None)
    found = measure_image(halved, agn_images=len(wide.scene.agn), shear=False, profile="draft")
    assert found.noise_scale == pytest.approx(2.0, abs=0.15)
    assert found.chi2_per_dof_as_given > 2.0
    # Both describe the image; what errors of stamps are allowed for makes them smaller than one.
    assert 0.7 < found.chi2_per_dof < 1.2
    # Its ring has the AGN in it and not the sky: 1.3 where the fit has 1.1. In another noise: four times that.
    assert found.inversion_chi2_per_dof == pytest.approx(found.chi2_per_dof, abs=0.4)


def test_an_arc_without_agn_is_found_from_its_ring() -> None:
    system = replace(cut(), agn=())
    realization = Realization(system=system, l_eta=1.0, host=Host(n=1.5, r_eff=0.3, magnitude=21.0))
    observation = simulate_realization(realization).observation
    lens = load_system("HE0435").mass_models["recommended"]["1.0"]
    fit = fit_parametric(observation, agn_images=0)
    assert not fit.agn
    # Without AGN the arc alone gives theta_E to a part in a thousand; the rest to three of its own errors.
    assert fit.lens.theta_E == pytest.approx(lens.theta_E, rel=2e-3)
    sd = np.sqrt(np.diag(fit.lens_covariance))
    assert fit.lens.q == pytest.approx(lens.q, abs=3 * sd[1] + 2e-3)
    assert fit.lens.slope == pytest.approx(lens.slope, abs=3 * sd[3] + 2e-3)
    assert -2.5 * math.log10(fit.host.flux) + 25.9463 == pytest.approx(21.0, abs=0.05)


def test_the_result_is_plain_json_with_the_promised_fields(found: ImageMeasurement) -> None:
    document = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    for quantity in ("magnitude", "radius", "n"):
        assert set(document["host"][quantity]) == {"mean", "sd", "interval95"}
        low, high = document["host"][quantity]["interval95"]
        assert low < document["host"][quantity]["mean"] < high
    for name in ("theta_E", "q", "slope"):
        assert document["lens"][name]["sd"] > 0
    assert document["estimator"] == "parametric"
    assert document["estimator"] in [estimate["estimator"] for estimate in document["estimates"]]
    # Names that exist stay: programs of other people read them.
    for key in ("host", "agn", "lens", "arc_magnitude", "read", "on_sky"):
        assert document[key], key
    for key in ("chi2_per_dof", "status", "seconds", "profile", "warnings", "versions", "engine_digest", "seed"):
        assert key in document


def test_an_image_of_nothing_has_no_lens(simulation: Simulation) -> None:
    rng = np.random.default_rng(0)
    seen = simulation.observation
    empty = Observation(rng.normal(0.0, 1e-3, (32, 32)), np.full((32, 32), 1e-3), seen.psf, 0.08, 25.9)
    with pytest.raises(ObservationError, match="agn"):
        fit_parametric(empty, agn_images=4)
    with pytest.raises(EngineError):
        measure_image(replace(empty, image=1e3 * empty.image), theta_E=1.0, agn_images=0, inversion=False)


def test_a_bad_fit_is_no_start(simulation: Simulation) -> None:
    whole = simulation.observation
    # As little as the ring needs: the fit goes through all its starts before it gives up.
    middle = (slice(11, 54), slice(11, 54))
    seen = Observation(whole.image[middle], whole.noise[middle], whole.psf, whole.pixel_scale, whole.zero_point)
    y, x = np.indices(seen.shape) - 21.0
    # Twelve bright blobs that no lens makes.
    blobs = sum(5.0 * np.exp(-((x - 17 * math.cos(k)) ** 2 + (y - 17 * math.sin(k)) ** 2) / 8.0) for k in range(12))
    with pytest.raises(PosteriorError, match=r"chi2|AGN image"):
        fit_parametric(replace(seen, image=seen.image + blobs), agn_images=4)


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"profile": "best"}, "profile"),
        ({"agn_images": -1}, "agn_images"),
        ({"theta_E": -1.0}, "theta_E"),
        ({"theta_E": 100.0}, "theta_E"),
        ({"seed": -1}, "seed"),
    ],
)
def test_options_that_make_no_sense_are_named(simulation: Simulation, options: dict[str, object], field: str) -> None:
    with pytest.raises(SpecError, match=field):
        measure_image(simulation.observation, inversion=False, **options)  # type: ignore[arg-type]


def test_the_picture_and_the_file_show_the_fit(found: ImageMeasurement, tmp_path: Path) -> None:
    figure = measurement_figure(found)
    assert len(figure.axes) >= 6
    write_measurement(tmp_path / "found.fits", found)
    with fits.open(tmp_path / "found.fits") as hdus:
        assert np.array_equal(hdus["MODEL"].data, found.fit.model)
        assert json.loads(hdus["RESULT"].data["json"][0])["status"] == found.status


def _paired_lens(kind: str) -> tuple[Observation, dict[str, float]]:
    folder = SHARED_DATA / "paired_lens" / f"sim_lens_{kind}"
    if not folder.is_dir():
        pytest.skip("the foreign example data (shared/data beside the project) are not here")
    seen = read_external_observation(
        folder / "Drz_QSO_image.fits", folder / "Drz_PSF.fits", zero_point=25.9463, noise=folder / "noise_map.fits",
        pixel_scale=0.08, recentre_psf="pixel", normalise_psf=True,
    )  # fmt: skip
    text = (folder / "lens_all_info.txt").read_text()
    lens = ast.literal_eval(re.search(r"SPEMD:(\{.*?\})", text)[1])  # type: ignore[index]
    host = ast.literal_eval(re.search(r"source plane:\n\t(\{.*?\})", text)[1])  # type: ignore[index]
    truth = {"theta_E": lens["theta_E"], "q": lens["q"], "slope": lens["gamma"], "magnitude": host["mag"]}
    return seen, truth


@pytest.mark.parametrize(("kind", "agn"), [("AGN_ID4", 4), ("transient_ID1", 0)])
def test_hosts_in_images_of_other_people_come_out_right(kind: str, agn: int) -> None:
    seen, truth = _paired_lens(kind)
    found = measure_image(seen, agn_images=agn, inversion=False)
    # The truth's R is along the major axis and its stars stand on a lattice of 0.03 arcsec: not ours to know.
    assert found.host.magnitude.mean == pytest.approx(truth["magnitude"], abs=0.15)
    low, high = found.host.magnitude.interval95
    assert low < truth["magnitude"] < high
    for name in ("theta_E", "q", "slope"):
        bound = max(3 * found.lens[name].sd, 0.02 * truth[name])
        assert found.lens[name].mean == pytest.approx(truth[name], abs=bound)
    assert 0.9 < found.chi2_per_dof < 1.15
    # Its noise map allows for what neighbouring pixels of a drizzled image share.
    assert 0.5 < found.noise_scale < 0.7
