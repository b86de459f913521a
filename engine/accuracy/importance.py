"""The posterior by importance sampling: independent draws from a Student density, weighted. No chain, no surrogate."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from engine.conventions import FloatArray
from engine.errors import AccuracyError
from engine.posterior.optimum import Laplace
from engine.posterior.proposal import StudentProposal
from engine.posterior.target import Target

_ROUNDS = (300, 300, 1200)
"""Draws of each round; each proposes from the weighted mean and covariance of the one before, the last one counts."""
_WIDER = 1.4
"""On the covariance of what is proposed from: tails have to be reached."""
_LEAST = 50.0
"""Effective draws below which there is no reference."""


@dataclass(frozen=True)
class WeightedPosterior:
    """States (n, d) of a target with weights (n,) of sum one; ``laplace`` is the Gaussian at its maximum."""

    target: Target
    laplace: Laplace
    points: FloatArray
    weights: FloatArray

    @property
    def effective(self) -> float:
        """Number of unweighted draws that would be as good."""
        return 1.0 / float((self.weights**2).sum())

    @property
    def mean(self) -> FloatArray:
        """(d,)."""
        return np.asarray(self.weights @ self.points)

    @property
    def sd(self) -> FloatArray:
        """(d,)."""
        return np.asarray(np.sqrt(self.weights @ (self.points - self.mean) ** 2))

    def distance(self, samples: FloatArray) -> float:
        """Rms error of means and widths of samples (n, d) over the parameters, in posterior standard deviations."""
        means = (samples.mean(axis=0) - self.mean) / self.sd
        widths = samples.std(axis=0) / self.sd - 1.0
        return float(np.sqrt(np.mean(np.concatenate([means, widths]) ** 2)))

    @property
    def error(self) -> float:
        """What :meth:`distance` would be expected to be of the truth itself: (1 + 1/2) / 2 of a mean's variance."""
        return math.sqrt(0.75 / self.effective)

    def draws(self, number: int, rng: np.random.Generator) -> FloatArray:
        """Unweighted states (number, d), by systematic resampling in random order."""
        places = (np.arange(number) + rng.random()) / number
        chosen = np.searchsorted(np.cumsum(self.weights), places).clip(max=self.weights.size - 1)
        return np.asarray(self.points[rng.permutation(chosen)])


def importance_sample(target: Target, laplace: Laplace) -> WeightedPosterior:
    """Sample a target round its optimum.

    Raises
    ------
    AccuracyError
        Too few draws carry all the weight.
    """
    random = np.random.RandomState(1)
    mean, covariance = laplace.mean, laplace.covariance
    found = None
    for number in _ROUNDS:
        proposal = StudentProposal(mean, _WIDER * covariance)
        points = proposal.draw(number, random)
        ln = target.many(points) - proposal.ln_density(points)
        if not np.isfinite(ln).any():
            raise AccuracyError("posterior: nothing of what is proposed round its maximum lies in it")
        weights = np.exp(ln - ln.max())
        found = WeightedPosterior(target, laplace, points, weights / weights.sum())
        # Few draws with all the weight would make a proposal too narrow to come back from.
        if found.effective > 4 * mean.size:
            mean, covariance = found.mean, np.cov(points.T, aweights=found.weights)
    if found is None or found.effective < _LEAST:
        raise AccuracyError(
            f"posterior: importance sampling gives {0 if found is None else found.effective:.0f} effective draws, "
            f"{_LEAST:g} are needed for a reference"
        )
    return found
