"""Figures of simulations: the steps of one (the paper's Fig. 1), a system's 48 realizations, the eight systems."""

from __future__ import annotations

import math
from collections.abc import Sequence

from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from engine.catalogue import resolve_system
from engine.conventions import FloatArray
from engine.figures.sky import (
    colour_bar,
    compass,
    corner_label,
    empty_sky_noise,
    half_field,
    name_points,
    scale_bar,
    show,
    stretch,
)
from engine.grid import GridRun
from engine.imaging.observation import Observation
from engine.simulation.simulate import Simulation

# Panels this small show arcs, not the sky.
_GALLERY_LINEAR = 10.0
_MONTAGE_LINEAR = 20.0
_MONTAGE_MARGIN = 1.8
_BRIGHTNESS = "e$^-$ s$^{-1}$ arcsec$^{-2}$"


def simulation_figure(simulation: Simulation) -> Figure:
    """The steps of a simulation: arc, with AGN, one exposure without and with noise, drizzled; and the arc drizzled.

    All panels show surface brightness with one stretch.
    """
    observation, geometry, scene = simulation.observation, simulation.exposures.geometry, simulation.scene
    fine, native, drizzled = geometry.subpixel_scale, geometry.pixel_scale, geometry.drizzled_scale
    n = geometry.n_dither
    panels: list[tuple[str, FloatArray, float]] = [
        ("(a) lensed host, before the PSF", simulation.high_resolution_arc, fine),
        (f"(b) + {_others(simulation)}, after the PSF", simulation.high_resolution_image, fine),
        (f"(c) one of {n} exposures, no noise", simulation.exposures.noiseless[0], native),
        ("(d) the same with noise", simulation.exposures.noisy[0], native),
        (f"(e) {n} exposures drizzled", observation.image, drizzled),
        ("(f) lensed host alone, drizzled, no noise", simulation.arc, drizzled),
    ]
    half = half_field(observation.image, drizzled)
    norm = stretch(empty_sky_noise(observation.noise) / drizzled**2, float(observation.image.max()) / drizzled**2)
    figure = Figure(figsize=(10.2, 6.9), layout=ConstrainedLayoutEngine(w_pad=0.03, h_pad=0.03))
    axes = figure.subplots(2, 3)
    for panel, (title, image, scale) in zip(axes.flat, panels, strict=True):
        shown = show(panel, image / scale**2, scale, norm, half)
        panel.set_title(title, fontsize=9)
        corner_label(panel, f"{scale:.3g}″ pixels")
    compass(axes[0, 0], half)
    scale_bar(axes[0, 0], half)
    name_points(axes[1, 1], [(source.name, source.x, source.y) for source in scene.agn], half)
    colour_bar(figure, shown, list(axes.flat), norm, f"{_BRIGHTNESS}, asinh stretch, the same in all panels")
    record = observation.provenance
    host = scene.host
    figure.suptitle(
        f"{scene.system.name}, {scene.camera.name}: host {record.get('HOST_MAG', '')} mag, "
        f"$R_{{eff}}$ {host.r_eff:g}″, {_shape(simulation)}, $l_\\eta$ {scene.lens.slope - 1:.1f}, "
        f"noise level {simulation.exposures.noise.level}",
        fontsize=11,
    )
    return figure


def _shape(simulation: Simulation) -> str:
    """What the host is: its index, or its name."""
    n = simulation.scene.host.n
    return f"{simulation.observation.provenance.get('HOST', 'no profile')}" if n is None else f"$n$ {n:g}"


def _others(simulation: Simulation) -> str:
    scene = simulation.scene
    names = [name for name, there in (("deflector", scene.deflector is not None), ("AGN", bool(scene.agn))) if there]
    return " and ".join(names) or "nothing else"


