"""All images of a point source: triangles that hold the source, refined near critical curves, polished by Newton.

The image plane is tiled with triangles. A triangle whose mapped image holds the source holds an image; a cell whose
corners differ in the sign of the Jacobian determinant, or whose determinant is small against its change across the
cell, is cut finer first, because two images may lie in it with no triangle telling. The polished images are merged
where they coincide.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from engine.compiled import kernel
from engine.conventions import FloatArray
from engine.errors import LensEquationError
from engine.lensing.power_law import (
    PowerLawLens,
    deflect_point,
    jacobian_point,
    kernel_arguments,
    magnification,
)

_CELLS = 80
_DEPTH = 7
_NEWTON_STEPS = 60


@dataclass(frozen=True)
class LensedImage:
    """One image of a point source: position [arcsec] and signed magnification (negative at a saddle)."""

    x: float
    y: float
    magnification: float


@kernel
def _source_and_determinant(x: float, y: float, p: FloatArray, a: FloatArray) -> tuple[float, float, float]:
    ax, ay = deflect_point(x, y, p, a)
    kappa, g1, g2 = jacobian_point(x, y, p, a)
    return x - ax, y - ay, (1.0 - kappa) ** 2 - g1 * g1 - g2 * g2


@kernel
def _holds(ax: float, ay: float, bx: float, by: float, cx: float, cy: float) -> bool:
    """Whether the triangle a, b, c holds the origin."""
    d1 = ax * by - ay * bx
    d2 = bx * cy - by * cx
    d3 = cx * ay - cy * ax
    return (d1 >= 0.0 and d2 >= 0.0 and d3 >= 0.0) or (d1 <= 0.0 and d2 <= 0.0 and d3 <= 0.0)


@kernel
def _polish(x: float, y: float, sx: float, sy: float, p: FloatArray, a: FloatArray) -> tuple[float, float, bool]:
    """Damped Newton on the lens equation; whether it converged to rounding."""
    ax, ay = deflect_point(x, y, p, a)
    fx, fy = x - ax - sx, y - ay - sy
    error = math.hypot(fx, fy)
    for _ in range(_NEWTON_STEPS):
        if error < 1e-14:
            break
        kappa, g1, g2 = jacobian_point(x, y, p, a)
        determinant = (1.0 - kappa) ** 2 - g1 * g1 - g2 * g2
        if determinant == 0.0:
            return x, y, False
        step_x = ((1.0 - kappa + g1) * fx + g2 * fy) / determinant
        step_y = (g2 * fx + (1.0 - kappa - g1) * fy) / determinant
        damping = 1.0
        improved = False
        for _ in range(30):
            nx, ny = x - damping * step_x, y - damping * step_y
            ax, ay = deflect_point(nx, ny, p, a)
            gx, gy = nx - ax - sx, ny - ay - sy
            trial = math.hypot(gx, gy)
            if trial < error:
                x, y, fx, fy, error = nx, ny, gx, gy, trial
                improved = True
                break
            damping *= 0.5
        if not improved:
            break
    return x, y, error < 1e-12


@kernel
def _candidates(sx: float, sy: float, half: float, p: FloatArray, a: FloatArray, found: FloatArray) -> int:
    """Centroids of the triangles that hold the source, written into ``found`` (n, 2); how many."""
    corners = np.empty((4, 3))
    stack = np.empty((4 * _DEPTH + 8, 3))
    n = 0
    side0 = 2.0 * half / _CELLS
    # An irrational offset keeps corners off the centre of the lens and off symmetric points.
    left = p[5] - half + 0.31830988618 * side0
    bottom = p[6] - half + 0.27182818284 * side0
    for j in range(-1, _CELLS):
        for i in range(-1, _CELLS):
            stack[0, 0], stack[0, 1], stack[0, 2] = left + i * side0, bottom + j * side0, 0.0
            top = 1
            while top > 0:
                top -= 1
                x0, y0, depth = stack[top, 0], stack[top, 1], stack[top, 2]
                side = side0 * 0.5**depth
                low, high = np.inf, -np.inf
                for k in range(4):
                    bx, by, determinant = _source_and_determinant(x0 + (k % 2) * side, y0 + (k // 2) * side, p, a)
                    corners[k, 0], corners[k, 1], corners[k, 2] = bx - sx, by - sy, determinant
                    low, high = min(low, determinant), max(high, determinant)
                spread = high - low
                near_critical = low - spread <= 0.0 <= high + spread
                reach = 0.0
                for k in range(1, 4):
                    reach = max(reach, abs(corners[k, 0] - corners[0, 0]) + abs(corners[k, 1] - corners[0, 1]))
                near_source = abs(corners[0, 0]) + abs(corners[0, 1]) <= 4.0 * reach + 0.1 * side
                holds_centre = x0 <= p[5] <= x0 + side and y0 <= p[6] <= y0 + side
                if depth < _DEPTH and ((near_critical and near_source) or holds_centre):
                    for k in range(4):
                        stack[top, 0] = x0 + 0.5 * (k % 2) * side
                        stack[top, 1] = y0 + 0.5 * (k // 2) * side
                        stack[top, 2] = depth + 1.0
                        top += 1
                    continue
                for third in (0, 3):
                    if n < found.shape[0] and _holds(
                        corners[third, 0],
                        corners[third, 1],
                        corners[1, 0],
                        corners[1, 1],
                        corners[2, 0],
                        corners[2, 1],
                    ):
                        weight = (third // 3) * side / 3.0 + side / 3.0
                        found[n, 0], found[n, 1] = x0 + weight, y0 + weight
                        n += 1
    return n


def solve_lens_equation(
    lens: PowerLawLens, source_x: float, source_y: float, *, min_magnification: float = 1e-2
) -> tuple[LensedImage, ...]:
    """All images of a point source, brightest first.

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
        No image was found; a source always has one at least.
    """
    p, a = kernel_arguments(lens)
    offset = math.hypot(source_x - lens.x, source_y - lens.y)
    shear = math.hypot(lens.gamma1, lens.gamma2)
    if shear >= 1.0:
        raise LensEquationError(f"shear: got {shear}, allowed is below 1")
    # |alpha| <= theta_E q^(-1/2) (r / theta_E)^(2 - slope) bounds how far out an image can lie.
    reach = lens.theta_E / math.sqrt(lens.q)
    half = 1.0 * reach
    while half * (1.0 - shear) - offset - reach * (half / lens.theta_E) ** (2.0 - lens.slope) < 0.0:
        half *= 1.3
        if half > 1e4 * reach + 10.0 * offset:
            raise LensEquationError(f"slope {lens.slope} and shear {shear} leave the image plane unbounded")
    found = np.empty((256, 2))
    n = _candidates(source_x, source_y, 1.05 * half, p, a, found)
    roots: list[tuple[float, float]] = []
    for x0, y0 in found[:n]:
        x, y, converged = _polish(x0, y0, source_x, source_y, p, a)
        if converged and all(math.hypot(x - u, y - v) > 1e-7 * lens.theta_E for u, v in roots):
            roots.append((x, y))
    images = []
    for x, y in roots:
        mu = float(magnification(lens, np.array(x), np.array(y)))
        if abs(mu) >= min_magnification:
            images.append(LensedImage(x, y, mu))
    if not images:
        raise LensEquationError(f"no image found of the source at ({source_x}, {source_y}) behind {lens}")
    return tuple(sorted(images, key=lambda image: -abs(image.magnification)))
