"""The telescope's pupil: transmission and wavefront error on a square grid that holds the primary mirror."""

from __future__ import annotations

import math

import numpy as np

from engine.conventions import FloatArray
from engine.errors import SpecError
from engine.spec.instrument import Pupil

ZERNIKE_WAVELENGTH_NM = 547.0

# Zernike number (Noll 1976, as TinyTim counts) to radial order, azimuthal order and cos (+1) or sin (-1).
_ORDERS = {
    4: (2, 0, 1),
    5: (2, 2, 1),
    6: (2, 2, -1),
    7: (3, 1, 1),
    8: (3, 1, -1),
    9: (3, 3, 1),
    10: (3, 3, -1),
    11: (4, 0, 1),
    22: (6, 0, 1),
}


def _radial(n: int, m: int, rho: FloatArray, e: float) -> FloatArray:
    """Radial part of the annular Zernike polynomial (Mahajan 1981, table 1).

    Of unit variance together with its azimuthal part.
    ``e`` is the square of the obscuration.
    """
    if (n, m) == (2, 0):
        return math.sqrt(3) * (2 * rho**2 - 1 - e) / (1 - e)
    if (n, m) == (4, 0):
        polynomial = 6 * rho**4 - 6 * (1 + e) * rho**2 + (1 + 4 * e + e**2)
        return math.sqrt(5) * polynomial / (1 - e) ** 2
    if (n, m) == (6, 0):
        polynomial = 20 * rho**6 - 30 * (1 + e) * rho**4 + 12 * (1 + 3 * e + e**2) * rho**2
        return math.sqrt(7) * (polynomial - (1 + 9 * e + 9 * e**2 + e**3)) / (1 - e) ** 3
    if (n, m) == (3, 1):
        norm = (1 - e) * math.sqrt((1 + e) * (1 + 4 * e + e**2))
        return math.sqrt(8) * (3 * (1 + e) * rho**3 - 2 * (1 + e + e**2) * rho) / norm
    # n = m: r^m alone, with the annulus' second moment of it.
    return math.sqrt(2 * (n + 1)) * rho**m / math.sqrt(sum(e**k for k in range(m + 1)))


def annular_zernike(number: int, rho: FloatArray, theta: FloatArray, obscuration: float) -> FloatArray:
    """Annular Zernike polynomial, of zero mean and unit variance on the annulus obscuration < rho < 1.

    Parameters
    ----------
    number
        Noll's number, as TinyTim counts: 4 focus, 5/6 astigmatism, 7/8 coma, 9/10 clover, 11 and 22
        spherical.
    rho, theta
        Polar coordinates in the pupil, rho in units of its radius, theta in radians; any one shape.
    obscuration
        Inner radius of the annulus in units of the outer.

    Raises
    ------
    SpecError
        For a number that is not implemented.
    """
    if number not in _ORDERS:
        raise SpecError("zernike_waves_at_547nm", number, f"one of {sorted(_ORDERS)}")
    n, m, sign = _ORDERS[number]
    azimuthal = np.cos(m * theta) if sign > 0 else np.sin(m * theta)
    return np.asarray(_radial(n, m, rho, obscuration**2) * azimuthal)


def _rotated_grid(n: int, rotation_deg: float) -> tuple[FloatArray, FloatArray]:
    """Coordinates of the n x n pixel centres in the pupil's own frame, in units of the primary's radius."""
    axis = (np.arange(n, dtype=np.float64) - (n - 1) / 2) * (2 / n)
    x, y = axis[np.newaxis, :], axis[:, np.newaxis]
    angle = math.radians(rotation_deg)
    return x * math.cos(angle) + y * math.sin(angle), y * math.cos(angle) - x * math.sin(angle)


def pupil_transmission(pupil: Pupil, n: int, *, supersampling: int = 3) -> FloatArray:
    """Fraction of each of the n x n pupil pixels that is open: primary, secondary, vanes, pads and cold mask.

    The square's side is the primary's diameter. Cold mask and telescope are rotated together. Edges are
    softened over one point of the supersampled grid, so that the open area does not depend on how they fall
    on it: a vane at 45 degrees is a few rows of points wide and would otherwise be wrong by a few per cent.
    """
    x, y = _rotated_grid(n * supersampling, pupil.rotation_deg)
    point = 2 / (n * supersampling)
    r = np.hypot(x, y)
    inner, outer, vane = pupil.secondary, 1.0, pupil.spider_width
    if pupil.cold_mask is not None:
        # The mask's obscurations lie on the telescope's own: what is open passes both.
        inner = max(inner, pupil.cold_mask.secondary)
        outer = min(outer, pupil.cold_mask.outer_radius)
        vane = max(vane, pupil.cold_mask.spider_width)
    open_ = _step((outer - r) / point) * _step((r - inner) / point)
    # A straight edge crosses the rows of points at one angle; softened over this width, they add up right.
    angle = math.radians(pupil.rotation_deg)
    width = point * (abs(math.cos(angle)) + abs(math.sin(angle)))
    # Without vanes there is none, not one of no width, whose softened edge would still cast a shadow.
    for across in (x, y) if vane > 0 else ():
        open_ *= _step((np.abs(across) - vane / 2) / width)
    for pad_x, pad_y, radius in pupil.pads:
        open_ *= _step((np.hypot(x - pad_x, y - pad_y) - radius) / point)
    return np.asarray(open_.reshape(n, supersampling, n, supersampling).mean(axis=(1, 3)))


def _step(distance: FloatArray) -> FloatArray:
    """Open fraction of a grid point at this signed distance (in points) inside a straight edge."""
    return np.clip(distance + 0.5, 0.0, 1.0)


def pupil_wavefront(pupil: Pupil, n: int, *, defocus_nm: float = 0.0) -> FloatArray:
    """Wavefront error [nm] on the n x n pupil pixels: the camera's Zernike terms and rms defocus."""
    x, y = _rotated_grid(n, pupil.rotation_deg)
    rho, theta = np.hypot(x, y), np.arctan2(y, x)
    error = np.zeros((n, n))
    terms = [(number, waves * ZERNIKE_WAVELENGTH_NM) for number, waves in pupil.zernike_waves_at_547nm]
    for number, nm in [*terms, (4, defocus_nm)]:
        if nm != 0:
            error += nm * annular_zernike(number, rho, theta, pupil.secondary)
    return error
