"""What the residuals of a fit say of the noise, and of the light of the AGN images."""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import brentq

from engine.conventions import FloatArray, pixel_centres
from engine.imaging.observation import Observation
from engine.lensing.power_law import PowerLawLens

_OUTSKIRTS = 1.6
"""Einstein radii from the lens beyond which residuals tell the noise and not the model."""
_FEWEST_OUTSIDE, _FEWEST_AT_STAMPS = 200, 20
_MAD = 1.4826


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


def measured_stamp_error(
    residual: FloatArray, stamps: FloatArray, others: FloatArray, limits: tuple[float, float]
) -> float | None:
    """Error of the AGN's stamps in units of what is allowed for, from the residuals where it outweighs all else.

    None where it outweighs the rest in too few pixels to tell.

    How wrong a stamp is depends on where between the pixels its star and the AGN images stand, and on who made it. The
    mean square residual there is what variances say it is, but for the ``limits``.

    Parameters
    ----------
    residual, stamps, others : arrays (ny, nx)
        Residual, variance allowed for the stamps, variance of all else; the last infinite where a pixel does not count.
    limits : (float, float)
        Least and most, as of :class:`~engine.imaging.optics.interface.ImageOptics`.
    """
    chosen = np.isfinite(others) & (stamps > others)
    if int(chosen.sum()) < _FEWEST_AT_STAMPS:
        return None
    square, at_stamps, rest = residual[chosen] ** 2, stamps[chosen], others[chosen]

    def excess(ln_error: float) -> float:
        return float(np.mean(square / (rest + math.exp(2.0 * ln_error) * at_stamps))) - 1.0

    least, most = (math.log(limit) for limit in limits)
    if excess(least) <= 0.0:
        return limits[0]
    if excess(most) >= 0.0:
        return limits[1]
    return math.exp(float(brentq(excess, least, most, xtol=1e-3)))
