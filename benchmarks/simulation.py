"""The forward simulation step by step, for each system: error against something made another way, time, memory.

    python -m benchmarks.simulation [--write docs/tables/simulation.md] [SYSTEM ...]

Every error is asserted to be below its bound before any time is printed. Times are of one core, after warm-up; memory
is the peak of what the step allocates (Python and NumPy).
"""

import argparse
import math
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.psf_figures import effective_psf, encircled_energy, full_width_half_maximum
from benchmarks.timing import least
from engine.accuracy.light_reference import flux_through_the_sides, graded_fluxes
from engine.catalogue import camera_names, load_camera, load_dither, read_catalogue, system_names
from engine.conventions import FloatArray
from engine.imaging.convolution import convolve, point_source_image
from engine.imaging.cusps import place_cusps
from engine.imaging.drizzling import drizzle, drizzle_weights, drizzled_covariance
from engine.imaging.exposures import expose
from engine.imaging.geometry import Geometry, exposure_geometry
from engine.imaging.noise import draw_noise, exposure_noise
from engine.imaging.psf import (
    detector_kernel,
    telescope_psf,
)
from engine.imaging.telescope import optical_psf
from engine.lensing.lens_equation import solve_lens_equation
from engine.light.rendering import render_sersic
from engine.simulation.scene import Scene, build_scene
from engine.simulation.simulate import scene_geometry, simulate
from engine.spec.host import Host
from engine.spec.realization import Realization
from tests.engine.angular_solver import AngularSolver

NOISE_DRAWS = 100
HARDEST_HOST = Host(n=4.0, r_eff=0.3, magnitude=20.5)


@dataclass(frozen=True)
class Step:
    """One step of one system: what its error means, the error, the bound that it must keep, and what it costs."""

    name: str
    meaning: str
    error: float
    bound: float
    seconds: float
    mebibytes: float


def measured(name: str, meaning: str, error: float, bound: float, work: Callable[[], object]) -> Step:
    """Assert the error of a step, then take its time and memory."""
    assert error <= bound, f"{name}: {meaning} is {error:.2e}, allowed {bound:.0e}"
    seconds = least(work, 3)
    tracemalloc.start()
    work()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return Step(name, meaning, error, bound, seconds, peak / 2**20)


def lens_equation(scene: Scene) -> Step:
    lens, host = scene.lens, scene.host
    solver = AngularSolver(lens)
    images = solve_lens_equation(lens, host.x, host.y)
    theirs = solver.images(host.x, host.y)
    error = max(min(math.hypot(i.x - x, i.y - y) for x, y in theirs) for i in images)
    return measured("AGN images", "position [arcsec]", error, 1e-9, lambda: solve_lens_equation(lens, host.x, host.y))


def rendered_host(scene: Scene, geometry: Geometry) -> Step:
    x, y = geometry.high_resolution_axes()
    h, lens = geometry.subpixel_scale, scene.lens
    ours = render_sersic(scene.host, x, y, h, lens)
    # The reference is slow: blocks about the images, where the cusps are, and about the brightest pixel.
    error, peak = 0.0, float(ours.max())
    spots = [(i.x, i.y) for i in solve_lens_equation(lens, scene.host.x, scene.host.y)]
    row, column = np.unravel_index(np.argmax(ours), ours.shape)
    for px, py in [*spots, (x[column], y[row]), (0.7 * x[column], 0.7 * y[row])]:
        i, j = int(np.argmin(np.abs(x - px))), int(np.argmin(np.abs(y - py)))
        columns, rows = slice(max(i - 8, 0), i + 9), slice(max(j - 8, 0), j + 9)
        exact = graded_fluxes(scene.host, x[columns], y[rows], h, lens)
        error = max(error, float(np.abs(ours[rows, columns] - exact).max()) / peak)
    return measured("lensed host", "of the peak", error, 1e-3, lambda: render_sersic(scene.host, x, y, h, lens))


