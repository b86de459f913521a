"""Sersic profiles as functions of six shape parameters, with their derivatives, averaged over cells.

The parameters are (ln r_eff, e1, e2, x, y, n), with e = (1 - q)/(1 + q) and (e1, e2) = e (cos 2 phi, sin 2 phi):
nothing is singular where the profile is round. Brightness is for unit flux; the flux is solved for elsewhere.

A cell is a parallelogram. Far from the centre of the profile four points (2 x 2 Gauss-Legendre) give its mean; nearer
it is cut into four, level by level, so that the cusp costs a few hundred points wherever it lies.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.special import gammaincinv

from engine.compiled import inlined_kernel, kernel
from engine.conventions import FloatArray
from engine.light.sersic import SersicProfile, sersic_k, sersic_normalisation

PARAMETERS = ("ln_r_eff", "e1", "e2", "x", "y", "n")
LN_R_EFF, E1, E2, X, Y, N = range(len(PARAMETERS))
COLUMNS = len(PARAMETERS) + 1
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


def shape_of(profile: SersicProfile) -> FloatArray:
    """The six parameters of a profile."""
    e = (1.0 - profile.q) / (1.0 + profile.q)
    angle = 2.0 * profile.phi
    return np.array(
        [math.log(profile.r_eff), e * math.cos(angle), e * math.sin(angle), profile.x, profile.y, profile.n]
    )


def profile_of(shape: FloatArray, flux: float) -> SersicProfile:
    """The profile of six parameters and a flux [e-/s]."""
    ln_r, e1, e2, x, y, n = (float(value) for value in shape)
    e = math.hypot(e1, e2)
    return SersicProfile(flux, math.exp(ln_r), n, (1.0 - e) / (1.0 + e), 0.5 * math.atan2(e2, e1), x, y)


def shape_arguments(shape: FloatArray) -> FloatArray:
    """Packed constants of a shape for the kernels.

    I_0, k, 1/(2n), 1/r_eff^2, e1, e2, x, y, d ln I_0/dn, dk/dn, n, 1 + e^2, 1/(1 - e^2), radius of the core.
    """
    ln_r, e1, e2, x, y, n = (float(value) for value in shape)
    radius, step = math.exp(ln_r), _INDEX_STEP * n
    k, i0 = sersic_k(n), sersic_normalisation(n, radius)
    rise_i0 = math.log(sersic_normalisation(n + step, radius) / sersic_normalisation(n - step, radius))
    rise_k = sersic_k(n + step) - sersic_k(n - step)
    e2_total = e1 * e1 + e2 * e2
    return np.array(
        [
            i0,
            k,
            0.5 / n,
            1.0 / radius**2,
            e1,
            e2,
            x,
            y,
            0.5 * rise_i0 / step,
            0.5 * rise_k / step,
            n,
            1.0 + e2_total,
            1.0 / (1.0 - e2_total),
            radius * (float(gammaincinv(2.0 * n, _CORE_SHARE)) / k) ** n,
        ]
    )


@inlined_kernel
def add_point(x: float, y: float, weight: float, c: FloatArray, out: FloatArray) -> None:
    """Add ``weight`` times derivatives and brightness (COLUMNS,) at a point; ``c`` from :func:`shape_arguments`.

    With rho^2 = dx^2 + dy^2 the elliptical radius is
    r_eff^2 z = [(1 + e^2) rho^2 - 2 e1 (dx^2 - dy^2) - 4 e2 dx dy] / (1 - e^2), and I = I_0 exp(-k z^(1/2n)).
    """
    dx, dy = x - c[6], y - c[7]
    rho2, along, across = dx * dx + dy * dy, dx * dx - dy * dy, 2.0 * dx * dy
    radius2 = c[12] * (c[11] * rho2 - 2.0 * (c[4] * along + c[5] * across))
    z = max(radius2 * c[3], 1e-40)
    ln_z = math.log(z)
    exponent = c[1] * math.exp(c[2] * ln_z)
    value = weight * c[0] * math.exp(-exponent)
    by_z = -value * exponent * c[2] / z
    by_radius2 = by_z * c[3]
    out[0] += -2.0 * value - 2.0 * z * by_z
    out[1] += by_radius2 * 2.0 * c[12] * (c[4] * rho2 - along + c[4] * radius2)
    out[2] += by_radius2 * 2.0 * c[12] * (c[5] * rho2 - across + c[5] * radius2)
    out[3] -= by_radius2 * 2.0 * c[12] * (c[11] * dx - 2.0 * (c[4] * dx + c[5] * dy))
    out[4] -= by_radius2 * 2.0 * c[12] * (c[11] * dy - 2.0 * (c[5] * dx - c[4] * dy))
    out[5] += value * (c[8] - exponent * (c[9] / c[1] - ln_z * c[2] / c[10]))
    out[6] += value


@kernel
def add_cell(
    x: float,
    y: float,
    ax: float,
    ay: float,
    bx: float,
    by: float,
    weight: float,
    c: FloatArray,
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
        dx, dy = px - c[6], py - c[7]
        near = dx * dx + dy * dy <= (_CLEARANCE * size) ** 2
        if not near or depth >= _MAX_DEPTH or size < c[13]:
            by_x, by_y = out[3], out[4]
            part = 0.25 * weight * scale * scale
            step = _GAUSS * scale
            for k in range(4):
                s = step if k % 2 else -step
                t = step if k // 2 else -step
                add_point(px + s * ax + t * bx, py + s * ay + t * by, part, c, out)
            if near:
                # In the core the derivatives by the centre are odd and cancel; four points beside a pole do not.
                out[3], out[4] = by_x, by_y
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
def _grid_columns(x_edges: FloatArray, y_edges: FloatArray, c: FloatArray) -> FloatArray:
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
    return np.asarray(_grid_columns(x_edges, y_edges, shape_arguments(shape)))


def profile_on_grid(profile: SersicProfile, x_edges: FloatArray, y_edges: FloatArray) -> FloatArray:
    """Mean surface brightness [e-/s arcsec^-2] of a profile over the cells between edges, (ny nx,)."""
    return np.asarray(profile.flux * columns_on_grid(shape_of(profile), x_edges, y_edges)[:, -1])
