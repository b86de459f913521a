"""Sersic profiles as functions of six shape parameters, with their derivatives, averaged over cells.

The parameters are those of :data:`engine.light.sersic.SHAPE`: nothing is singular where the profile is round.
Brightness is for unit flux; the flux is solved for elsewhere.

A cell is a parallelogram. Far from the centre of the profile four points (2 x 2 Gauss-Legendre) give its mean; nearer
it is cut into four, level by level, so that the cusp costs a few hundred points wherever it lies.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.special import gammaincinv

from engine.compiled import inlined_kernel, kernel
from engine.conventions import FloatArray
from engine.light.sersic import SHAPE, SersicProfile, sersic_k, sersic_normalisation, shape_of

LN_R_EFF, N, E1, E2, X, Y = range(len(SHAPE))
BRIGHTNESS = len(SHAPE)
COLUMNS = BRIGHTNESS + 1
"""Derivatives by each parameter, then the brightness itself."""

MAX_ELLIPTICITY = 0.6
"""Bound of e1 and of e2: q is above 0.08, and above 0.25 along the axes."""

_INDEX_STEP = 1e-5
_CORE_SHARE = 3e-3
"""A cell of the size of the core that holds this share of the flux is not cut any more."""
_MAX_DEPTH = 10
"""Halvings of a cell at most."""
_CLEARANCE = 1.5
"""Distance from the centre, in units of a cell's size, from which four points give the mean to 1e-3 of itself."""
_STACK = 3 * _MAX_DEPTH + 4
_GAUSS = 1.0 / math.sqrt(3.0)


class ShapeConstants(NamedTuple):
    """A shape as the kernels take it: I = central exp(-k z^half_inverse_n), z = R^2 inverse_r2.

    ``ln_central_by_n`` and ``k_by_n`` are derivatives; ``stretch`` is 1 + e^2 and ``squeeze`` 1 / (1 - e^2);
    ``core`` is the radius of the core [arcsec].
    """

    central: float
    k: float
    half_inverse_n: float
    inverse_r2: float
    e1: float
    e2: float
    x: float
    y: float
    ln_central_by_n: float
    k_by_n: float
    n: float
    stretch: float
    squeeze: float
    core: float


def shape_constants(shape: FloatArray) -> ShapeConstants:
    """The constants of a shape (6,)."""
    ln_r, n, e1, e2, x, y = (float(value) for value in shape)
    radius, step = math.exp(ln_r), _INDEX_STEP * n
    k, central = sersic_k(n), sersic_normalisation(n, radius)
    rise = math.log(sersic_normalisation(n + step, radius) / sersic_normalisation(n - step, radius))
    rise_k = sersic_k(n + step) - sersic_k(n - step)
    e_squared = e1 * e1 + e2 * e2
    return ShapeConstants(
        central=central,
        k=k,
        half_inverse_n=0.5 / n,
        inverse_r2=1.0 / radius**2,
        e1=e1,
        e2=e2,
        x=x,
        y=y,
        ln_central_by_n=0.5 * rise / step,
        k_by_n=0.5 * rise_k / step,
        n=n,
        stretch=1.0 + e_squared,
        squeeze=1.0 / (1.0 - e_squared),
        core=radius * (float(gammaincinv(2.0 * n, _CORE_SHARE)) / k) ** n,
    )


@inlined_kernel
def add_point(x: float, y: float, weight: float, c: ShapeConstants, out: FloatArray) -> None:
    """Add ``weight`` times derivatives and brightness (COLUMNS,) at a point; ``c`` from :func:`shape_constants`.

    With rho^2 = dx^2 + dy^2 the elliptical radius is
    r_eff^2 z = [(1 + e^2) rho^2 - 2 e1 (dx^2 - dy^2) - 4 e2 dx dy] / (1 - e^2), and I = I_0 exp(-k z^(1/2n)).
    """
    dx, dy = x - c.x, y - c.y
    rho2, along, across = dx * dx + dy * dy, dx * dx - dy * dy, 2.0 * dx * dy
    radius2 = c.squeeze * (c.stretch * rho2 - 2.0 * (c.e1 * along + c.e2 * across))
    z = max(radius2 * c.inverse_r2, 1e-40)
    ln_z = math.log(z)
    exponent = c.k * math.exp(c.half_inverse_n * ln_z)
    value = weight * c.central * math.exp(-exponent)
    by_z = -value * exponent * c.half_inverse_n / z
    by_radius2 = by_z * c.inverse_r2
    out[LN_R_EFF] += -2.0 * value - 2.0 * z * by_z
    out[E1] += by_radius2 * 2.0 * c.squeeze * (c.e1 * rho2 - along + c.e1 * radius2)
    out[E2] += by_radius2 * 2.0 * c.squeeze * (c.e2 * rho2 - across + c.e2 * radius2)
    out[X] -= by_radius2 * 2.0 * c.squeeze * (c.stretch * dx - 2.0 * (c.e1 * dx + c.e2 * dy))
    out[Y] -= by_radius2 * 2.0 * c.squeeze * (c.stretch * dy - 2.0 * (c.e2 * dx - c.e1 * dy))
    out[N] += value * (c.ln_central_by_n - exponent * (c.k_by_n / c.k - ln_z * c.half_inverse_n / c.n))
    out[BRIGHTNESS] += value