def montage_figure(runs: Sequence[GridRun], observations: Sequence[Observation]) -> Figure:
    """A system's realizations: a row for each host magnitude, a column for each serial number of the paper's Table 3.

    Raises
    ------
    ValueError
        The runs are not those of one system of the paper in their order.
    """
    columns = 12
    if len(runs) != len(observations) or not runs or len(runs) % columns or any(r.paper_run is None for r in runs):
        raise ValueError(f"runs: got {len(runs)} runs, allowed are one system's of the paper, 12 to a magnitude")
    rows = len(runs) // columns
    first = observations[0]
    brightest = max(float(observation.image.max()) for observation in observations)
    norm = stretch(empty_sky_noise(first.noise), brightest, linear=_MONTAGE_LINEAR)
    half = half_field(first.image, first.pixel_scale)
    agn = resolve_system(runs[0].realization).agn
    if agn:
        half = min(half, _MONTAGE_MARGIN * max(math.hypot(*image.position) for image in agn))
    figure = Figure(figsize=(15.2, 1.19 * rows + 1.05), layout=ConstrainedLayoutEngine(w_pad=0.02, h_pad=0.03))
    axes = figure.subplots(rows, columns, squeeze=False)
    for panel, run, observation in zip(axes.flat, runs, observations, strict=True):
        shown = show(panel, observation.image, observation.pixel_scale, norm, half)
        corner_label(panel, str(run.paper_run), fontsize=7)
    for column in range(columns):
        spec = runs[column].realization
        axes[0, column].set_title(
            f"No. {column + 1}\n$n$ {spec.host.n:g}, {spec.host.r_eff:g}″\n$l_\\eta$ {spec.l_eta:.1f}", fontsize=8
        )
    for row in range(rows):
        axes[row, 0].set_ylabel(f"{runs[row * columns].realization.host.magnitude:.1f} mag", fontsize=9)
    scale_bar(axes[rows - 1, 0], half, fontsize=7)
    compass(axes[rows - 1, 1], half, fontsize=7)
    colour_bar(figure, shown, list(axes.flat), norm, "e$^-$ s$^{-1}$ per pixel, asinh")
    system, camera = first.provenance.get("SYSTEM", ""), first.provenance.get("CAMERA", "")
    figure.suptitle(
        f"{system}, {camera}: the {len(runs)} realizations of the paper "
        f"(numbers as in its Table 3; noise level {first.provenance.get('NOISE', '')}; one stretch)",
        fontsize=11,
    )
    return figure


def gallery_figure(simulations: Sequence[Simulation]) -> Figure:
    """Observation, and the noiseless arc of its host, of several systems, four panels to a row.

    Each image is shown in units of its own empty-sky noise, all with one stretch.
    """
    pairs_in_row = 2
    rows = -(-len(simulations) // pairs_in_row)
    figure = Figure(figsize=(9.6, 2.42 * rows + 0.75), layout=ConstrainedLayoutEngine(w_pad=0.03, h_pad=0.03))
    axes = figure.subplots(rows, 2 * pairs_in_row, squeeze=False)
    sigmas = [empty_sky_noise(simulation.observation.noise) for simulation in simulations]
    peak = max(
        float(simulation.observation.image.max()) / sigma for simulation, sigma in zip(simulations, sigmas, strict=True)
    )
    norm = stretch(1.0, peak, linear=_GALLERY_LINEAR)
    for panel in axes.flat:
        panel.set_axis_off()
    for index, (simulation, sigma) in enumerate(zip(simulations, sigmas, strict=True)):
        row, pair = divmod(index, pairs_in_row)
        left, right = axes[row, 2 * pair], axes[row, 2 * pair + 1]
        observation, scene = simulation.observation, simulation.scene
        half = half_field(observation.image, observation.pixel_scale)
        for panel, image in ((left, observation.image), (right, simulation.arc)):
            panel.set_axis_on()
            shown = show(panel, image / sigma, observation.pixel_scale, norm, half)
        left.set_title(f"{scene.system.name}  {scene.camera.name.replace('_', ' ')}", fontsize=8.5)
        right.set_title(
            f"host alone: {observation.provenance.get('HOST_MAG', '')} mag, {scene.host.r_eff:g}″", fontsize=8.5
        )
        name_points(left, [(source.name, source.x, source.y) for source in scene.agn], half)
        scale_bar(left, half)
        compass(right, half)
    colour_bar(figure, shown, list(axes.flat), norm, "units of the empty-sky noise, asinh stretch, one for all panels")
    first, lens = simulations[0], simulations[0].scene.lens
    figure.suptitle(
        f"Drizzled simulations ({_shape(first)}, $l_\\eta$ {lens.slope - 1:.1f}); "
        "right of each: its lensed host without noise",
        fontsize=11,
    )
    return figure
