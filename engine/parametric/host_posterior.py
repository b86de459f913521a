"""The host of a parametric fit as a distribution: what the ``image`` estimator answers with."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from engine.conventions import FloatArray
from engine.light.sersic import SHAPE, SersicProfile, profile_of

COORDINATES = ("ln_flux", *SHAPE)
_N = COORDINATES.index("n")


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

    @property
    def profile(self) -> SersicProfile:
        """The profile at its maximum."""
        return profile_of(self.mean[1:], math.exp(self.mean[0]))

    def inside(self, low: float, high: float) -> HostPosterior:
        """The same, cut off at bounds of n between which its maximum lies."""
        lower, upper = self.low.copy(), self.high.copy()
        lower[_N], upper[_N] = low, high
        return replace(self, low=lower, high=upper)

    def inflated(self, factor: float) -> HostPosterior:
        """The same with standard deviations that are ``factor`` times as large."""
        return replace(self, covariance=factor**2 * self.covariance)
