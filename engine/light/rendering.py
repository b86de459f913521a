"""Pixel-integrated surface brightness of a Sersic profile, seen directly or through a lens.

One ray is traced through the centre of each pixel. From the brightness there and at the neighbours, the mean over the
pixel follows to fourth order, and the fourth order itself says how far it may be trusted. What is left, where the
ray-traced surface brightness varies within a pixel or the cusp may lie between the rays, is refined one by one
(:mod:`engine.light.refinement`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.compiled import kernel
from engine.conventions import FloatArray
from engine.errors import SpecError
from engine.lensing.power_law import PowerLawLens, lens_constants, trace_rays
from engine.light.brightness_bounds import brightness_range, length
from engine.light.radial_table import brightness, tabulate, to_profile_axes
from engine.light.refinement import Leaves, Tracer, joined, refine_pixels
from engine.light.sersic import SersicProfile, sersic_constants
from engine.work import count

DEFAULT_TOLERANCE = 1e-4
"""Estimated error of a pixel as a fraction of the brightest, and of all pixels together as a fraction of the flux."""

MIN_TOLERANCE = 1e-8
"""The radial table is good to 1e-7 at worst, mostly better; what is asked beyond that is not had."""

_CLEARANCE = 2.0
"""Distance of a pixel from the cusp in units of its size from which it may be trusted: the differences reach so far."""

HALO = 2
"""Pixels beyond the grid on each side that the differences need."""


def _tracer(profile: SersicProfile, lens: PowerLawLens | None) -> Tracer:
    """From image positions to the axes of the profile; without a lens nothing is deflected."""
    light = sersic_constants(profile)
    if lens is None:
        return lambda x, y: to_profile_axes(x, y, light)
    constants = lens_constants(lens)

    def trace(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        bx, by = np.empty(x.size), np.empty(x.size)
        trace_rays(x, y, constants, bx, by)
        count("rays_traced", x.size)
        return to_profile_axes(bx, by, light)

    return trace


@kernel
def _average(
    u: FloatArray, v: FloatArray, f: FloatArray, table: FloatArray, mean: FloatArray, error: FloatArray
) -> None:
    """Mean brightness over each pixel from its central ray and its neighbours', and an estimate of its error.

    The mean of f over a cell of unit side is f + (dxx + dyy)/24 - 17 (dxxxx + dyyyy)/5760 + dxxyy/576 in central
    differences, up to sixth order. ``u`` and ``v``, where rays map to in axes of the profile, and the brightness ``f``
    there are (ny + 4, nx + 4), with a halo of two pixels; ``mean`` and ``error`` (ny, nx) are written.
    """
    for j in range(mean.shape[0]):
        for i in range(mean.shape[1]):
            r, c = j + HALO, i + HALO
            f0 = f[r, c]
            sides_x, sides_y = f[r, c - 1] + f[r, c + 1], f[r - 1, c] + f[r + 1, c]
            corners = f[r - 1, c - 1] + f[r - 1, c + 1] + f[r + 1, c - 1] + f[r + 1, c + 1]
            xxxx = f[r, c - 2] + f[r, c + 2] - 4.0 * sides_x + 6.0 * f0
            yyyy = f[r - 2, c] + f[r + 2, c] - 4.0 * sides_y + 6.0 * f0
            xxyy = corners - 2.0 * (sides_x + sides_y) + 4.0 * f0
            value = f0 + (sides_x + sides_y - 4.0 * f0) / 24.0 - (xxxx + yyyy) * (17.0 / 5760.0) + xxyy / 576.0
            fourth = (abs(xxxx) + abs(yyyy)) * (17.0 / 5760.0) + abs(xxyy) / 576.0
            # Differences over two pixels, carried on to half a pixel.
            u0, v0 = u[r, c], v[r, c]
            xx = length(u[r, c + 1] + u[r, c - 1] - 2.0 * u0, v[r, c + 1] + v[r, c - 1] - 2.0 * v0)
            yy = length(u[r + 1, c] + u[r - 1, c] - 2.0 * u0, v[r + 1, c] + v[r - 1, c] - 2.0 * v0)
            xy = length(
                u[r + 1, c + 1] - u[r + 1, c - 1] - u[r - 1, c + 1] + u[r - 1, c - 1],
                v[r + 1, c + 1] - v[r + 1, c - 1] - v[r - 1, c + 1] + v[r - 1, c - 1],
            )
            least, most, smooth = brightness_range(
                u0,
                v0,
                0.25 * (u[r, c + 1] - u[r, c - 1]),
                0.25 * (v[r, c + 1] - v[r, c - 1]),
                0.25 * (u[r + 1, c] - u[r - 1, c]),
                0.25 * (v[r + 1, c] - v[r - 1, c]),
                0.125 * xx + 0.125 * yy + 0.0625 * xy,
                _CLEARANCE,
                table,
            )
            mean[j, i] = min(max(value, least), most)
            error[j, i] = min(fourth, most - least) if smooth else most - least


@kernel
def _greatest_of_neighbours(error: FloatArray) -> FloatArray:
    """For each pixel the greatest error of the 3 x 3 about it: a single difference may vanish by accident."""
    out = error.copy()
    rows, columns = error.shape
    for j in range(rows):
        for i in range(columns):
            for k in range(max(j - 1, 0), min(j + 2, rows)):
                for m in range(max(i - 1, 0), min(i + 2, columns)):
                    out[j, i] = max(out[j, i], error[k, m])
    return out


@kernel
def _sum_below(error: FloatArray, limit: float) -> float:
    """Sum of the errors (ny, nx) that are at most ``limit``."""
    total = 0.0
    for j in range(error.shape[0]):
        for i in range(error.shape[1]):
            total += error[j, i] if error[j, i] <= limit else 0.0
    return total


def axis_with_halo(centres: FloatArray, side: float, name: str) -> FloatArray:
    """Centres of pixels with :data:`HALO` more on each side; a SpecError where they are not ``side`` apart."""
    step = math.copysign(side, centres[-1] - centres[0])
    if not np.allclose(np.diff(centres), step, rtol=0.0, atol=1e-6 * side):
        raise SpecError(name, centres, f"centres that are pixel_scale = {side} apart")
    beyond = step * np.arange(1, HALO + 1)
    return np.concatenate([centres[0] - beyond[::-1], centres, centres[-1] + beyond])


def _first_pass(
    x: FloatArray, y: FloatArray, side: float, trace: Tracer, table: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Flux of each pixel from one ray a pixel, and an estimate of its error; both (ny, nx), for unit flux."""
    columns, rows = axis_with_halo(x, side, "x"), axis_with_halo(y, side, "y")
    shape = (rows.size, columns.size)
    u, v = trace(np.tile(columns, rows.size), np.repeat(rows, columns.size))
    f = brightness(u, v, table)
    mean, error = np.empty((y.size, x.size)), np.empty((y.size, x.size))
    _average(u.reshape(shape), v.reshape(shape), f.reshape(shape), table, mean, error)
    return mean * side**2, np.asarray(_greatest_of_neighbours(error)) * side**2


