"""Is the host right in images of somebody else's? Random lenses, of which an image, a noise map and a PSF are left.

    python -m benchmarks.external [--first 0] [--runs 40] [--inversion] [--results FILE]

WFC3/F160W with HE0435's exposures, drizzled to 0.08 arcsec. Even seeds have an AGN, odd ones an arc alone. Lens with
shear, deflector, host, brightness of the AGN, size of the image and phase of the PSF star are drawn for each. As in
simulations of other people AGN images stand on the lattice of the sub-pixels, so that they are up to 0.02 arcsec from
where the lens has them, the PSF has no light beyond its stamp, and the noise map is that of pixels that share no noise,
1.6 times their scatter. Everything goes through FITS files and is measured without any option.

Printed are found minus true, and what an observer would call wrong: another number of AGN images, host magnitude more
than 0.15 off or outside its 95 % interval, a lens parameter off by more than 3 deviations and 2 %, chi^2 per degree of
freedom outside 0.9-1.15, a status that is not ok.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from engine import EngineError, Observation, load_camera, load_system, measure_image, read_external_observation
from engine.conventions import FloatArray, magnitude_to_rate, rate_to_magnitude
from engine.imaging.convolution import convolve, point_source_image
from engine.imaging.cusps import place_cusps
from engine.imaging.optics.exposed import ExposedOptics
from engine.imaging.psf import detector_kernel
from engine.imaging.telescope import optical_psf
from engine.lensing.lens_equation import LensedImage, solve_lens_equation
from engine.lensing.power_law import PowerLawLens, source_position
from engine.light.rendering import render_sersic
from engine.light.sersic import SersicProfile
from engine.simulation.scene import PointSource, Scene
from engine.simulation.simulate import combine, high_resolution_host, scene_geometry, simulate_exposures

_PSF_SIDE, _PSF_PEAK, _PSF_REACH = 81, 38, 2.9
_PSF_FIELD = 131
_DOUBLES = 0.25
_LENS = ("theta_E", "q", "slope")


@dataclass(frozen=True)
class Sky:
    """One drawn lens: the scene, where the PSF star stands [arcsec], and the generator that draws its noise."""

    scene: Scene
    star: tuple[float, float]
    rng: np.random.Generator


def _source(rng: np.random.Generator, lens: PowerLawLens, number: int) -> tuple[LensedImage, ...]:
    """Images of a source that has ``number`` of them, none of them swallowed by the deflector."""
    reach = 0.15 if number == 4 else 0.5
    while True:
        x, y = rng.uniform(-reach, reach, 2)
        images = solve_lens_equation(lens, float(x), float(y))
        if len(images) == number and min(abs(image.magnification) for image in images) > 0.5:
            return images


def draw(seed: int) -> Sky:
    """The lens of a seed: uniform in nearly everything, shear of either direction."""
    rng = np.random.default_rng([20210, seed])
    shear, shear_angle = rng.uniform(0.0, 0.08), rng.uniform(0.0, math.pi)
    lens = PowerLawLens(
        theta_E=rng.uniform(0.9, 1.5),
        q=rng.uniform(0.6, 0.95),
        phi=rng.uniform(0.0, math.pi),
        slope=float(np.clip(rng.normal(2.0, 0.1), 1.8, 2.2)),
        gamma1=shear * math.cos(2.0 * shear_angle),
        gamma2=shear * math.sin(2.0 * shear_angle),
    )
    images = _source(rng, lens, 2 if rng.uniform() < _DOUBLES else 4)
    mapped = images[0]
    camera = load_camera("WFC3-IR_F160W")
    side = int(rng.choice([99, 99, 99, 83, 121]))
    base = load_system("HE0435")
    system = replace(base, exposures=replace(base.exposures, field_pixels=side))
    x, y = _maps_to(lens, mapped)
    host = SersicProfile(
        flux=magnitude_to_rate(rng.uniform(20.5, 23.0), camera.zero_point),
        r_eff=math.exp(rng.uniform(math.log(0.2), math.log(0.6))),
        n=rng.uniform(1.0, 4.5),
        q=rng.uniform(0.6, 1.0),
        phi=rng.uniform(0.0, math.pi),
        x=x,
        y=y,
    )
    deflector = SersicProfile(
        flux=magnitude_to_rate(rng.uniform(17.3, 19.8), camera.zero_point),
        r_eff=rng.uniform(0.6, 1.3),
        n=rng.uniform(2.5, 5.0),
        q=min(1.0, lens.q + rng.uniform(-0.05, 0.2)),
        phi=lens.phi + rng.uniform(-0.2, 0.2),
    )
    scene = Scene(system, camera, lens, host, deflector, ())
    agn: tuple[PointSource, ...] = ()
    if seed % 2 == 0:
        bright = host.flux * 10.0 ** (0.4 * rng.uniform(-0.5, 2.0))
        agn = tuple(_on_lattice(scene, k, image, bright) for k, image in enumerate(images))
    # As a star in the middle of a stamp that somebody made on sub-pixels; every fourth pair stands anywhere.
    star = tuple(rng.uniform(-0.5, 0.5, 2) * camera.drizzled_scale * (1.0 if seed % 8 < 2 else 0.2))
    return Sky(replace(scene, agn=agn), (float(star[0]), float(star[1])), rng)


def _maps_to(lens: PowerLawLens, image: LensedImage) -> tuple[float, float]:
    x, y = source_position(lens, np.array([image.x]), np.array([image.y]))
    return float(x[0]), float(y[0])


def _on_lattice(scene: Scene, index: int, image: LensedImage, flux: float) -> PointSource:
    """An AGN image on the nearest sub-pixel."""
    axes = scene_geometry(scene).high_resolution_axes()
    x, y = (float(a[np.argmin(np.abs(a - at))]) for a, at in zip(axes, (image.x, image.y), strict=True))
    return PointSource("ABCDE"[index], x, y, flux * abs(image.magnification))


def _stamp_psf(scene: Scene) -> FloatArray:
    """The optical PSF on sub-pixels without what the stamp would lose, of unit sum."""
    geometry = scene_geometry(scene)
    reach = math.floor(_PSF_REACH / geometry.subpixel_scale)
    psf = optical_psf(scene.camera, geometry.oversampling)
    middle = psf.shape[0] // 2
    cut = psf[middle - reach : middle + reach + 1, middle - reach : middle + reach + 1]
    return np.asarray(cut / cut.sum())


def psf_star(sky: Sky, psf: FloatArray) -> FloatArray:
    """A star through the same dithers and drizzle, on a stamp whose middle is not its peak."""
    exposures = replace(sky.scene.system.exposures, field_pixels=_PSF_FIELD)
    scene = replace(sky.scene, system=replace(sky.scene.system, exposures=exposures))
    image = ExposedOptics(psf, scene_geometry(scene), detector_kernel(scene.camera)).point_source(*sky.star)
    row, column = np.unravel_index(int(np.argmax(image)), image.shape)
    rows, columns = (slice(int(at) - _PSF_PEAK, int(at) - _PSF_PEAK + _PSF_SIDE) for at in (row, column))
    return np.asarray(image[rows, columns])


def observe(sky: Sky, psf: FloatArray) -> Observation:
    """The drizzled image and its noise, with this PSF on sub-pixels."""
    scene = sky.scene
    geometry = scene_geometry(scene)
    x, y = geometry.high_resolution_axes()
    host = high_resolution_host(scene, geometry)
    images = solve_lens_equation(scene.lens, scene.host.x, scene.host.y)
    light = place_cusps(host, scene.host, [(image.x, image.y) for image in images], geometry, scene.lens)
    if scene.deflector is not None:
        deflector = render_sersic(scene.deflector, x, y, geometry.subpixel_scale)
        light = light + place_cusps(deflector, scene.deflector, [(scene.deflector.x, scene.deflector.y)], geometry)
    image = convolve(light, psf)
    if scene.agn:
        positions = np.array([(source.x, source.y) for source in scene.agn])
        image = image + point_source_image(positions, np.array([a.flux for a in scene.agn]), psf, geometry)
    return combine(scene, simulate_exposures(scene, geometry, image, "author", sky.rng))


def foreign(sky: Sky) -> Observation:
    """What somebody else hands over: image, noise map and PSF as FITS files, read as the command line reads them."""
    psf = _stamp_psf(sky.scene)
    seen, camera = observe(sky, psf), sky.scene.camera
    with tempfile.TemporaryDirectory() as folder:
        paths = {name: Path(folder) / f"{name}.fits" for name in ("image", "noise", "psf")}
        # The variance of a native pixel's light spread over the drizzled ones, as if each had noise of its own.
        planes = {
            "image": seen.image,
            "noise": seen.noise * camera.pixel_scale / camera.drizzled_scale,
            "psf": psf_star(sky, psf),
        }
        for name, values in planes.items():
            fits.writeto(paths[name], values.astype(np.float32))
        return read_external_observation(
            paths["image"],
            paths["psf"],
            zero_point=camera.zero_point,
            noise=paths["noise"],
            pixel_scale=camera.drizzled_scale,
            recentre_psf="pixel",
            normalise_psf=True,
        )


def compare(seed: int, *, inversion: bool) -> dict[str, Any]:
    """Measure the image of a seed; what was found, what is true, and what is wrong."""
    sky = draw(seed)
    lens, host, zero_point = sky.scene.lens, sky.scene.host, sky.scene.camera.zero_point
    true = {"magnitude": rate_to_magnitude(host.flux, zero_point), "radius": host.r_eff, "n": host.n}
    true |= {name: float(getattr(lens, name)) for name in _LENS}
    record: dict[str, Any] = {"seed": seed, "true": true, "agn": len(sky.scene.agn)}
    observation = foreign(sky)
    began = time.perf_counter()
    try:
        found = measure_image(observation, inversion=inversion)
    except EngineError as error:
        seconds = time.perf_counter() - began
        return {**record, "error": str(error), "wrong": [f"{type(error).__name__}: {error}"], "seconds": seconds}
    values = {"magnitude": found.host.magnitude, "radius": found.host.r_eff, "n": found.host.n}
    values |= {name: found.lens[name] for name in _LENS}
    wrong = [] if len(found.agn) == record["agn"] else [f"{len(found.agn)} AGN images of {record['agn']}"]
    low, high = values["magnitude"].interval95
    wrong += [] if abs(values["magnitude"].mean - true["magnitude"]) < 0.15 else ["magnitude"]
    wrong += [] if low <= true["magnitude"] <= high else ["interval"]
    for name in _LENS:
        if abs(values[name].mean - true[name]) > max(3.0 * values[name].sd, 0.02 * true[name]):
            wrong.append(name)
    wrong += [] if 0.9 <= found.chi2_per_dof <= 1.15 else ["chi2"]
    wrong += [] if found.status == "ok" else [found.status]
    chain = None if found.inversion is None else found.inversion.chain.summary
    return record | {
        "found": {name: [value.mean, value.sd, *value.interval95] for name, value in values.items()},
        "images": len(found.agn),
        "shear": "gamma1" in found.lens,
        "chi2_per_dof": found.chi2_per_dof,
        "noise_scale": found.noise_scale,
        "warnings": list(found.warnings),
        "chain": None if chain is None else [chain.status, chain.steps, chain.tau],
        "seconds": found.seconds,
        "wrong": wrong,
    }


def line(record: dict[str, Any]) -> str:
    """One line of the table."""
    true = record["true"]
    text = f"{record['seed']:4d} {record['agn']} | {true['magnitude']:5.2f} {true['radius']:.2f} {true['n']:.1f} | "
    if "found" not in record:
        return f"{text}{record['seconds']:.0f} s  {'; '.join(record['wrong'])}"
    for name, digits in (("magnitude", 3), ("radius", 3), ("n", 2), ("theta_E", 4), ("q", 3), ("slope", 3)):
        mean, sd = record["found"][name][:2]
        text += f"{mean - true[name]:+.{digits}f} ± {sd:.{digits}f}  "
    chain = "" if record["chain"] is None else f" {record['chain'][0]}"
    return f"{text}| {record['chi2_per_dof']:.2f} {record['seconds']:4.0f} s{chain}  {', '.join(record['wrong'])}"


def summary(records: list[dict[str, Any]]) -> list[str]:
    """Shares and widths of the pulls, with AGN and without."""
    out = []
    for kind in ("with AGN", "without"):
        chosen = [record for record in records if bool(record["agn"]) is (kind == "with AGN")]
        good = [record for record in chosen if "found" in record]
        if not good:
            continue
        out.append(f"{kind}: {len(chosen)} images, {sum(not record['wrong'] for record in chosen)} with nothing wrong")
        for name in ("magnitude", "radius", "n", *_LENS):
            off = np.array([record["found"][name][0] - record["true"][name] for record in good])
            pull = off / np.array([record["found"][name][1] for record in good])
            inside = np.mean([r["found"][name][2] <= r["true"][name] <= r["found"][name][3] for r in good])
            out.append(
                f"  {name:9s} median {np.median(off):+.4f}, median |off| {np.median(np.abs(off)):.4f}, largest "
                f"{np.abs(off).max():.3f}; {100 * inside:.0f} % inside 95 %, pulls "
                f"{pull.mean():+.2f} ± {pull.std():.2f}"
            )
    return out


def main(arguments: list[str] | None = None) -> int:
    """Print the table; the exit code is the number of images with something wrong."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--seeds", type=int, nargs="*", help="these instead")
    parser.add_argument("--inversion", action="store_true", help="sample the inversion as well")
    parser.add_argument("--results", type=Path)
    given = parser.parse_args(arguments)
    print("seed AGN | true mag R n | mag  R  n  theta_E  q  slope | chi2/dof  time  wrong")
    records = []
    for seed in given.seeds or range(given.first, given.first + given.runs):
        records.append(compare(seed, inversion=given.inversion))
        print(line(records[-1]), flush=True)
        if given.results is not None:
            with given.results.open("a") as log:
                log.write(json.dumps(records[-1]) + "\n")
    print("\n".join(summary(records)))
    return sum(bool(record["wrong"]) for record in records)


if __name__ == "__main__":
    sys.exit(main())
