"""Pixel-integrated surface brightness of a Sersic profile, seen directly or through a lens.

Each pixel is integrated by nested Gauss-Legendre rules: where the 2 x 2 and 3 x 3 rules disagree by more than the
tolerance, or where the pixel may hold the cusp, it is split into four, and so on to ``MAX_DEPTH``. Refinement thus goes
only where the ray-traced surface brightness varies.
"""

from __future__ import annotations

import math

import numpy as np

from engine.compiled import inlined_kernel, kernel
from engine.conventions import FloatArray
from engine.lensing.power_law import PowerLawLens, deflect_point
from engine.lensing.power_law import kernel_arguments as lens_arguments
from engine.light.sersic import SersicProfile
from engine.light.sersic import kernel_arguments as sersic_arguments

MAX_DEPTH = 9
"""Halvings of a pixel's side at most: 1/512 of a pixel resolves the cusp of n = 4 at r_eff of a pixel."""

CUSP_DEPTH = 5
"""Halvings down to which a cell that may hold the cusp is split whatever the rules say."""

DEFAULT_TOLERANCE = 1e-4
"""Estimated error of a pixel as a fraction of the brightest pixel at which it is no longer refined."""

_G2 = 0.5 / math.sqrt(3.0)
_G3 = 0.5 * math.sqrt(0.6)


@inlined_kernel
def _brightness(
    x: float, y: float, light: FloatArray, lensed: bool, p: FloatArray, a: FloatArray
) -> tuple[float, float]:
    """Surface brightness at an image position, and the squared source-plane distance from the profile's centre."""
    if lensed:
        ax, ay = deflect_point(x, y, p, a)
        x -= ax
        y -= ay
    dx, dy = x - light[7], y - light[8]
    u = light[5] * dx + light[6] * dy
    v = light[5] * dy - light[6] * dx
    z = (light[4] * u * u + v * v / light[4]) * light[3]
    return light[0] * math.exp(-light[1] * z ** light[2]), dx * dx + dy * dy


@kernel
def _cell(
    x: float, y: float, h: float, light: FloatArray, lensed: bool, p: FloatArray, a: FloatArray
) -> tuple[float, float, float]:
    """Flux of a square cell of side h by the 3 x 3 rule, its difference from the 2 x 2 rule, nearest distance^2."""
    two = 0.0
    for i in range(2):
        for j in range(2):
            value, _ = _brightness(x + (2 * i - 1) * _G2 * h, y + (2 * j - 1) * _G2 * h, light, lensed, p, a)
            two += 0.25 * value
    three = 0.0
    nearest = np.inf
    for i in range(-1, 2):
        wi = 8.0 / 18.0 if i == 0 else 5.0 / 18.0
        for j in range(-1, 2):
            wj = 8.0 / 18.0 if j == 0 else 5.0 / 18.0
            value, distance2 = _brightness(x + i * _G3 * h, y + j * _G3 * h, light, lensed, p, a)
            three += wi * wj * value
            nearest = min(nearest, distance2)
    return three * h * h, abs(three - two) * h * h, nearest


@inlined_kernel
def _is_rough(flux: float, difference: float, nearest: float, side: float, tolerance: float, depth: float) -> bool:
    """Whether a cell must be split: the rules disagree, or it may hold the cusp, which hides from both."""
    return difference > tolerance or (nearest < side * side and flux > tolerance and depth < CUSP_DEPTH)


@kernel
def _refine_pixel(
    x: float,
    y: float,
    h: float,
    tolerance: float,
    light: FloatArray,
    lensed: bool,
    p: FloatArray,
    a: FloatArray,
    stack: FloatArray,
) -> float:
    """Flux of one pixel by adaptive splitting; ``stack`` is scratch of shape (4 MAX_DEPTH + 4, 3): x, y, depth."""
    total = 0.0
    stack[0, 0], stack[0, 1], stack[0, 2] = x, y, 0.0
    top = 1
    while top > 0:
        top -= 1
        cx, cy, depth = stack[top, 0], stack[top, 1], stack[top, 2]
        shrink = 0.5**depth
        side = h * shrink
        flux, difference, nearest = _cell(cx, cy, side, light, lensed, p, a)
        # Cells along a line through the cusp or an arc: their errors add up, so each may have its share only.
        if depth == 0.0 or (
            depth < MAX_DEPTH and _is_rough(flux, difference, nearest, side, tolerance * shrink, depth)
        ):
            quarter = 0.25 * side
            for i in range(2):
                for j in range(2):
                    stack[top, 0] = cx + (2 * i - 1) * quarter
                    stack[top, 1] = cy + (2 * j - 1) * quarter
                    stack[top, 2] = depth + 1.0
                    top += 1
        else:
            total += flux
    return total


