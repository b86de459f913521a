"""Integration of single pixels by splitting them into cells, level by level.

A cell is integrated by the 3 x 3 Gauss-Legendre rule, and compared with the 2 x 2 rule. It is split into four where
the two disagree, or where it may hold the cusp, which hides from both: there the bounds of
:mod:`engine.light.brightness_bounds` must have come close enough. The cells of a level are traced together, so that
the ray tracer works on long arrays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from engine.compiled import kernel
from engine.conventions import FloatArray
from engine.light.brightness_bounds import brightness_range, length
from engine.light.radial_table import look_up

Tracer = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
"""From image positions [arcsec] to the profile's axes; one-dimensional arrays."""

MAX_DEPTH = 40
"""Halvings of a pixel's side at most: a backstop that no finite profile needs at a tolerance above rounding."""

_CUSP_SHARE = 1.0 / 16.0
"""Part of a pixel's tolerance for a cell with the cusp; there are as many as its neighbours, whatever the level."""

_CLEARANCE = 1.0
"""Distance of a cell from the cusp in units of its size from which both rules see it."""

_G3 = math.sqrt(0.6)
_G2 = 1.0 / math.sqrt(3.0)
_W3_CENTRE, _W3_SIDE = 4.0 / 9.0, 5.0 / 18.0

_BATCH = 1024
"""Cells integrated together: their rays stay in the cache."""

NODES = 9
"""Of the 3 x 3 rule, whose weights are :data:`WEIGHTS`."""

# Nodes of the 3 x 3 rule row by row, then of the 2 x 2 rule, in units of half a side.
NODE_X = np.array([-_G3, 0.0, _G3] * 3 + [-_G2, _G2] * 2)
NODE_Y = np.array([-_G3] * 3 + [0.0] * 3 + [_G3] * 3 + [-_G2] * 2 + [_G2] * 2)
WEIGHTS = np.outer([_W3_SIDE, _W3_CENTRE, _W3_SIDE], [_W3_SIDE, _W3_CENTRE, _W3_SIDE]).ravel()


@dataclass(frozen=True)
class Leaves:
    """The cells that pixels were cut into: centres (n,), half a side (n,) [arcsec], and each one's pixel (n,)."""

    x: FloatArray
    y: FloatArray
    half: FloatArray
    owner: NDArray[np.int64]

    def nodes(self) -> tuple[FloatArray, FloatArray]:
        """Positions (9 n,) of the nodes of the 3 x 3 rule."""
        x = self.x[:, None] + np.multiply.outer(self.half, NODE_X[:NODES])
        y = self.y[:, None] + np.multiply.outer(self.half, NODE_Y[:NODES])
        return x.ravel(), y.ravel()

    def of(self, pixels: NDArray[np.intp]) -> Leaves:
        """The same cells, with their pixels known by other numbers."""
        return replace(self, owner=pixels[self.owner])


def joined(parts: Sequence[Leaves]) -> Leaves:
    """All cells of some renderings."""
    if not parts:
        nothing = np.empty(0)
        return Leaves(nothing, nothing, nothing, nothing.astype(np.int64))
    columns = [[getattr(part, field.name) for part in parts] for field in fields(Leaves)]
    return Leaves(*(np.concatenate(column) for column in columns))


@dataclass(frozen=True)
class _Cells:
    """Cells of one level: centres (n,) [arcsec], and the index of the pixel that each belongs to."""

    x: FloatArray
    y: FloatArray
    owner: NDArray[np.int64]

    def nodes(self, part: slice, half: float) -> tuple[FloatArray, FloatArray]:
        """Positions (13 n,) of the nodes of both rules for n of the cells."""
        return np.add.outer(self.x[part], half * NODE_X).ravel(), np.add.outer(self.y[part], half * NODE_Y).ravel()

    def split(self, chosen: NDArray[np.bool_], half: float) -> _Cells:
        """The four quarters of each chosen cell."""
        step = 0.5 * half
        return _Cells(
            np.add.outer(self.x[chosen], step * np.array([-1.0, 1.0, -1.0, 1.0])).ravel(),
            np.add.outer(self.y[chosen], step * np.array([-1.0, -1.0, 1.0, 1.0])).ravel(),
            np.repeat(self.owner[chosen], 4),
        )


