"""``image``: the ray-traced Sersic fitted to the data themselves, together with the lens and all other light.

That is what the parametric fit of the whole image does, and the answer is its posterior: no draws, no chain. The source
map has no part in it, nor has the lens of the chain, which does not know that the host is a Sersic profile: where the
arc is faint it strays from the lenses behind which it is one. And the sky is known from the whole field, where the ring
of the inversion cannot tell it from the host's wings.
"""

from __future__ import annotations

import math
from functools import reduce

import numpy as np
from numpy.polynomial.hermite_e import hermegauss
from scipy.stats import truncnorm

from engine.conventions import FloatArray, rate_to_magnitude
from engine.estimators.summaries import mean_angle
from engine.parametric.host_posterior import COORDINATES, HostPosterior
from engine.result import Estimate, IndexPrior, Quantity

_LN_FLUX, _LN_R_EFF, _N, _E1, _E2, _X, _Y = range(len(COORDINATES))
_NODES = 12
"""Gauss-Hermite nodes along each of radius and ellipticities; even, so that none is the circle, which has no angle."""
_MOST_ELLIPTICAL = 0.9
"""Of e = (1 - q)/(1 + q), as in the model of the image."""


def image_estimate(host: HostPosterior, index_prior: IndexPrior, zero_point: float) -> Estimate:
    """The host of a parametric fit: mean and standard deviation of its posterior in each quantity."""
    mean, covariance = cut_off(host.mean, host.covariance, host.low, host.high)
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    bent = [_LN_R_EFF, _E1, _E2]
    (ln_r_eff, e1, e2), weights = _quadrature(mean[bent], covariance[np.ix_(bent, bent)])
    e = np.minimum(np.hypot(e1, e2), _MOST_ELLIPTICAL)
    q, phi = (1.0 - e) / (1.0 + e), 0.5 * np.arctan2(e2, e1)

    def of(values: FloatArray, *, log_normal: bool = False) -> Quantity:
        middle = float(weights @ values)
        return Quantity(middle, math.sqrt(float(weights @ (values - middle) ** 2)), log_normal=log_normal)

    return Estimate(
        estimator="image",
        index_prior=index_prior,
        magnitude=Quantity(
            rate_to_magnitude(math.exp(mean[_LN_FLUX]), zero_point), 2.5 / math.log(10.0) * float(sd[_LN_FLUX])
        ),
        r_eff=of(np.exp(ln_r_eff), log_normal=True),
        r_eff_galfit=of(np.exp(ln_r_eff) / np.sqrt(q), log_normal=True),
        n=Quantity(float(mean[_N]), float(sd[_N])),
        q=of(q),
        position_angle=mean_angle(np.degrees(phi) - 90.0, weights),
        x=Quantity(float(mean[_X]), float(sd[_X])),
        y=Quantity(float(mean[_Y]), float(sd[_Y])),
        draws=1,
        at_bound=int(host.n_at_bound or host.r_eff_at_bound),
        n_at_bound=int(host.n_at_bound),
        r_eff_at_bound=int(host.r_eff_at_bound),
        failed=0,
    )


def cut_off(
    mean: FloatArray, covariance: FloatArray, low: FloatArray, high: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Mean (d,) and covariance (d, d) of a Gaussian that is cut off at bounds (d,), one coordinate after the other.

    Exact where one coordinate reaches its bounds, as n does that has a narrow prior: the others follow by regression
    (Tallis 1961). A coordinate without variance stays where it is.
    """
    mean, covariance = mean.copy(), covariance.copy()
    for k in np.flatnonzero(np.diag(covariance) > 0.0):
        variance = float(covariance[k, k])
        sd = math.sqrt(variance)
        shift, rest = truncnorm.stats((low[k] - mean[k]) / sd, (high[k] - mean[k]) / sd, moments="mv")
        along = covariance[:, k] / variance
        mean += along * sd * float(shift)
        covariance += np.outer(along, along) * variance * (float(rest) - 1.0)
    return mean, covariance


def _quadrature(mean: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points (d, k) and weights (k,) whose weighted sum of a smooth function is its mean under a Gaussian."""
    nodes, weights = hermegauss(_NODES)
    d = mean.size
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    grid = np.stack(np.meshgrid(*[nodes] * d, indexing="ij")).reshape(d, -1)
    product = reduce(np.multiply.outer, [weights / weights.sum()] * d).ravel()
    return mean[:, None] + root @ grid, np.asarray(product)
