"""Light of the source maps themselves inside a circle: no profile is fitted, none can be wrong."""

from __future__ import annotations

import math

import numpy as np

from engine.conventions import FloatArray
from engine.source.grid import SourceGrid

RADIUS = 1.0
"""Radius of the aperture [arcsec], in the source plane."""

_RINGS, _SPOKES = 48, 96


def aperture_points(radius: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Offsets x, y [arcsec] and areas [arcsec^2] of points that cover a circle: rings of equal width."""
    edges = np.linspace(0.0, radius, _RINGS + 1)
    middle = 0.5 * (edges[1:] + edges[:-1])
    angle = 2.0 * math.pi * (np.arange(_SPOKES) + 0.5) / _SPOKES
    area = math.pi * np.diff(edges**2) / _SPOKES
    return (
        np.outer(middle, np.cos(angle)).ravel(),
        np.outer(middle, np.sin(angle)).ravel(),
        np.repeat(area, _SPOKES),
    )


def _place(values: FloatArray, nodes: FloatArray) -> tuple[np.ndarray, FloatArray, np.ndarray]:
    """Cell, position within it, and whether it is on the axis at all."""
    cell = np.clip(np.searchsorted(nodes, values) - 1, 0, nodes.size - 2)
    fraction = (values - nodes[cell]) / (nodes[cell + 1] - nodes[cell])
    return cell, fraction, (values >= nodes[0]) & (values <= nodes[-1])


def aperture_flux(grid: SourceGrid, source: FloatArray, x: float, y: float, radius: float) -> tuple[float, float]:
    """Flux [e-/s] of a source map (ny, nx) within ``radius`` of (x, y), and the share of the circle that has a map.

    The map is bilinear between its nodes; beyond the grid there is nothing.
    """
    dx, dy, area = aperture_points(radius)
    i, u, in_x = _place(x + dx, grid.x)
    j, v, in_y = _place(y + dy, grid.y)
    inside = in_x & in_y
    lower = (1.0 - u) * source[j, i] + u * source[j, i + 1]
    upper = (1.0 - u) * source[j + 1, i] + u * source[j + 1, i + 1]
    light = np.where(inside, (1.0 - v) * lower + v * upper, 0.0)
    return float(light @ area), float(area[inside].sum() / area.sum())