@kernel
def _render(
    xs: FloatArray,
    ys: FloatArray,
    h: float,
    relative: float,
    light: FloatArray,
    lensed: bool,
    p: FloatArray,
    a: FloatArray,
) -> FloatArray:
    out = np.empty((ys.size, xs.size))
    difference = np.empty((ys.size, xs.size))
    nearest = np.empty((ys.size, xs.size))
    stack = np.empty((4 * MAX_DEPTH + 4, 3))
    top_i, top_j = 0, 0
    for j in range(ys.size):
        for i in range(xs.size):
            out[j, i], difference[j, i], nearest[j, i] = _cell(xs[i], ys[j], h, light, lensed, p, a)
            if out[j, i] > out[top_j, top_i]:
                top_i, top_j = i, j
    # A point of the rule that meets the cusp makes its pixel too bright by far: measure the peak properly.
    peak = out[top_j, top_i]
    peak = min(peak, _refine_pixel(xs[top_i], ys[top_j], h, relative * peak, light, lensed, p, a, stack))
    tolerance = relative * peak
    for j in range(ys.size):
        for i in range(xs.size):
            if _is_rough(out[j, i], difference[j, i], nearest[j, i], h, tolerance, 0.0):
                out[j, i] = _refine_pixel(xs[i], ys[j], h, tolerance, light, lensed, p, a, stack)
    return out


def render_sersic(
    profile: SersicProfile,
    x: FloatArray,
    y: FloatArray,
    pixel_scale: float,
    lens: PowerLawLens | None = None,
    tolerance: float = DEFAULT_TOLERANCE,
) -> FloatArray:
    """Flux per pixel [e-/s] of a profile on a regular grid of square pixels.

    Parameters
    ----------
    profile : SersicProfile
        In the source plane where a lens is given, else in the image plane.
    x, y : arrays of shape (nx,), (ny,)
        Centres of the pixels [arcsec].
    pixel_scale : float
        Side of a pixel [arcsec].
    lens : PowerLawLens, optional
        The lens in front of the profile.
    tolerance : float
        Estimated error of a pixel at which it is no longer refined, as a fraction of the brightest pixel.

    Returns
    -------
    array of shape (ny, nx)
    """
    if lens is None:
        p, a = np.zeros(9), np.ones(1)
    else:
        p, a = lens_arguments(lens)
    light = sersic_arguments(profile)
    return np.asarray(_render(x, y, pixel_scale, tolerance, light, lens is not None, p, a))


@kernel
def _sample(
    xs: FloatArray, ys: FloatArray, h: float, subrays: int, light: FloatArray, p: FloatArray, a: FloatArray
) -> FloatArray:
    out = np.empty((ys.size, xs.size))
    area = h * h / (subrays * subrays)
    for j in range(ys.size):
        for i in range(xs.size):
            total = 0.0
            for k in range(subrays):
                for m in range(subrays):
                    x = xs[i] + ((m + 0.5) / subrays - 0.5) * h
                    y = ys[j] + ((k + 0.5) / subrays - 0.5) * h
                    value, _ = _brightness(x, y, light, True, p, a)
                    total += value
            out[j, i] = total * area
    return out


def sample_lensed_sersic(
    profile: SersicProfile, lens: PowerLawLens, x: FloatArray, y: FloatArray, pixel_scale: float, subrays: int
) -> FloatArray:
    """Flux per pixel [e-/s] as the mean over ``subrays`` x ``subrays`` rays: quick, without an error bound.

    For fits that need many renderings; arguments and shapes as in :func:`render_sersic`.
    """
    return np.asarray(_sample(x, y, pixel_scale, subrays, sersic_arguments(profile), *lens_arguments(lens)))
