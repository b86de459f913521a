"""What the light of an image may be off by where its PSF is a stamp, and what the residuals say of it.

A drizzled image is no convolution: a star differs from a stamp moved to it by many times the noise of its core.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.optimize import brentq

from engine.conventions import FloatArray, pixel_centres
from engine.imaging.observation import Observation
from engine.lensing.power_law import PowerLawLens
from engine.parametric.point_sources import Detection

_STAMP_SHIFT = 0.003
"""Error of a moved PSF stamp, as a shift [arcsec]: a drizzled pixel does not see its light where its centre is."""
_STAMP_ERROR = 0.005
"""And as a fraction of the AGN's light."""
_EXTENDED_SHIFT, _EXTENDED_ERROR = 0.001, 0.001
"""The same for light that is spread over many pixels: what noise-free drizzled arcs differ by from the best fit."""
_RESPONSE_ERROR = 0.002
"""As a fraction of the AGN's light where the exposures are known: what errors of position leave."""
_STAMP_RANGE = (0.5, 5.0)
"""Least and most that residuals at AGN images may change the error of their stamps by."""
_OUTSKIRTS = 1.6
"""Einstein radii from the lens beyond which residuals tell the noise and not the model."""
_FEWEST_OUTSIDE, _FEWEST_AT_STAMPS = 200, 20
_MAD = 1.4826


def stamp_variance(observation: Observation, agn: Sequence[Detection]) -> FloatArray:
    """Variance (ny, nx) of what the AGN images put on the pixels but no model of them can predict."""
    light = np.zeros(observation.shape)
    for found in agn:
        light += found.flux * observation.point_source(found.x, found.y)
    if observation.response is not None:
        return np.asarray((_RESPONSE_ERROR * light) ** 2)
    return _shift_variance(light, observation.pixel_scale, _STAMP_SHIFT, _STAMP_ERROR)


def extended_variance(observation: Observation, light: FloatArray) -> FloatArray:
    """The same for extended light (ny, nx); none where the exposures are known."""
    if observation.response is not None:
        return np.zeros(observation.shape)
    return _shift_variance(light, observation.pixel_scale, _EXTENDED_SHIFT, _EXTENDED_ERROR)


def _shift_variance(light: FloatArray, scale: float, shift: float, fraction: float) -> FloatArray:
    """Variance (ny, nx) of light that may be off by a shift [arcsec] and by a fraction of itself."""
    steep = sum(np.asarray(slope) ** 2 for slope in np.gradient(light, scale))
    return np.asarray((fraction * light) ** 2 + shift**2 * steep)


def noise_scale(observation: Observation, residual: FloatArray, sigma: FloatArray, lens: PowerLawLens) -> float | None:
    """Scatter of the residuals (ny, nx) outside the lens in units of ``sigma``, by the median of their moduli.

    None where there are too few pixels to tell.
    """
    ny, nx = observation.shape
    scale = observation.pixel_scale
    x, y = pixel_centres(nx, scale) - lens.x, pixel_centres(ny, scale) - lens.y
    chosen = (np.hypot(y[:, None], x[None, :]) > _OUTSKIRTS * lens.theta_E) & np.isfinite(sigma)
    if int(chosen.sum()) < _FEWEST_OUTSIDE:
        return None
    return _MAD * float(np.median(np.abs(residual[chosen] / sigma[chosen])))


def measured_stamp_error(residual: FloatArray, stamps: FloatArray, others: FloatArray) -> float | None:
    """Error of the AGN's stamps in units of what is allowed for, from the residuals where it outweighs all else.

    None where it outweighs the rest in too few pixels to tell.

    How wrong a stamp is depends on where between the pixels its star and the AGN images stand, and on who made it. The
    mean square residual there is what variances say it is, but for the limits :data:`_STAMP_RANGE`.

    Parameters
    ----------
    residual, stamps, others : arrays (ny, nx)
        Residual, variance allowed for the stamps, variance of all else; the last infinite where a pixel does not count.
    """
    chosen = np.isfinite(others) & (stamps > others)
    if int(chosen.sum()) < _FEWEST_AT_STAMPS:
        return None
    square, at_stamps, rest = residual[chosen] ** 2, stamps[chosen], others[chosen]

    def excess(ln_error: float) -> float:
        return float(np.mean(square / (rest + math.exp(2.0 * ln_error) * at_stamps))) - 1.0

    least, most = (math.log(limit) for limit in _STAMP_RANGE)
    if excess(least) <= 0.0:
        return _STAMP_RANGE[0]
    if excess(most) >= 0.0:
        return _STAMP_RANGE[1]
    return math.exp(float(brentq(excess, least, most, xtol=1e-3)))