@kernel
def _integrate(
    u: FloatArray,
    v: FloatArray,
    area: float,
    weights: FloatArray,
    table: FloatArray,
    flux: FloatArray,
    certain: FloatArray,
    error: FloatArray,
    smooth: NDArray[np.bool_],
) -> None:
    """Flux of each of n cells, the part of it that is certain, an estimate of its error, and whether it is smooth.

    ``u`` and ``v`` (13 n,) are where the nodes of a cell map to, in axes of the profile; ``area`` [arcsec^2] is a
    cell's, ``weights`` (9,) are those of the 3 x 3 rule, ``table`` (bins, 4) is the radial one; the rest is (n,).
    """
    for i in range(flux.size):
        k = 13 * i
        three, two = 0.0, 0.0
        for j in range(9):
            three += weights[j] * look_up(u[k + j] ** 2 + v[k + j] ** 2, table)
        for j in range(9, 13):
            two += 0.25 * look_up(u[k + j] ** 2 + v[k + j] ** 2, table)
        u0, v0 = u[k + 4], v[k + 4]
        # Differences between nodes, carried on to the sides of the cell and to its corners.
        xx = length(u[k + 5] + u[k + 3] - 2.0 * u0, v[k + 5] + v[k + 3] - 2.0 * v0)
        yy = length(u[k + 7] + u[k + 1] - 2.0 * u0, v[k + 7] + v[k + 1] - 2.0 * v0)
        xy = length(u[k + 8] - u[k + 6] - u[k + 2] + u[k], v[k + 8] - v[k + 6] - v[k + 2] + v[k])
        least, most, smooth[i] = brightness_range(
            u0,
            v0,
            (u[k + 5] - u[k + 3]) / (2.0 * _G3),
            (v[k + 5] - v[k + 3]) / (2.0 * _G3),
            (u[k + 7] - u[k + 1]) / (2.0 * _G3),
            (v[k + 7] - v[k + 1]) / (2.0 * _G3),
            (0.5 * xx + 0.5 * yy + 0.25 * xy) / (_G3 * _G3),
            _CLEARANCE,
            table,
        )
        flux[i] = min(max(three, least), most) * area
        certain[i] = least * area
        error[i] = min(abs(three - two), most - least) * area if smooth[i] else (most - least) * area


def _judge(
    cells: _Cells, half: float, trace: Tracer, table: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, NDArray[np.bool_]]:
    """Flux, certain flux, error and smoothness of the cells of a level, a batch at a time."""
    n = cells.x.size
    flux, certain, error, smooth = np.empty(n), np.empty(n), np.empty(n), np.empty(n, dtype=np.bool_)
    for start in range(0, n, _BATCH):
        part = slice(start, start + _BATCH)
        u, v = trace(*cells.nodes(part, half))
        _integrate(u, v, (2.0 * half) ** 2, WEIGHTS, table, flux[part], certain[part], error[part], smooth[part])
    return flux, certain, error, smooth


def refine_pixels(
    x: FloatArray,
    y: FloatArray,
    side: float,
    trace: Tracer,
    table: FloatArray,
    *,
    absolute: float = 0.0,
    relative: float = 0.0,
) -> tuple[FloatArray, Leaves]:
    """Flux (n,) of pixels with centres ``x``, ``y`` (n,) and given side [arcsec], and the cells they were cut into.

    The estimated error of each pixel is at most ``absolute``, or ``relative`` times the brightest of these pixels
    where that is more; ``trace`` and ``table`` are the profile's.
    """
    total = np.zeros(x.size)
    cells = _Cells(x, y, np.arange(x.size))
    parts: list[Leaves] = []
    for depth in range(MAX_DEPTH + 1):
        half = side * 0.5 ** (depth + 1)
        flux, certain, error, smooth = _judge(cells, half, trace, table)
        brightest = (total + np.bincount(cells.owner, weights=certain, minlength=x.size)).max()
        limit = max(absolute, relative * brightest)
        # Smooth cells lie along an arc or round the cusp, twice as many at each level: each may have its share only.
        rough = error > limit * np.where(smooth, 0.5**depth, _CUSP_SHARE)
        if depth == MAX_DEPTH:
            rough[:] = False
        done = ~rough
        owner = cells.owner[done]
        total += np.bincount(owner, weights=flux[done], minlength=x.size)
        parts.append(Leaves(cells.x[done], cells.y[done], np.full(owner.size, half), owner))
        if not rough.any():
            break
        cells = cells.split(rough, half)
    return total, joined(parts)