@dataclass(frozen=True)
class Rendering:
    """Flux per pixel (ny, nx) [e-/s] of a profile, and the cells that those pixels were cut into that were refined."""

    image: FloatArray
    leaves: Leaves


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
        Centres of the pixels [arcsec], ``pixel_scale`` apart.
    pixel_scale : float
        Side of a pixel [arcsec].
    lens : PowerLawLens, optional
        The lens in front of the profile.
    tolerance : float
        Estimated error at which no pixel is refined any further: of a pixel as a fraction of the brightest pixel, and
        of all pixels together as a fraction of the flux in the image.

    Returns
    -------
    array of shape (ny, nx)

    Raises
    ------
    SpecError
        Where the pixels are not ``pixel_scale`` apart, or the tolerance is below what the radial table can give.
    """
    return rendered(profile, x, y, pixel_scale, lens, tolerance).image


def rendered(
    profile: SersicProfile,
    x: FloatArray,
    y: FloatArray,
    pixel_scale: float,
    lens: PowerLawLens | None,
    tolerance: float,
) -> Rendering:
    """The same as :func:`render_sersic`, and how it was integrated, for :mod:`engine.light.derivatives`."""
    if not MIN_TOLERANCE <= tolerance < 1:
        raise SpecError("tolerance", tolerance, f"at least {MIN_TOLERANCE} and below 1")
    x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    trace, table = _tracer(profile, lens), tabulate(profile)
    image, error = _first_pass(x, y, pixel_scale, trace, table)
    count("pixels_rendered", image.size)
    parts: list[Leaves] = []

    def refine(chosen: NDArray[np.intp], absolute: float, relative: float) -> None:
        j, i = np.unravel_index(chosen, image.shape)
        image[j, i], leaves = refine_pixels(
            x[i], y[j], pixel_scale, trace, table, absolute=absolute, relative=relative
        )  # fmt: skip
        parts.append(leaves.of(chosen))
        error[j, i] = 0.0

    # The brightest pixel is the measure of all errors: first of all those that might be it, until one has proved to be.
    while True:
        certain, possible = image - error, image + error
        limit = tolerance * max(float(certain.max()), 0.0)
        rivals = np.flatnonzero((possible > 0.5 * possible.max()) & (error > limit))
        if not rivals.size:
            break
        refine(rivals, limit, tolerance)
    allowed = tolerance * float(np.maximum(certain, 0.0).sum())
    while _sum_below(error, limit) > allowed:
        limit *= 0.5
    chosen = np.flatnonzero(error > limit)
    if chosen.size:
        refine(chosen, min(limit, allowed / chosen.size), 0.0)
    return Rendering(image * profile.flux, joined(parts))


def sample_sersic(
    profile: SersicProfile, lens: PowerLawLens | None, x: FloatArray, y: FloatArray, side: float
) -> FloatArray:
    """Flux per cell [e-/s] from one ray through the centre of each: quick, without an error bound.

    For fits that need many renderings; arguments and shapes as in :func:`render_sersic`.
    """
    u, v = _tracer(profile, lens)(np.tile(x, y.size), np.repeat(y, x.size))
    rays = brightness(u, v, tabulate(profile)).reshape(y.size, x.size)
    count("pixels_rendered", rays.size)
    return np.asarray(rays * (profile.flux * side**2))
