"""A surrogate of the target, learnt from evaluations of it, and the move of a chain that walks on it.

The surrogate is the Gaussian approximation, with tails that fall more slowly, times the exponential of a Gaussian
process through what ln of the target differs from it by: it follows a posterior that bends, and far from all that is
known it is the approximation. A walk on it costs next to nothing. Where it ends is a proposal, accepted with
probability min(1, pi(y) s(x) / (pi(x) s(y))) (delayed acceptance: Christen & Fox 2005): each step of the walk is
reversible with regard to the surrogate s, which may be a warmer one, and so is the walk. That leaves the target pi
invariant however wrong the surrogate is; a wrong one costs acceptance.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from engine.conventions import FloatArray
from engine.errors import PosteriorError
from engine.posterior.optimum import Laplace
from engine.posterior.proposal import StudentProposal
from engine.posterior.target import Prior, Recorded

# Measured on seven faint arcs of doubles (benchmarks/LEDGER.md, "Moves of the chain").
_LENGTH = 3.0
"""Correlation length of the process, in deviations of the approximation."""
_ROUGHNESS = 3e-3
"""Variance of what the target has of roughness, in units of that of the process."""
_DEPTH = 25.0
"""Below the highest known value by which ln of the target is not worth being told apart."""
_TEMPERATURE = 2.0
"""The places that are learnt from are drawn from the surrogate at this temperature: tails are where walkers stick."""
_WARMTH = 1.15
"""The temperature at which the chain walks: with tails no lighter than the target's no walker sticks in them."""
_CORE = 4.0
"""Deviations beyond which the approximation falls as an exponential: no walk is to get lost where nothing is known."""
_FIRST = 60
_BATCHES = (30, 30, 60, 60, 60, 60, 60)
"""Evaluations of the rounds of lessons: few where the approximation is good, and as many as ever where it is not."""
_ENOUGH = 10
"""Places near the maximum that tell how large the error is."""
_MOST_KNOWN = 800
"""The latest evaluations that are learnt from: the process costs the cube of their number."""
_GOOD = 0.3
"""Error of ln of the target (rms, near its maximum) at which the surrogate has learnt enough."""
_POPULATION, _LONG_WALK, _WALK = 200, 100, 40
_RANDOM_WALK, _STRETCH = 0.7, 0.5
"""Length of random-walk steps in deviations, and the scatter of its logarithm."""


def ln_core(z2: FloatArray) -> FloatArray:
    """Ln (n,) of what takes the place of the standard normal at squared distances (n,): slower tails, zero at z = 0."""
    z = np.sqrt(z2)
    return np.where(z < _CORE, -0.5 * z2, _CORE * (0.5 * _CORE - z))