def rendered_deflector(scene: Scene, geometry: Geometry) -> Step:
    assert scene.deflector is not None
    profile, h = scene.deflector, geometry.subpixel_scale
    x, y = geometry.high_resolution_axes()
    ours = render_sersic(profile, x, y, h)
    middle = slice(x.size // 2 - 12, x.size // 2 + 13)
    exact = flux_through_the_sides(profile, x[middle], y[middle], h)
    error = float(np.abs(ours[middle, middle] - exact).max()) / float(ours.max())
    return measured("deflector", "of the peak", error, 1e-3, lambda: render_sersic(profile, x, y, h))


def blurred(scene: Scene, geometry: Geometry, host: FloatArray) -> Step:
    psf = optical_psf(scene.camera, geometry.oversampling)
    ours, half = convolve(host, psf), psf.shape[0] // 2
    error = 0.0
    for row, column in np.random.default_rng(0).integers(0, host.shape[0], (40, 2)):
        # The direct sum over all sub-pixels that the PSF can carry light from.
        rows = np.arange(max(row - half, 0), min(row + half + 1, host.shape[0]))
        columns = np.arange(max(column - half, 0), min(column + half + 1, host.shape[1]))
        direct = host[np.ix_(rows, columns)] * psf[np.ix_(row - rows + half, column - columns + half)]
        error = max(error, abs(float(direct.sum()) - ours[row, column]))
    return measured("blurring", "of the peak", error / float(ours.max()), 1e-12, lambda: convolve(host, psf))


def subpixels(scene: Scene, geometry: Geometry) -> Step:
    """Exposures of the host alone, against those from sub-pixels a third as large, PSF included."""

    def exposures(factor: int) -> FloatArray:
        finer = exposure_geometry(
            scene.camera,
            load_dither(scene.system.exposures.dither),
            (49, 49),
            oversampling=factor * geometry.oversampling,
        )
        x, y = finer.high_resolution_axes()
        host = render_sersic(scene.host, x, y, finer.subpixel_scale, scene.lens)
        images = [(i.x, i.y) for i in solve_lens_equation(scene.lens, scene.host.x, scene.host.y)]
        placed = place_cusps(host, scene.host, images, finer, scene.lens)
        psf = telescope_psf(scene.camera, oversampling=finer.oversampling, field_of_view=4.0)
        return expose(convolve(placed, psf), finer, detector_kernel(scene.camera))

    coarse, fine = exposures(1), exposures(3)
    error = float(np.abs(coarse - fine).max() / fine.max())
    return measured("sub-pixels", "of the peak, exposures of the host", error, 1e-3, lambda: exposures(1))


def agn_placed(scene: Scene, geometry: Geometry) -> Step:
    psf = optical_psf(scene.camera, geometry.oversampling)
    positions = np.array([(source.x, source.y) for source in scene.agn])
    fluxes = np.array([source.flux for source in scene.agn])
    # On a grid that holds the whole stamp nothing of the flux may be lost.
    star = telescope_psf(scene.camera, oversampling=geometry.oversampling, field_of_view=2.0)
    error = 0.0
    for position in positions * 0.5:
        error = max(error, abs(point_source_image(position[None], np.ones(1), star, geometry).sum() / star.sum() - 1))
    return measured("AGN", "flux", error, 1e-6, lambda: point_source_image(positions, fluxes, psf, geometry))


def exposed(scene: Scene, geometry: Geometry, light: FloatArray) -> Step:
    kernel = detector_kernel(scene.camera)
    exposures = expose(light, geometry, kernel)
    # Each exposure is the binned light: the same sums made from the cumulative image, the kernel by its nine weights.
    total = np.pad(light.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    f, error = geometry.oversampling, 0.0
    for index, (shift_x, shift_y) in enumerate(geometry.subpixel_shifts):
        rows = geometry.margin + shift_y + f * np.arange(-1, geometry.native_shape[0] + 2)
        columns = geometry.margin + shift_x + f * np.arange(-1, geometry.native_shape[1] + 2)
        corners = total[np.ix_(rows, columns)]
        binned = np.diff(np.diff(corners, axis=0), axis=1)
        spread = sum(
            kernel[1 - dy, 1 - dx] * binned[1 + dy : binned.shape[0] - 1 + dy, 1 + dx : binned.shape[1] - 1 + dx]
            for dy in (-1, 0, 1)
            for dx in (-1, 0, 1)
        )
        error = max(error, float(np.abs(spread - exposures[index]).max()) / float(exposures.max()))
    return measured("exposures", "of the peak", error, 1e-11, lambda: expose(light, geometry, kernel))


def noise_drawn(scene: Scene, noiseless: FloatArray) -> Step:
    noise, rng = exposure_noise(noiseless, scene.camera, scene.system.exposures, "handbook"), np.random.default_rng(0)
    residuals = [draw_noise(noise, rng) / np.sqrt(noise.variance) for _ in range(NOISE_DRAWS // 5)]
    error = max(abs(float(np.std(residuals)) - 1.0), abs(float(np.mean(residuals))))
    return measured("noise", "mean and deviation of residuals", error, 0.01, lambda: draw_noise(noise, rng))


def drizzled(scene: Scene, geometry: Geometry, exposures: FloatArray) -> list[Step]:
    image = drizzle(exposures, geometry)
    again = (drizzle_weights(geometry) @ exposures.ravel()).reshape(image.shape)
    linear = float(np.abs(again / image - 1).max())
    star = telescope_psf(scene.camera, oversampling=geometry.oversampling, field_of_view=2.0)
    x, y = geometry.drizzled_axes()
    flux, place = 0.0, 0.0
    for px, py in np.random.default_rng(1).uniform(-0.3, 0.3, (5, 2)):
        light = point_source_image(np.array([[px, py]]), np.ones(1), star, geometry)
        stamp = drizzle(expose(light, geometry, detector_kernel(scene.camera)), geometry)
        flux = max(flux, abs(stamp.sum() / star.sum() - 1))
        axis = (np.arange(len(star)) - len(star) // 2) * geometry.subpixel_scale
        own = np.array([(star * axis).sum(), (star * axis[:, None]).sum()]) / star.sum()
        centre = np.array([(stamp * x).sum(), (stamp * y[:, None]).sum()]) / stamp.sum()
        place = max(place, float(np.abs(centre - (px, py) - own).max()) / geometry.drizzled_scale)
    work = lambda: drizzle(exposures, geometry)  # noqa: E731
    return [
        measured("drizzle", "flux of a star", flux, 1.1e-4, work),
        measured("drizzle", "place of a star [pixel]", place, 0.01, work),
        measured(
            "weights W", "against the package", linear, 1e-5, lambda: drizzle_weights(geometry) @ exposures.ravel()
        ),
    ]


def correlated(scene: Scene, geometry: Geometry, noiseless: FloatArray) -> Step:
    noise, rng = exposure_noise(noiseless, scene.camera, scene.system.exposures, "handbook"), np.random.default_rng(2)
    covariance = drizzled_covariance(noise.variance, geometry)
    ny, nx = geometry.drizzled_shape
    sigma = np.sqrt(covariance.diagonal()).reshape(ny, nx)
    index = np.arange(ny * nx).reshape(ny, nx)
    wanted = np.asarray(covariance[index[:, 1:].ravel(), index[:, :-1].ravel()]).reshape(ny, nx - 1)
    wanted = wanted / (sigma[:, 1:] * sigma[:, :-1])
    variance, neighbours = 0.0, 0.0
    for _ in range(NOISE_DRAWS):
        residual = drizzle(draw_noise(noise, rng), geometry) / sigma
        variance += float(np.mean(residual**2)) / NOISE_DRAWS
        neighbours += float(np.mean(residual[:, 1:] * residual[:, :-1])) / NOISE_DRAWS
    error = max(abs(variance - 1), abs(neighbours - wanted.mean()))
    return measured(
        "covariance", "variance and correlation", error, 0.02, lambda: drizzled_covariance(noise.variance, geometry)
    )


def steps_of(name: str) -> list[Step]:
    scene = build_scene(Realization(system=name, l_eta=1.0, host=HARDEST_HOST))
    geometry = scene_geometry(scene)
    x, y = geometry.high_resolution_axes()
    simulate(scene, "handbook", np.random.default_rng(0))  # warms up kernels, PSF and weights
    host = render_sersic(scene.host, x, y, geometry.subpixel_scale, scene.lens)
    light = convolve(host, optical_psf(scene.camera, geometry.oversampling))
    noiseless = expose(light, geometry, detector_kernel(scene.camera))
    whole = measured("all of it", "", 0.0, 0.0, lambda: simulate(scene, "handbook", np.random.default_rng(0)))
    return [
        lens_equation(scene),
        rendered_host(scene, geometry),
        rendered_deflector(scene, geometry),
        blurred(scene, geometry, host),
        subpixels(scene, geometry),
        agn_placed(scene, geometry),
        exposed(scene, geometry, light),
        noise_drawn(scene, noiseless),
        *drizzled(scene, geometry, noiseless),
        correlated(scene, geometry, noiseless),
        whole,
    ]


def psf_table() -> list[str]:
    """Encircled energy and FWHM of each camera against the tables of the handbooks."""
    lines = ["| camera | quantity | table | model | residual |", "|---|---|---|---|---|"]
    for name in camera_names():
        facts, camera = read_catalogue("cameras")["cameras"][name], load_camera(name)
        stamp = telescope_psf(camera, field_of_view=5.0)
        psf = effective_psf(stamp, camera.oversampling, detector_kernel(camera))
        scale = camera.pixel_scale / camera.oversampling
        width = full_width_half_maximum(psf, scale)
        wanted = float(facts["fwhm_arcsec"]["value"])
        lines.append(f"| {name} | FWHM [arcsec] | {wanted:.3f} | {width:.3f} | {width - wanted:+.3f} |")
        for table, entry in facts["encircled_energy"].items():
            if not isinstance(entry, dict) or "radius_arcsec" not in entry:
                continue
            radii, fraction = np.array(entry["radius_arcsec"]), np.array(entry["fraction"])
            chosen = [k for k, r in enumerate(radii) if r in {0.05, 0.1, 0.2, 0.3, 0.5, 1.0, 2.0}]
            model = encircled_energy(psf, scale, radii[chosen])
            for radius, want, got in zip(radii[chosen], fraction[chosen], model, strict=True):
                lines.append(f'| {name} | EE({radius:g}") {table} | {want:.3f} | {got:.3f} | {got - want:+.3f} |')
    return lines


def psf_steps() -> list[str]:
    """Convergence of the optical PSF with the pupil grid, and what it costs the first time."""
    lines = ["| camera | pupil grid | of the peak | seconds, once a process |", "|---|---|---|---|"]
    for name in camera_names():
        camera = load_camera(name)
        fine = telescope_psf(camera, field_of_view=2.0, pupil_pixels=1024)
        for pixels in (128, 256, 512):
            coarse = telescope_psf(camera, field_of_view=2.0, pupil_pixels=pixels)
            error = float(np.abs(coarse - fine).max() / fine.max())
            assert error < 1e-3 or pixels < 512, error
            # A field that nothing else asks for, so that it is computed and not remembered.
            began = time.perf_counter()
            telescope_psf(camera, field_of_view=10.4, jitter=1e-6, pupil_pixels=pixels)
            lines.append(f"| {name} | {pixels} | {error:.1e} | {time.perf_counter() - began:.1f} |")
    return lines


def table(name: str) -> list[str]:
    lines = [f"| {name} | error | | bound | ms | MiB |", "|---|---|---|---|---|---|"]
    for s in steps_of(name):
        error = f"{s.error:.1e} | {s.meaning} | {s.bound:.0e}" if s.meaning else " | | "
        lines.append(f"| {s.name} | {error} | {1e3 * s.seconds:.1f} | {s.mebibytes:.0f} |")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("systems", nargs="*", default=list(system_names()))
    parser.add_argument("--write", type=Path, help="the Markdown file that is written as well")
    arguments = parser.parse_args()
    with threadpool_limits(1):
        lines = ["## The PSF against the handbooks", "", *psf_table(), "", "## The PSF and its pupil grid", ""]
        lines += psf_steps()
        for name in arguments.systems:
            lines += ["", f"## {name}", "", *table(name)]
            print("\n".join(lines[-14:]), flush=True)
    if arguments.write:
        title = "# The forward simulation: error, time and memory of each step\n\n"
        how = "Written by `make tables`, one core, host of n = 4, R_eff = 0.3 arcsec, 20.5 mag.\n\n"
        arguments.write.parent.mkdir(parents=True, exist_ok=True)
        arguments.write.write_text(title + how + "\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
