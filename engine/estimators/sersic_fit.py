"""What an estimator on drawn sources answers with."""

from __future__ import annotations

from dataclasses import dataclass

from engine.light.sersic import SersicProfile
from engine.result import IndexPrior
from engine.spec.analysis import EstimatorName


@dataclass(frozen=True)
class SersicFit:
    """One fit: the profile, and which of n and r_eff ended at a bound."""

    profile: SersicProfile
    n_at_bound: bool
    r_eff_at_bound: bool


@dataclass(frozen=True)
class Refit:
    """One estimator with one prior of n: a fit for each draw, None where there is none."""

    estimator: EstimatorName
    index_prior: IndexPrior
    fits: tuple[SersicFit | None, ...]