class Surrogate:
    """The surrogate that is learnt from ``values`` (n,) of ln of the target at ``points`` (n, d).

    ``mean`` (d,) and ``covariance`` (d, d) are of the Gaussian approximation on which it rests.
    """

    def __init__(
        self, prior: Prior, points: FloatArray, values: FloatArray, mean: FloatArray, covariance: FloatArray
    ) -> None:
        self.prior, self.proposal = prior, StudentProposal(mean, covariance)
        top = float(values.max())
        z = self.proposal.whiten(points)
        differs = np.maximum(values, top - _DEPTH) - ln_core((z**2).sum(axis=1))
        # The process goes back to zero: where nothing is known the surrogate should be as high as it is elsewhere.
        self._level = float(np.median(differs[values > top - 0.5 * _DEPTH]))
        self._known = z
        process = self._correlation(z)
        process[np.diag_indices_from(process)] += _ROUGHNESS
        self._weights = linalg.cho_solve(linalg.cho_factor(process, lower=True), differs - self._level)

    def _correlation(self, z: FloatArray) -> FloatArray:
        """Of the process between states (n, d) and the known points (k,), in deviations; (n, k)."""
        square = (z**2).sum(axis=1)[:, None] + (self._known**2).sum(axis=1) - 2.0 * (z @ self._known.T)
        return np.asarray(np.exp(-0.5 / _LENGTH**2 * square))

    def ln_density(self, states: FloatArray) -> FloatArray:
        """What it takes ln of the target (n,) to be at states (n, d); minus infinity outside the prior."""
        z = self.proposal.whiten(states)
        found = self._level + ln_core((z**2).sum(axis=1)) + self._correlation(z) @ self._weights
        return np.where(self._inside(states), found, -np.inf)

    def _inside(self, states: FloatArray) -> NDArray[np.bool_]:
        """Which of the states (n, d) the prior holds."""
        return np.asarray(((states > self.prior.low) & (states < self.prior.high)).all(axis=1))

    def walk(
        self, states: FloatArray, steps: int, random: np.random.RandomState, temperature: float = 1.0
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Metropolis-Hastings steps of states (n, d) on the surrogate: where they end, its ln there and at the start.

        Half of the steps are proposed from the Student density, half are random walks.
        """
        here = states.copy()
        ln_first = self.ln_density(here)
        ln_here = ln_first.copy()
        n, d = here.shape
        for _ in range(steps):
            if random.random_sample() < 0.5:
                there, correction = self.proposal(here, random)
            else:
                length = _RANDOM_WALK * np.exp(_STRETCH * random.standard_normal((n, 1)))
                there = here + length * (random.standard_normal((n, d)) @ self.proposal.root.T)
                correction = np.zeros(n)
            ln_there = self.ln_density(there)
            accepted = np.log(random.random_sample(n)) < (ln_there - ln_here) / temperature + correction
            here[accepted], ln_here[accepted] = there[accepted], ln_there[accepted]
        return here, ln_here, ln_first

    def draw(self, number: int, random: np.random.RandomState) -> FloatArray:
        """States (number, d) of a population that has walked for long.

        Raises
        ------
        PosteriorError
            The Gaussian approximation lies outside the prior.
        """
        start = self.proposal.draw(50 * number, random)
        start = start[self._inside(start)][:number]
        if start.shape[0] < number:
            raise PosteriorError("chain: the Gaussian approximation lies outside the prior")
        return self.walk(start, _LONG_WALK, random)[0]

    def __call__(self, states: FloatArray, random: np.random.RandomState) -> tuple[FloatArray, FloatArray]:
        """The move: where walks from the states end, and ln of the ratio that makes up for it; emcee's protocol."""
        there, ln_there, ln_here = self.walk(states, _WALK, random, _WARMTH)
        return there, (ln_here - ln_there) / _WARMTH


def fit_surrogate(
    known: Recorded, prior: Prior, mean: FloatArray, covariance: FloatArray, random: np.random.RandomState
) -> tuple[Surrogate, FloatArray]:
    """The surrogate of all that is known, resting on its own mean and covariance, and a population (n, d) of it."""
    points, values = known.latest(_MOST_KNOWN)
    population = Surrogate(prior, points, values, mean, covariance).draw(_POPULATION, random)
    mean, covariance = population.mean(axis=0), np.cov(population.T)
    return Surrogate(prior, points, values, mean, covariance), population


def learn_surrogate(known: Recorded, prior: Prior, laplace: Laplace, random: np.random.RandomState) -> Surrogate:
    """Evaluate the target where the surrogate says that it is high, until they agree.

    Raises
    ------
    PosteriorError
        The Gaussian approximation lies where the target is nothing.
    """
    if len(known.values) < laplace.mean.size:
        known.many(StudentProposal(laplace.mean, _TEMPERATURE * laplace.covariance).draw(_FIRST, random))
    if not known.values:
        raise PosteriorError("chain: the target is nothing anywhere that the Gaussian approximation proposes")
    surrogate, population = fit_surrogate(known, prior, laplace.mean, laplace.covariance, random)
    for batch in _BATCHES:
        places, expected, _ = surrogate.walk(population[:batch], _WALK, random, _TEMPERATURE)
        top = max(known.values)
        found = known.many(places)
        near = found > top - 0.5 * places.shape[1] - 4.0
        error = (found - expected)[near]
        surrogate, population = fit_surrogate(
            known, prior, surrogate.proposal.mean, surrogate.proposal.root @ surrogate.proposal.root.T, random
        )
        if error.size >= _ENOUGH and float(error.std()) < _GOOD:
            break
    return surrogate
