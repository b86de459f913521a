"""All images of a point source: cells of the image plane that may hold one, cut finer, and Newton from each.

A cell is kept while the source lies within the mapped cell, with a margin for what the mapping's curvature can hide.
It is cut until the mapping is nearly linear across it and the Jacobian determinant has one sign, because two images
may lie on either side of a critical curve; from the corners and the centre of what is left, Newton's method finds the
images to rounding. Images found twice are merged.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from engine.compiled import inlined_kernel, kernel
from engine.conventions import FloatArray
from engine.errors import LensEquationError
from engine.lensing.perturbers import Multipole
from engine.lensing.power_law import (
    LensConstants,
    PowerLawLens,
    deflect_point,
    jacobian_point,
    lens_constants,
    magnification,
)

_COARSE = 0.3
"""Side of the largest cells over their distance from the lens, times sqrt(q): the scale on which deflection varies."""
_CORE = 0.1
"""Distance from the lens [theta_E] below which cells need not shrink with it any more."""
_CURVATURE = 0.05
"""Departure from linearity across a cell, over the extent of the mapped cell, at which it is cut."""
_DEPTH = 12
"""Halvings of a cell beside a critical curve: 1e-5 theta_E."""
_NEWTON_STEPS = 60
_ROOT = 1e-12
"""What may be left of the lens equation [arcsec] at an image: some thousand roundings."""
_MOST_IMAGES = 16
_MOST_CELLS = 20_000
_RING = 1e-6
"""How far a lens may be from round, and a source from its middle in theta_E, whose image passes for a ring."""


@dataclass(frozen=True)
class LensedImage:
    """One image of a point source: position [arcsec] and signed magnification (negative at a saddle)."""

    x: float
    y: float
    magnification: float


@inlined_kernel
def _determinant(x: float, y: float, lens: LensConstants) -> float:
    """Determinant of the Jacobian of the lens equation: the inverse magnification."""
    kappa, g1, g2 = jacobian_point(x, y, lens)
    return (1.0 - kappa) ** 2 - g1 * g1 - g2 * g2


@kernel
def _polish(x: float, y: float, sx: float, sy: float, lens: LensConstants) -> tuple[float, float, bool]:
    """Damped Newton on the lens equation; whether it converged to rounding."""
    ax, ay = deflect_point(x, y, lens)
    fx, fy = x - ax - sx, y - ay - sy
    error = math.hypot(fx, fy)
    for _ in range(_NEWTON_STEPS):
        if error < 1e-14:
            break
        if x == lens.x and y == lens.y:
            return x, y, False
        kappa, g1, g2 = jacobian_point(x, y, lens)
        determinant = (1.0 - kappa) ** 2 - g1 * g1 - g2 * g2
        if determinant == 0.0:
            return x, y, False
        step_x = ((1.0 - kappa + g1) * fx + g2 * fy) / determinant
        step_y = (g2 * fx + (1.0 - kappa - g1) * fy) / determinant
        damping = 1.0
        improved = False
        for _ in range(30):
            nx, ny = x - damping * step_x, y - damping * step_y
            ax, ay = deflect_point(nx, ny, lens)
            gx, gy = nx - ax - sx, ny - ay - sy
            trial = math.hypot(gx, gy)
            if trial < error:
                x, y, fx, fy, error = nx, ny, gx, gy, trial
                improved = True
                break
            damping *= 0.5
        if not improved:
            break
    return x, y, error < _ROOT


@inlined_kernel
def _is_coarse(x: float, y: float, side: float, theta_E: float, lens: LensConstants) -> bool:
    """Whether a cell is large against its distance from the lens, on whose scale the deflection varies."""
    distance = max(math.hypot(x - lens.x, y - lens.y) - 0.71 * side, _CORE * theta_E)
    coarse = side > _COARSE * math.sqrt(lens.q) * distance
    # A satellite's own scale is its Einstein radius, beside which it is as a lens.
    for k in range(lens.perturbers.shape[0]):
        size = lens.perturbers[k, 3]
        if lens.perturbers[k, 0] == 1.0 and not coarse:
            off = max(math.hypot(x - lens.perturbers[k, 1], y - lens.perturbers[k, 2]) - 0.71 * side, _CORE * size)
            coarse = off < 3.0 * size and side > _COARSE * math.sqrt(lens.perturbers[k, 6]) * off
    return coarse


@kernel
def _map_cell(x: float, y: float, side: float, sx: float, sy: float, lens: LensConstants) -> tuple[bool, bool]:
    """Whether the source may lie in a mapped cell, and whether the cell is simple: nearly linear, of one parity."""
    ax, ay = deflect_point(x, y, lens)
    cx, cy = x - ax, y - ay
    corners = np.empty((4, 2))
    longest, long_x, long_y = 0.0, 1.0, 0.0
    for k in range(4):
        u, v = x + ((k % 2) - 0.5) * side, y + ((k // 2) - 0.5) * side
        ax, ay = deflect_point(u, v, lens)
        dx, dy = u - ax - cx, v - ay - cy
        corners[k, 0], corners[k, 1] = dx, dy
        length = math.hypot(dx, dy)
        if length > longest:
            longest, long_x, long_y = length, dx / length, dy / length
    # Beside a critical curve the mapped cell is a sliver: its extent is measured along and across its long side.
    extent_along, extent_across = 0.0, 0.0
    for k in range(4):
        extent_along = max(extent_along, abs(corners[k, 0] * long_x + corners[k, 1] * long_y))
        extent_across = max(extent_across, abs(corners[k, 1] * long_x - corners[k, 0] * long_y))
    # Opposite corners of a linear map cancel. What is left holds all second derivatives of the lens equation, of which
    # there are only four, being third derivatives of the potential.
    bend = 0.5 * max(
        math.hypot(corners[0, 0] + corners[3, 0], corners[0, 1] + corners[3, 1]),
        math.hypot(corners[1, 0] + corners[2, 0], corners[1, 1] + corners[2, 1]),
    )
    along = abs((sx - cx) * long_x + (sy - cy) * long_y)
    across = abs((sy - cy) * long_x - (sx - cx) * long_y)
    if along > 1.05 * extent_along + 2.0 * bend or across > 1.05 * extent_across + 2.0 * bend:
        return False, False
    low = high = _determinant(x, y, lens)
    for k in range(4):
        value = _determinant(x + ((k % 2) - 0.5) * side, y + ((k // 2) - 0.5) * side, lens)
        low, high = min(low, value), max(high, value)
    spread = high - low
    one_parity = low - 0.5 * spread > 0.0 or high + 0.5 * spread < 0.0
    return True, one_parity and bend <= _CURVATURE * extent_along


@kernel
def _candidates(sx: float, sy: float, half: float, theta_E: float, lens: LensConstants, found: FloatArray) -> int:
    """Centres and sides of the cells that may hold images, written into ``found`` (n, 3); how many, if room."""
    stack = np.empty((512, 4))
    # Off the lens by an irrational part, so that no corner and no centre ever falls on it.
    stack[0, 0], stack[0, 1] = lens.x + 0.0318309886 * half, lens.y + 0.0271828183 * half
    stack[0, 2], stack[0, 3] = 2.1 * half, 0.0
    top = 1
    n = 0
    while top > 0 and n <= found.shape[0]:
        top -= 1
        x, y, side, depth = stack[top, 0], stack[top, 1], stack[top, 2], stack[top, 3]
        cut = _is_coarse(x, y, side, theta_E, lens)
        if not cut:
            near, simple = _map_cell(x, y, side, sx, sy, lens)
            if not near:
                continue
            cut = not simple and depth < _DEPTH
            depth += 1.0
        if cut:
            for k in range(4):
                stack[top, 0] = x + 0.5 * ((k % 2) - 0.5) * side
                stack[top, 1] = y + 0.5 * ((k // 2) - 0.5) * side
                stack[top, 2], stack[top, 3] = 0.5 * side, depth
                top += 1
        else:
            if n < found.shape[0]:
                found[n, 0], found[n, 1], found[n, 2] = x, y, side
            n += 1
    return n


@inlined_kernel
def _left_beside(x: float, y: float, sx: float, sy: float, lens: LensConstants) -> float:
    """What is left of the lens equation after a step along the axis in which the image plane is squeezed least."""
    ax, ay = deflect_point(x, y, lens)
    fx, fy = x - ax - sx, y - ay - sy
    kappa, g1, g2 = jacobian_point(x, y, lens)
    turn = 0.5 * math.atan2(g2, g1)
    ex, ey, stretch = -math.sin(turn), math.cos(turn), 1.0 - kappa + math.hypot(g1, g2)
    if kappa > 1.0:
        ex, ey, stretch = ey, -ex, 1.0 - kappa - math.hypot(g1, g2)
    step = (fx * ex + fy * ey) / stretch
    x, y = x - step * ex, y - step * ey
    ax, ay = deflect_point(x, y, lens)
    return math.hypot(x - ax - sx, y - ay - sy)


@kernel
def _same_image(
    x: float, y: float, u: float, v: float, sx: float, sy: float, theta_E: float, lens: LensConstants
) -> bool:
    """Whether all between two roots solves the lens equation too, as far as a root is known.

    On a fold Newton stops anywhere within the square root of rounding of the double root, on a cusp within its cube
    root of the triple one: no distance tells roots found twice from pairs, what lies between them does. That is a
    curve, so that a step leads there from the straight line.
    """
    if math.hypot(x - u, y - v) > 0.01 * theta_E:
        return False
    for k in range(1, 4):
        if _left_beside(x + 0.25 * k * (u - x), y + 0.25 * k * (v - y), sx, sy, lens) > 2.0 * _ROOT:
            return False
    return True


@kernel
def _images(
    candidates: FloatArray, sx: float, sy: float, theta_E: float, lens: LensConstants, roots: FloatArray
) -> int:
    """Distinct images reached from the candidate cells, written into ``roots`` (n, 2); how many, if room."""
    n = 0
    for c in range(candidates.shape[0]):
        for k in range(5):
            shift = 0.0 if k == 4 else 0.5 * candidates[c, 2]
            x0 = candidates[c, 0] + (2 * (k % 2) - 1) * shift
            y0 = candidates[c, 1] + (2 * (k // 2 % 2) - 1) * shift
            x, y, converged = _polish(x0, y0, sx, sy, lens)
            if not converged:
                continue
            known = False
            for m in range(n):
                known = known or _same_image(x, y, roots[m, 0], roots[m, 1], sx, sy, theta_E, lens)
            if not known:
                if n == roots.shape[0]:
                    return n + 1
                roots[n, 0], roots[n, 1] = x, y
                n += 1
    return n


def makes_ring(lens: PowerLawLens, source_x: float, source_y: float) -> bool:
    """Whether a point is seen as a ring, of radius theta_E round the lens: behind the middle of one that is round."""
    near = math.hypot(source_x - lens.x, source_y - lens.y) <= _RING * lens.theta_E
    alone = not lens.perturbers and math.hypot(lens.gamma1, lens.gamma2) <= _RING
    return near and lens.q >= 1.0 - _RING and alone


def _perturbing(lens: PowerLawLens) -> tuple[float, float]:
    """By what factor multipoles at most raise the power law's deflection, and what satellites at most add [arcsec]."""
    t, factor, more = lens.slope - 1.0, 1.0, 0.0
    for one in lens.perturbers:
        if isinstance(one, Multipole):
            factor += (2.0 - t) * t * abs(one.amplitude) * one.m / abs((2.0 - t) ** 2 - one.m**2)
        else:
            more += one.theta_E / math.sqrt(one.q)
    return factor, more


