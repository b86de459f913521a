"""The host of a parametric fit as a distribution, of which the ``image`` estimator takes its draws."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from engine.conventions import FloatArray
from engine.light.sersic import SHAPE, SersicProfile, profile_of

COORDINATES = ("ln_flux", *SHAPE)
_N = COORDINATES.index("n")
_ROUNDS = 64
"""How often draws outside the bounds are drawn again."""


@dataclass(frozen=True)
class HostPosterior:
    """Gaussian posterior of the host, lens and all other light marginalised, within bounds.

    ``mean`` (7,), ``covariance`` (7, 7), ``low`` and ``high`` (7,) are in :data:`COORDINATES`: flux in e-/s, r_eff, x
    and y in arcsec, ellipticities e = (1 - q)/(1 + q) times (cos, sin) 2 phi. Flux and radius are normal in the
    logarithm: a faint host is never negative. A coordinate that is held has no variance. The flags say what ended at a
    bound.
    """

    mean: FloatArray
    covariance: FloatArray
    low: FloatArray
    high: FloatArray
    n_at_bound: bool
    r_eff_at_bound: bool

    def draws(self, number: int, rng: np.random.Generator) -> tuple[SersicProfile, ...]:
        """Profiles drawn from it.

        Where there are enough of them their mean and covariance are those of the Gaussian, so that an average over few
        draws has no chance in it; what lies outside the bounds is drawn again.
        """
        root = _root(self.covariance)
        points = self.mean + _matched(rng.standard_normal((number, self.mean.size))) @ root.T
        for _ in range(_ROUNDS):
            outside = ((points < self.low) | (points > self.high)).any(axis=1)
            if not outside.any():
                break
            again = rng.standard_normal((int(outside.sum()), self.mean.size))
            points[outside] = self.mean + again @ root.T
        points = np.clip(points, self.low, self.high)
        return tuple(profile_of(point[1:], math.exp(point[0])) for point in points)

    @property
    def profile(self) -> SersicProfile:
        """The profile at its maximum."""
        return profile_of(self.mean[1:], math.exp(self.mean[0]))

    def inside(self, low: float, high: float) -> HostPosterior:
        """The same, cut off at bounds of n between which its maximum lies."""
        lower, upper = self.low.copy(), self.high.copy()
        lower[_N], upper[_N] = low, high
        return HostPosterior(self.mean, self.covariance, lower, upper, self.n_at_bound, self.r_eff_at_bound)


def _root(covariance: FloatArray) -> FloatArray:
    """R (d, d) with R R^T the covariance, which may have rows of zeros."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _matched(normal: FloatArray) -> FloatArray:
    """Standard normal draws (k, d) with mean zero and unit covariance exactly, where there are twice as many as d."""
    k, d = normal.shape
    if k < 2 * d:
        return normal
    away = normal - normal.mean(axis=0)
    factor = np.linalg.cholesky(away.T @ away / (k - 1))
    return np.asarray(np.linalg.solve(factor, away.T).T)
