"""Stop when precise: a rule under which replicates of a point are enough once its mean bias is known to an error.

The standard error of a mean is s / sqrt(n), with s the sample standard deviation of n biases. Whoever looks at it after
each replicate and stops the first time that it is small stops where s happens to be small: the true error of the mean
is then larger than what was asked for. So what is compared is the upper limit of the standard error at one sigma
(84.1 %), s / sqrt(n) sqrt(k / chi2_k(15.9 %)) with k = n - 1: a third more than s / sqrt(n) with 10 replicates, a
twelfth with 100.

s is that of all replicates, outliers among them. They are part of the mean that answers state, so that a scale which
leaves them out would claim that mean to be better known than it is.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

LEAST = 3
"""Replicates below which their scatter says nothing."""
_AT_LEAST = 10
MOST = 5000
"""Replicates of a point: as many runs as one statement may name."""


class Until(BaseModel):
    """Replicates of each point until the mean bias of a quantity is known to an error, and no further.

    ``estimator`` and ``index_prior`` say by which estimate; the recommended one without. No point gets more than
    ``at_most`` replicates, and none is judged before ``at_least`` have an answer.
    """

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)

    quantity: Literal["magnitude", "r_eff", "n"] = "magnitude"
    estimator: Literal["paper", "covariance", "projected", "image"] = "image"
    index_prior: Literal["wide", "free", "fixed"] = "wide"
    error: Annotated[float, Field(gt=0.0, le=100.0, strict=True)]
    """Of the mean bias: mag, arcsec, or in n."""
    at_most: Annotated[int, Field(ge=LEAST, le=MOST, strict=True)] = 100
    at_least: Annotated[int, Field(ge=LEAST, le=MOST, strict=True)] = _AT_LEAST
    """Without, ``at_most`` where that is less."""

    @model_validator(mode="before")
    @classmethod
    def _no_more_than_there_are(cls, given: Any) -> Any:
        most = given.get("at_most") if isinstance(given, Mapping) and "at_least" not in given else None
        return {**given, "at_least": most} if isinstance(most, int) and LEAST <= most < _AT_LEAST else given

    def is_kept(self, standard_error: float | None, runs: int) -> bool:
        """Whether the mean of so many biases is known well enough."""
        limit = upper_limit(standard_error, runs)
        return limit is not None and runs >= self.at_least and limit <= self.error

    def wanted(self, standard_error: float | None, runs: int) -> int:
        """How many replicates it should take in all, should they scatter as those that there are."""
        if standard_error is None or runs < LEAST:
            return self.at_most
        scatter = standard_error * math.sqrt(runs)
        numbers = range(self.at_least, self.at_most)
        place = bisect_left(numbers, True, key=lambda number: self.is_kept(scatter / math.sqrt(number), number))
        return self.at_least + place


def standard_error(biases: Sequence[float]) -> float | None:
    """Of the mean of some biases; None of fewer than two."""
    if len(biases) < 2:
        return None
    mean = math.fsum(biases) / len(biases)
    return math.sqrt(math.fsum((bias - mean) ** 2 for bias in biases) / (len(biases) - 1) / len(biases))


def upper_limit(standard_error: float | None, runs: int) -> float | None:
    """What the true standard error is below with 84.1 % confidence, of normal scatter; None below three runs.

    By the quantile of chi-squared of Wilson and Hilferty (1931), k (1 - 2 / 9k + z sqrt(2 / 9k))^3 with z = -1, which
    is good to 0.4 % with two degrees of freedom and to 0.1 % with nine.
    """
    if standard_error is None or runs < LEAST:
        return None
    part = 2.0 / (9.0 * (runs - 1))
    return standard_error / math.sqrt((1.0 - part - math.sqrt(part)) ** 3)
