"""Sersic light on a grid with its derivatives by the profile's shape and the lens, from one ray tracing.

The derivatives of an image that was integrated adaptively are integrals over the same cells: a pixel that one ray was
enough for has the mean of its derivatives' differences, a pixel that was refined the sum over the cells it was cut into
(:class:`engine.light.refinement.Leaves`). Where cells are cut is not differentiated, so that nothing jumps.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from engine.compiled import inlined_kernel, kernel
from engine.conventions import FloatArray
from engine.lensing.power_law import PowerLawLens
from engine.lensing.ray_derivatives import LENS_DERIVATIVES, RayConstants, ray_constants, ray_derivatives
from engine.light.cell_means import E1, E2, LN_R_EFF, N, ShapeConstants, X, Y, shape_constants
from engine.light.radial_table import look_up_derivatives, tabulate
from engine.light.refinement import NODES, WEIGHTS, Leaves
from engine.light.rendering import HALO, axis_with_halo
from engine.light.sersic import SHAPE, SersicProfile, shape_of
from engine.work import count

_SHEAR_DERIVATIVES = 2
_INDEX_STEP = 1e-4


@inlined_kernel
def _shape_derivatives(
    x: float, y: float, c: ShapeConstants, table: FloatArray, by_n: FloatArray, out: FloatArray
) -> None:
    """Derivatives (SHAPE,) of the brightness at a point of the profile's plane, for unit flux.

    The radius is that of :func:`engine.light.cell_means.add_point`; brightness and its slopes are from the tables.
    """
    dx, dy = x - c.x, y - c.y
    rho2, along, across = dx * dx + dy * dy, dx * dx - dy * dy, 2.0 * dx * dy
    radius2 = c.squeeze * (c.stretch * rho2 - 2.0 * (c.e1 * along + c.e2 * across))
    z = radius2 * c.inverse_r2
    value, by_z, out[N] = look_up_derivatives(z, table, by_n)
    by_radius2 = 2.0 * c.squeeze * c.inverse_r2 * by_z
    out[LN_R_EFF] = -2.0 * (value + z * by_z)
    out[E1] = by_radius2 * (c.e1 * rho2 - along + c.e1 * radius2)
    out[E2] = by_radius2 * (c.e2 * rho2 - across + c.e2 * radius2)
    out[X] = -by_radius2 * (c.stretch * dx - 2.0 * (c.e1 * dx + c.e2 * dy))
    out[Y] = -by_radius2 * (c.stretch * dy - 2.0 * (c.e2 * dx - c.e1 * dy))


@inlined_kernel
def _lens_derivatives(
    x: float, y: float, by_x: FloatArray, by_y: FloatArray, shape: FloatArray, out: FloatArray
) -> None:
    """Derivatives by the lens, with shear or without, at an image position, from those by the shape's centre."""
    for k in range(LENS_DERIVATIVES):
        out[k] = -(shape[X] * by_x[k] + shape[Y] * by_y[k])
    if out.size > LENS_DERIVATIVES:
        out[LENS_DERIVATIVES] = shape[X] * x - shape[Y] * y
        out[LENS_DERIVATIVES + 1] = shape[X] * y + shape[Y] * x


@kernel
def _seen_directly(
    x: FloatArray, y: FloatArray, shape: ShapeConstants, table: FloatArray, by_n: FloatArray, out: FloatArray
) -> None:
    """Derivatives (6, k) by the shape at positions (k,)."""
    found = np.empty(6)
    for i in range(x.size):
        _shape_derivatives(x[i], y[i], shape, table, by_n, found)
        out[:, i] = found


@kernel
def _seen_through_lens(
    x: FloatArray,
    y: FloatArray,
    shape: ShapeConstants,
    lens: RayConstants,
    table: FloatArray,
    by_n: FloatArray,
    out: FloatArray,
) -> None:
    """Derivatives (lens + 6, k) by lens and shape at image positions (k,)."""
    first = out.shape[0] - 6
    found, of_lens = np.empty(6), np.empty(first)
    by_x, by_y = np.empty(LENS_DERIVATIVES), np.empty(LENS_DERIVATIVES)
    for i in range(x.size):
        bx, by = ray_derivatives(x[i], y[i], lens, by_x, by_y)
        _shape_derivatives(bx, by, shape, table, by_n, found)
        _lens_derivatives(x[i], y[i], by_x, by_y, found, of_lens)
        out[:first, i] = of_lens
        out[first:, i] = found


