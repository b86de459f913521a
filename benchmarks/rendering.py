"""A lensed host in pixels: right against another way of integrating, then timed at equal error against everything else.

The scene is HE0435's lens, 100 x 100 pixels of 0.08 arcsec. Errors are those of the worst pixel as a fraction of the
brightest; all on one core. lenstronomy runs here, PyAutoLens in an environment of its own (see benchmarks.peers).
"""

import time

import numpy as np

from benchmarks import peers
from benchmarks.accuracy_report import autolens_images
from benchmarks.timing import least
from engine.accuracy.light_reference import flux_through_the_sides, graded_fluxes
from engine.accuracy.peers import lenstronomy_image
from engine.accuracy.rendering import uniform
from engine.accuracy.timing import least_cpu
from engine.conventions import pixel_centres
from engine.lensing.power_law import PowerLawLens
from engine.light.rendering import render_sersic
from engine.light.sersic import SersicProfile
from engine.simulation.scene import build_scene
from engine.simulation.simulate import scene_geometry, simulate
from engine.spec.host import Host
from engine.spec.realization import Realization

LENS = PowerLawLens(1.2171, 0.85, 1.29, 2.0)
PIXELS, SCALE = 100, 0.08
AXIS = pixel_centres(PIXELS, SCALE)
WANTED_PIXEL, WANTED_FLUX = 1e-3, 1e-4
PEER_SUBPIXELS = 8


def host(n: float, r_eff: float) -> SersicProfile:
    return SersicProfile(10.0, r_eff, n, 0.7, 0.3, 0.03, 0.05)


def render(profile: SersicProfile, tolerance: float = 1e-4) -> np.ndarray:
    return render_sersic(profile, AXIS, AXIS, SCALE, LENS, tolerance)


def errors(image: np.ndarray, reference: np.ndarray) -> tuple[float, float]:
    """Error of the worst pixel as a fraction of the peak, and of the flux."""
    return float(np.abs(image - reference).max() / reference.max()), abs(float(image.sum() / reference.sum() - 1))


def tolerances() -> None:
    """Error and time against tolerance, each error from the graded mesh of the tests."""
    print("tolerance of render_sersic: pixel error (of the peak), flux error, ms")
    for n, r_eff in ((1.0, 0.39), (4.0, 0.39), (4.0, 0.05), (8.0, 0.39)):
        profile = host(n, r_eff)
        reference = graded_fluxes(profile, AXIS, AXIS, SCALE, LENS)
        print(f"  n = {n:.0f}, r_eff = {r_eff}")
        for tolerance in (1e-2, 1e-3, 1e-4, 1e-5, 1e-6):
            pixel, flux = errors(render(profile, tolerance), reference)
            # The graded mesh itself is good to 1e-5.
            assert pixel < tolerance + 1e-5, (n, r_eff, tolerance, pixel)
            assert flux < tolerance + 1e-5, (n, r_eff, tolerance, flux)
            seconds = least(lambda t=tolerance, p=profile: render(p, t), 25)
            print(f"    {tolerance:7.0e} {pixel:9.1e} {flux:9.1e} {seconds * 1e3:8.1f}")


def against_peers() -> None:
    """Same rays, same pixels; then time and error of each. In units of the noise: ``benchmarks.accuracy_report``."""
    profile = host(4.0, 0.39)
    reference = render(profile, 1e-7)
    pixel, flux = errors(render(profile), reference)
    seconds = least_cpu(lambda: render(profile))
    print(f"n = 4, r_eff = 0.39, {PIXELS} x {PIXELS} pixels of {SCALE} arcsec: pixel error, flux error, CPU ms")
    print(f"  {'hostlens':24s} {pixel:9.1e} {flux:9.1e} {seconds * 1e3:8.1f}")
    theirs = lenstronomy_image(profile, LENS, AXIS, AXIS, SCALE, PEER_SUBPIXELS)
    found = {"lenstronomy": (theirs(), least_cpu(theirs))}
    if peers.interpreter("autolens") is None:
        print(f"  {peers.missing('autolens')}")
    else:
        found["PyAutoLens"] = autolens_images(profile, LENS, PIXELS, SCALE, (PEER_SUBPIXELS,))[0]
    same = uniform(profile, LENS, AXIS, AXIS, SCALE, PEER_SUBPIXELS)
    for name, (image, took) in found.items():
        # The same scene: the same supersampling with our ray tracer gives the same pixels.
        assert float(np.abs(image - same).max() / reference.max()) < 1e-3, name
        pixel_error, flux_error = errors(image, reference)
        print(
            f"  {name + f' {PEER_SUBPIXELS} x {PEER_SUBPIXELS}':24s} {pixel_error:9.1e} {flux_error:9.1e} "
            f"{took * 1e3:8.1f}   {took / seconds:.0f} times our time, {pixel_error / pixel:.0f} times our error"
        )


def simulations() -> None:
    """The high-resolution images of the simulation, and the whole forward simulation after the first of its kind."""
    print("simulation of a host of n = 4, r_eff = 0.39: host ms, deflector ms, all ms")
    for name, limit in (("HE0435", 0.5), ("RXJ1131", 1.5)):
        scene = build_scene(Realization(system=name, l_eta=1.0, host=Host(n=4.0, r_eff=0.39, magnitude=20.5)))
        geometry = scene_geometry(scene)
        x, y = geometry.high_resolution_axes()
        scale = geometry.subpixel_scale
        assert scene.deflector is not None
        deflector = scene.deflector
        part = np.s_[x.size // 2 - 20 : x.size // 2 + 21]
        exact = flux_through_the_sides(deflector, x[part], x[part], scale)
        pixel, _ = errors(render_sersic(deflector, x[part], x[part], scale), exact)
        assert pixel < 1e-4, pixel
        fine = render_sersic(scene.host, x, y, scale, scene.lens, 1e-6)
        pixel, flux = errors(render_sersic(scene.host, x, y, scale, scene.lens), fine)
        assert pixel < WANTED_PIXEL, pixel
        assert flux < WANTED_FLUX, flux
        times = [
            least(lambda s=scene, x=x, y=y, h=scale: render_sersic(s.host, x, y, h, s.lens), 9),
            least(lambda d=deflector, x=x, y=y, h=scale: render_sersic(d, x, y, h), 9),
            least(lambda s=scene: simulate(s, "author", np.random.default_rng(1)), 7),
        ]
        print(
            f"  {name:8s} {y.size} x {x.size} sub-pixels: "
            + " ".join(f"{t * 1e3:7.1f}" for t in times)
            + f"  (limit {limit * 1e3:.0f}); host {pixel:.0e} of the peak, {flux:.0e} of the flux"
        )


def main() -> None:
    began = time.perf_counter()
    against_peers()
    tolerances()
    simulations()
    print(f"all in {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
