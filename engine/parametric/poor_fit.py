"""What is known of a host that no profile of the model describes: less than its least squares say."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.special import gammainc

from engine.conventions import FloatArray, pixel_centres
from engine.imaging.observation import Observation
from engine.lensing.power_law import source_position
from engine.light.sersic import sersic_k
from engine.parametric.fit import ParametricFit
from engine.parametric.host_posterior import COORDINATES, HostPosterior

POOR_FIT = 1.5
"""chi^2 per degree of freedom from which on it is said that the model does not describe the image."""
_ARC_SHARE = 0.25
"""Part of the arc's brightest pixel from which on a pixel is one of the arcs."""
_STRUCTURE = 1.5
"""Pixels over which residuals are smoothed that are to be structure and not noise."""
_LN_R_EFF = COORDINATES.index("ln_r_eff")
_LEAST_INSIDE = 0.01
_SEEN = 1.0
"""Deviations of the noise from which on a pixel sees the host."""
_MOST_SEEN = 0.95
"""Part of the pixels that see the host within the radius up to which it is seen: others are strays."""


def widened(observation: Observation, fit: ParametricFit, posterior: HostPosterior) -> HostPosterior:
    """The posterior of a host whose model is poor: its flux and radius may be off by what the data do not tell.

    That is the light that the model misses among the arcs, and the wings beyond the radius up to which the image shows
    the host: they are the profile's claim, and the profile does not hold.
    """
    wings = _wings(observation, fit)
    covariance = posterior.covariance.copy()
    covariance[0, 0] += _arc_misfit(observation, fit) ** 2 + wings**2
    covariance[_LN_R_EFF, _LN_R_EFF] += wings**2
    return replace(posterior, covariance=covariance)


def _wings(observation: Observation, fit: ParametricFit) -> float:
    """Ln of the whole light of the profile over that within the radius that is seen; zero of a host that is not."""
    (ny, nx), host = observation.shape, fit.host
    counted = np.isfinite(fit.sigma)
    seen = counted & (np.where(counted, fit.arc, 0.0) > _SEEN * np.where(counted, fit.sigma, np.inf))
    if not seen.any():
        return 0.0
    x, y = np.meshgrid(pixel_centres(nx, observation.pixel_scale), pixel_centres(ny, observation.pixel_scale))
    bx, by = source_position(fit.lens, x[seen], y[seen])
    along = (bx - host.x) * math.cos(host.phi) + (by - host.y) * math.sin(host.phi)
    across = (by - host.y) * math.cos(host.phi) - (bx - host.x) * math.sin(host.phi)
    radius = float(np.quantile(np.sqrt(host.q * along**2 + across**2 / host.q), _MOST_SEEN))
    inside = float(gammainc(2.0 * host.n, sersic_k(host.n) * (radius / host.r_eff) ** (1.0 / host.n)))
    return -math.log(max(inside, _LEAST_INSIDE))


def _arc_misfit(observation: Observation, fit: ParametricFit) -> float:
    """Light that the model misses among the arcs, as a part of theirs: the error of a flux that no noise map has."""
    arc, sigma = fit.arc, fit.sigma
    counted = np.isfinite(sigma)
    among = counted & (arc > _ARC_SHARE * float(arc[counted].max(initial=0.0)))
    total = float(arc[among].sum())
    if not total > 0:
        return 0.0
    residual = np.where(counted, observation.image - fit.model, 0.0)
    missed = _structure(residual, among)
    noise = _structure(sigma, among) / math.sqrt(4.0 * math.pi * _STRUCTURE**2) * math.sqrt(2.0 / math.pi)
    return math.sqrt(max(missed**2 - noise**2, 0.0)) / total


def _structure(values: FloatArray, among: NDArray[np.bool_]) -> float:
    smooth = ndimage.gaussian_filter(np.where(np.isfinite(values), values, 0.0), _STRUCTURE)
    return float(np.abs(smooth[among]).sum())