@kernel
def _mean_over_pixels(values: FloatArray, side: float, out: FloatArray) -> None:
    """Integrals (k, ny, nx) over pixels of fields (k, ny + 4, nx + 4): the rule of the first pass of a rendering."""
    for m in range(values.shape[0]):
        f = values[m]
        for j in range(out.shape[1]):
            for i in range(out.shape[2]):
                r, c = j + HALO, i + HALO
                f0 = f[r, c]
                sides = f[r, c - 1] + f[r, c + 1] + f[r - 1, c] + f[r + 1, c]
                corners = f[r - 1, c - 1] + f[r - 1, c + 1] + f[r + 1, c - 1] + f[r + 1, c + 1]
                fourth = f[r, c - 2] + f[r, c + 2] + f[r - 2, c] + f[r + 2, c] - 4.0 * sides + 12.0 * f0
                mixed = corners - 2.0 * sides + 4.0 * f0
                mean = f0 + (sides - 4.0 * f0) / 24.0 - fourth * (17.0 / 5760.0) + mixed / 576.0
                out[m, j, i] = mean * side * side


@kernel
def _sum_over_cells(
    values: FloatArray,
    weights: FloatArray,
    area: FloatArray,
    owner: NDArray[np.int64],
    out: FloatArray,
) -> None:
    """Add integrals over n cells, of derivatives at their nodes (k, 9 n), to their pixels' in ``out`` (k, pixels)."""
    for m in range(values.shape[0]):
        for i in range(owner.size):
            total = 0.0
            for j in range(NODES):
                total += weights[j] * values[m, NODES * i + j]
            out[m, owner[i]] += total * area[i]


class LightDerivatives:
    """Derivatives of a profile's light, behind a lens or not, by :data:`engine.light.sersic.SHAPE` and the lens.

    With a lens those by theta_E, e1, e2, slope, x and y come first, then, with ``shear``, those by gamma1 and gamma2.
    Light is that of unit flux.
    """

    def __init__(self, profile: SersicProfile, lens: PowerLawLens | None, *, shear: bool = True) -> None:
        self._shape = shape_constants(shape_of(profile))
        self._lens = None if lens is None else ray_constants(lens)
        self._table = tabulate(profile)
        step = _INDEX_STEP * profile.n
        ahead, behind = (tabulate(replace(profile, n=profile.n + side * step)) for side in (1.0, -1.0))
        self._by_n = (ahead - behind) * (0.5 / step)
        of_lens = LENS_DERIVATIVES + (_SHEAR_DERIVATIVES if shear else 0)
        self.size = len(SHAPE) + (0 if lens is None else of_lens)

    def at(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Derivatives (size, k) of the surface brightness at image positions (k,) [arcsec]."""
        out = np.empty((self.size, x.size))
        if self._lens is None:
            _seen_directly(x, y, self._shape, self._table, self._by_n, out)
        else:
            _seen_through_lens(x, y, self._shape, self._lens, self._table, self._by_n, out)
            count("rays_traced", x.size)
        return out

    def sampled(self, x: FloatArray, y: FloatArray, side: float) -> FloatArray:
        """Derivatives (size, ny, nx) of :func:`engine.light.rendering.sample_sersic`."""
        out = self.at(np.tile(x, y.size), np.repeat(y, x.size)).reshape(self.size, y.size, x.size) * side**2
        count("pixels_rendered", out.size)
        return out

    def integrated(self, x: FloatArray, y: FloatArray, side: float, leaves: Leaves) -> FloatArray:
        """Derivatives (size, ny, nx) of a rendering whose refined pixels were cut into ``leaves``."""
        columns, rows = axis_with_halo(x, side, "x"), axis_with_halo(y, side, "y")
        rays = self.at(np.tile(columns, rows.size), np.repeat(rows, columns.size))
        out = np.empty((self.size, y.size, x.size))
        count("pixels_rendered", out.size)
        _mean_over_pixels(rays.reshape(self.size, rows.size, columns.size), side, out)
        flat = out.reshape(self.size, -1)
        flat[:, leaves.owner] = 0.0
        values = self.at(*leaves.nodes())
        _sum_over_cells(values, WEIGHTS, 4.0 * leaves.half**2, leaves.owner, flat)
        return out