def solve_lens_equation(
    lens: PowerLawLens, source_x: float, source_y: float, *, min_magnification: float = 1e-2
) -> tuple[LensedImage, ...]:
    """All images of a point source, brightest first.

    On a caustic, to within 1e-12 arcsec, the two images of a fold or the three of a cusp are one, whose magnification
    and parity rounding decides.

    Parameters
    ----------
    lens : PowerLawLens
    source_x, source_y : float
        Position of the source [arcsec].
    min_magnification : float
        Images fainter than this are left out: a profile shallower than isothermal has a central image of vanishing
        brightness, which no observation shows.

    Raises
    ------
    LensEquationError
        No image was found; a source always has one at least. Or they cannot be told apart: a point behind the
        middle of a round lens, say, whose image is a ring.
    """
    constants = lens_constants(lens)
    offset = math.hypot(source_x - lens.x, source_y - lens.y)
    shear = math.hypot(lens.gamma1, lens.gamma2)
    if shear >= 1.0:
        raise LensEquationError(f"shear: got {shear}, allowed is below 1")
    # |alpha| <= theta_E q^(-1/2) (r / theta_E)^(2 - slope) bounds how far out an image can lie.
    reach = lens.theta_E / math.sqrt(lens.q)
    steep, more = _perturbing(lens)
    half = 1.0 * reach
    while half * (1.0 - shear) - offset - more - steep * reach * (half / lens.theta_E) ** (2.0 - lens.slope) < 0.0:
        half *= 1.3
        if half > 1e4 * reach + 10.0 * offset:
            raise LensEquationError(f"slope {lens.slope} and shear {shear} leave the image plane unbounded")
    cells = np.empty((_MOST_CELLS, 3))
    roots = np.empty((_MOST_IMAGES, 2))
    n = _candidates(source_x, source_y, half, lens.theta_E, constants, cells)
    found = 0 if n > _MOST_CELLS else _images(cells[:n], source_x, source_y, lens.theta_E, constants, roots)
    if n > _MOST_CELLS or found > _MOST_IMAGES:
        raise LensEquationError(f"the source at ({source_x}, {source_y}) behind {lens} is too close to a caustic")
    images = []
    for x, y in roots[:found]:
        mu = float(magnification(lens, np.array(x), np.array(y)))
        if abs(mu) >= min_magnification:
            images.append(LensedImage(x, y, mu))
    if not images:
        raise LensEquationError(f"no image found of the source at ({source_x}, {source_y}) behind {lens}")
    return tuple(sorted(images, key=lambda image: -abs(image.magnification)))