@kernel
def add_cell(
    x: float,
    y: float,
    ax: float,
    ay: float,
    bx: float,
    by: float,
    weight: float,
    c: ShapeConstants,
    out: FloatArray,
    stack: FloatArray,
) -> None:
    """Add ``weight`` times the mean over the parallelogram (x, y) + s (ax, ay) + t (bx, by), s and t in [-1, 1].

    ``stack`` is scratch from :func:`new_stack`.
    """
    size0 = math.sqrt(ax * ax + ay * ay) + math.sqrt(bx * bx + by * by)
    stack[0, 0], stack[0, 1], stack[0, 2] = x, y, 0.0
    held = 1
    while held > 0:
        held -= 1
        px, py, depth = stack[held, 0], stack[held, 1], stack[held, 2]
        scale = 0.5**depth
        size = size0 * scale
        dx, dy = px - c.x, py - c.y
        near = dx * dx + dy * dy <= (_CLEARANCE * size) ** 2
        if not near or depth >= _MAX_DEPTH or size < c.core:
            by_x, by_y = out[X], out[Y]
            part = 0.25 * weight * scale * scale
            step = _GAUSS * scale
            for k in range(4):
                s = step if k % 2 else -step
                t = step if k // 2 else -step
                add_point(px + s * ax + t * bx, py + s * ay + t * by, part, c, out)
            if near:
                # In the core the derivatives by the centre are odd and cancel; four points beside a pole do not.
                out[X], out[Y] = by_x, by_y
        else:
            half = 0.5 * scale
            for k in range(4):
                s = half if k % 2 else -half
                t = half if k // 2 else -half
                stack[held, 0] = px + s * ax + t * bx
                stack[held, 1] = py + s * ay + t * by
                stack[held, 2] = depth + 1.0
                held += 1


@inlined_kernel
def new_stack() -> FloatArray:
    """Scratch for :func:`add_cell`."""
    return np.empty((_STACK, 3))


@kernel
def _grid_columns(x_edges: FloatArray, y_edges: FloatArray, c: ShapeConstants) -> FloatArray:
    """Means (ny nx, COLUMNS) over the cells between edges (nx + 1,) and (ny + 1,) [arcsec]."""
    nx, ny = x_edges.size - 1, y_edges.size - 1
    out = np.empty((nx * ny, COLUMNS))
    total, stack = np.empty(COLUMNS), new_stack()
    for j in range(ny):
        y, half_y = 0.5 * (y_edges[j] + y_edges[j + 1]), 0.5 * (y_edges[j + 1] - y_edges[j])
        for i in range(nx):
            x, half_x = 0.5 * (x_edges[i] + x_edges[i + 1]), 0.5 * (x_edges[i + 1] - x_edges[i])
            total[:] = 0.0
            add_cell(x, y, half_x, 0.0, 0.0, half_y, 1.0, c, total, stack)
            out[j * nx + i] = total
    return out


def columns_on_grid(shape: FloatArray, x_edges: FloatArray, y_edges: FloatArray) -> FloatArray:
    """Mean of derivatives and brightness over the cells between edges: (ny nx, COLUMNS), for unit flux [arcsec^-2]."""
    return np.asarray(_grid_columns(x_edges, y_edges, shape_constants(shape)))


def profile_on_grid(profile: SersicProfile, x_edges: FloatArray, y_edges: FloatArray) -> FloatArray:
    """Mean surface brightness [e-/s arcsec^-2] of a profile over the cells between edges, (ny nx,)."""
    return np.asarray(profile.flux * columns_on_grid(shape_of(profile), x_edges, y_edges)[:, BRIGHTNESS])
