"""Hosts before and behind a lens: what a galaxy is, and what is left of it in an image."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from engine.conventions import pixel_centres
from engine.figures.sky import corner_label, empty_sky_noise, half_field, scale_bar, show, stretch
from engine.light.galaxy import light_on_grid
from engine.simulation.simulate import Simulation

_CELLS = 180
_RADII = 4.0
_ROW = 6


def hosts_figure(simulations: Sequence[Simulation]) -> Figure:
    """Each simulation's host in the source plane, to four half-light radii, and below it its drizzled arc, noiseless.

    Galaxies have an asinh stretch to their brightest cell, linear within a hundredth of it; arcs one in units of the
    noise of the empty sky.
    """
    rows, columns = -(-len(simulations) // _ROW), min(len(simulations), _ROW)
    figure = Figure(figsize=(1.75 * columns, 3.75 * rows + 0.3), layout=ConstrainedLayoutEngine(w_pad=0.02, h_pad=0.02))
    axes = figure.subplots(2 * rows, columns, squeeze=False)
    for panel in axes.flat:
        panel.set_axis_off()
    for place, simulation in enumerate(simulations):
        row, column = divmod(place, _ROW)
        above, below = axes[2 * row, column], axes[2 * row + 1, column]
        host, observation = simulation.scene.host, simulation.observation
        side = 2.0 * _RADII * host.r_eff / _CELLS
        edges = pixel_centres(_CELLS + 1, side)
        galaxy = light_on_grid(host, host.x + edges, host.y + edges).reshape(_CELLS, _CELLS)
        peak = float(np.quantile(galaxy, 0.9995))
        half = half_field(observation.image, observation.pixel_scale)
        sigma = empty_sky_noise(observation.noise)
        above.set_axis_on()
        below.set_axis_on()
        show(above, galaxy, side, stretch(peak / 300.0, peak), _RADII * host.r_eff)
        show(
            below,
            simulation.arc / sigma,
            observation.pixel_scale,
            stretch(1.0, float(simulation.arc.max()) / sigma),
            half,
        )
        above.set_title(str(observation.provenance["HOST"]), fontsize=8.5)
        corner_label(above, f"q {host.q:.2f}", fontsize=7)
        scale_bar(above, _RADII * host.r_eff, fontsize=7)
        scale_bar(below, half, fontsize=7)
    return figure
