"""The chain: emcee over lens parameters and ln lambda, with proposals from the Gaussian approximation.

Two moves share the work. The independence move proposes from a multivariate t distribution with the mean and
covariance of the Gaussian approximation (re-estimated from the burn-in): where that approximation is good, successive
states are nearly independent. The differential-evolution move follows whatever shape the walkers have found. Both
leave the exact posterior invariant, so a poor approximation costs acceptance, not correctness.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import emcee
import numpy as np

from engine.conventions import FloatArray
from engine.errors import PosteriorError
from engine.posterior.convergence import split_r_hat
from engine.posterior.optimum import Laplace
from engine.posterior.target import Target
from engine.result import ChainStatus, ChainSummary

# Measured on a Gaussian of seven dimensions: tau 7.4 with (5, 0.5), 4.9 with (5, 0.7), 2.9 with (12, 0.85), 2.2 with
# (12, 0.97); on HE0435 with the covariance of a short burn-in tau 6.4, with the approximation's own 1.5. The remaining
# differential evolution is for targets that no t distribution resembles.
_FREEDOM = 30.0
_INDEPENDENCE_SHARE = 0.9
_BURN_IN_ROUNDS, _BURN_IN_STEPS = 2, 20
_TRUSTED_SAMPLES = 25.0
"""Samples a parameter from which the burn-in tells as much of the covariance as the approximation does."""
_CHUNK = 15
_WINDOW = 5
AUTOCORRELATION_TIMES = 50.0
"""Least length of a chain that is called converged, in autocorrelation times (emcee's own rule)."""


@dataclass(frozen=True)
class Chain:
    """Samples after burn-in, (steps, walkers, parameters), their ln posterior (steps, walkers), and the summary."""

    samples: FloatArray
    ln_posterior: FloatArray
    summary: ChainSummary

    def flat(self) -> FloatArray:
        """All samples, (steps * walkers, parameters)."""
        return self.samples.reshape(-1, self.samples.shape[-1])

    def thinned(self, number: int, rng: np.random.Generator) -> FloatArray:
        """``number`` states as far apart in steps as the chain allows, from walkers in random order."""
        steps, walkers, _ = self.samples.shape
        at = np.linspace(0, steps - 1, min(number, steps)).round().astype(int)
        rounds = -(-number // at.size)
        order = np.concatenate([rng.permutation(walkers) for _ in range(-(-number // walkers))])[:number]
        return np.asarray(self.samples[np.tile(at, rounds)[:number], order])


class _IndependenceProposal:
    """Multivariate t proposals that do not depend on the present state; emcee's proposal-function protocol."""

    def __init__(self, mean: FloatArray, covariance: FloatArray) -> None:
        self.update(mean, covariance)

    def update(self, mean: FloatArray, covariance: FloatArray) -> None:
        self.mean = mean
        self.root = np.linalg.cholesky(covariance)
        self.inverse = np.linalg.inv(self.root)

    def _ln_density(self, values: FloatArray) -> FloatArray:
        z2 = (((values - self.mean) @ self.inverse.T) ** 2).sum(axis=1)
        return np.asarray(-0.5 * (_FREEDOM + self.mean.size) * np.log1p(z2 / _FREEDOM))

    def draw(self, size: int, random: np.random.RandomState) -> FloatArray:
        normal = random.standard_normal((size, self.mean.size))
        scale = np.sqrt(_FREEDOM / random.chisquare(_FREEDOM, size))
        return np.asarray(self.mean + (normal * scale[:, None]) @ self.root.T)

    def __call__(self, states: FloatArray, random: np.random.RandomState) -> tuple[FloatArray, FloatArray]:
        proposed = self.draw(states.shape[0], random)
        return proposed, self._ln_density(states) - self._ln_density(proposed)


def _start(target: Target, proposal: _IndependenceProposal, walkers: int, random: np.random.RandomState) -> FloatArray:
    states: list[FloatArray] = []
    for _ in range(50):
        for values in proposal.draw(walkers, random):
            if target.prior.holds(values):
                states.append(values)
            if len(states) == walkers:
                return np.array(states)
    raise PosteriorError("chain: the Gaussian approximation lies outside the prior")


def autocorrelation_time(samples: FloatArray) -> float:
    """Integrated autocorrelation time [steps], the largest over the parameters of (steps, walkers, parameters).

    The autocovariance about the mean of the whole ensemble is averaged over the walkers before it is normalised, so
    that a walker that is stuck counts as what it is. Infinite where nothing has moved.
    """
    steps = samples.shape[0]
    away = samples - samples.mean(axis=(0, 1))
    spectrum = np.fft.rfft(away, n=2 * steps, axis=0)
    covariance = np.fft.irfft(spectrum * spectrum.conj(), axis=0)[:steps].mean(axis=1)
    if not (covariance[0] > 0).all():
        return math.inf
    times = 2.0 * np.cumsum(covariance / covariance[0], axis=0) - 1.0
    # Sokal's window: the first lag beyond five autocorrelation times, the last one where the chain is shorter.
    beyond = np.arange(steps)[:, None] >= _WINDOW * times
    window = np.where(beyond.any(axis=0), beyond.argmax(axis=0), steps - 1)
    return float(np.take_along_axis(times, window[None, :], axis=0).max())


def run_chain(
    target: Target,
    laplace: Laplace,
    *,
    walkers: int,
    max_steps: int,
    length: float = AUTOCORRELATION_TIMES,
    rng: np.random.Generator,
    progress: Callable[[float], None] | None = None,
) -> Chain:
    """Sample the target until the chain is ``length`` autocorrelation times long, or ``max_steps`` are spent.

    Fewer walkers than twice the parameters cannot follow each other: they use the independence move alone.

    Raises
    ------
    PosteriorError
        No walker finds a place inside the prior, or none ever moves.
    """
    random = np.random.RandomState(int(rng.integers(2**32)))
    proposal = _IndependenceProposal(laplace.mean, laplace.covariance)
    moves = [(emcee.moves.MHMove(proposal), _INDEPENDENCE_SHARE)]
    if walkers >= 2 * laplace.mean.size:
        moves.append((emcee.moves.DEMove(), 1.0 - _INDEPENDENCE_SHARE))
    sampler = emcee.EnsembleSampler(walkers, laplace.mean.size, target, moves=moves)
    state = emcee.State(_start(target, proposal, walkers, random), random_state=random.get_state())
    for _ in range(_BURN_IN_ROUNDS):
        state = sampler.run_mcmc(state, _BURN_IN_STEPS, skip_initial_state_check=True)
        burnt = sampler.get_chain(discard=_BURN_IN_STEPS // 2, flat=True)
        proposal.update(*_blend(burnt, laplace))
        sampler.reset()
    tau, steps = math.inf, 0
    while steps < max_steps and steps < length * tau:
        state = sampler.run_mcmc(state, min(_CHUNK, max_steps - steps), skip_initial_state_check=True)
        steps = sampler.iteration
        tau = autocorrelation_time(sampler.get_chain())
        if progress is not None:
            progress(min(1.0, steps / min(float(max_steps), length * tau)))
    if not math.isfinite(tau):
        raise PosteriorError(f"chain: no proposal was accepted in {steps} steps of {walkers} walkers")
    status: ChainStatus = "converged" if steps >= length * tau else "not_converged"
    summary = ChainSummary(
        status=status,
        walkers=walkers,
        steps=steps,
        burn_in=_BURN_IN_ROUNDS * _BURN_IN_STEPS,
        tau=tau,
        effective_samples=steps * walkers / tau,
        acceptance=float(np.mean(sampler.acceptance_fraction)),
        evaluations=target.evaluations,
        r_hat=split_r_hat(sampler.get_chain()),
    )
    return Chain(sampler.get_chain(), sampler.get_log_prob(), summary)


def _blend(burnt: FloatArray, laplace: Laplace) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance for the proposal: the approximation's, and what a burn-in (samples, parameters) shows.

    A few dozen correlated samples know a covariance worse than the approximation does, where that is any good; each
    counts by the number of its distinct states.
    """
    distinct = np.unique(burnt, axis=0).shape[0]
    share = distinct / (distinct + _TRUSTED_SAMPLES * laplace.mean.size)
    mean = share * burnt.mean(axis=0) + (1.0 - share) * laplace.mean
    # The spread about the blended mean, not about the samples' own: a displaced approximation widens the proposal.
    away = burnt - mean
    covariance = away.T @ away / away.shape[0]
    return mean, np.asarray(share * covariance + (1.0 - share) * laplace.covariance)
