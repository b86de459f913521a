"""The chain: emcee over lens parameters and ln lambda, with proposals that know the shape of the posterior.

Two moves share the work: walks on a surrogate of the target (:mod:`.surrogate`), after which successive states are
nearly independent, and differential evolution, which follows whatever shape the walkers have found. Both leave the
exact posterior invariant: what is wrong in a surrogate costs acceptance, not correctness.
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
from engine.posterior.surrogate import learn_surrogate
from engine.posterior.target import Prior, Recorded, Target
from engine.result import ChainStatus, ChainSummary
from engine.work import count

_SURROGATE_SHARE = 0.9
"""The remaining differential evolution is for what no surrogate has learnt."""
_BURN_IN_STEPS = 3
_RESTARTS, _RESTART_STEPS, _USUAL_TAU = 2, 60, 2.0
"""How often, and after how many steps, a chain may be restarted with a surrogate that has learnt from it; tau then."""
_CHUNK = 5
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


def autocorrelation_time(samples: FloatArray) -> float:
    """Integrated autocorrelation time [steps], the largest over the parameters of (steps, walkers, parameters).

    The autocovariance about the mean of the whole ensemble is averaged over the walkers before it is normalised, so
    that a walker that is stuck counts as what it is: emcee's own estimate is NaN for a walker that has not moved and
    1.0 for one that is stuck (benchmarks/LEDGER.md). Infinite where nothing has moved.
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

    Fewer walkers than twice the parameters cannot follow each other: they walk on the surrogate alone. A chain that
    mixes badly is restarted, twice at most, with a surrogate that has learnt from its states; they count as burn-in.

    Raises
    ------
    PosteriorError
        No walker finds a place inside the prior, or none ever moves.
    """
    count("parameters_sampled", laplace.mean.size)
    random = np.random.RandomState(int(rng.integers(2**32)))
    known = Recorded(target)
    if laplace.known is not None:
        known = Recorded(target, list(laplace.known[0]), laplace.known[1].tolist())
    before = target.evaluations
    sampler, state = _on_surrogate(known, target.prior, laplace, walkers, random)
    tau, steps, left = math.inf, 0, _RESTARTS
    while steps < max_steps and steps < length * tau:
        state = sampler.run_mcmc(state, min(_CHUNK, max_steps - steps), skip_initial_state_check=True)
        steps = sampler.iteration
        tau = autocorrelation_time(sampler.get_chain())
        if progress is not None:
            progress(min(1.0, steps / min(float(max_steps), length * tau)))
        if left and _RESTART_STEPS <= steps < max_steps and length * (tau - _USUAL_TAU) > 2.0 * steps:
            left -= 1
            for values, found in zip(state.coords, state.log_prob, strict=True):
                known.remember(values, float(found))
            sampler, state = _on_surrogate(known, target.prior, laplace, walkers, random)
            tau, steps = math.inf, 0
    if not math.isfinite(tau):
        raise PosteriorError(f"chain: no proposal was accepted in {steps} steps of {walkers} walkers")
    status: ChainStatus = "converged" if steps >= length * tau else "not_converged"
    summary = ChainSummary(
        status=status,
        walkers=walkers,
        steps=steps,
        burn_in=round((target.evaluations - before) / walkers) - steps,
        tau=tau,
        effective_samples=steps * walkers / tau,
        acceptance=float(np.mean(sampler.acceptance_fraction)),
        evaluations=target.evaluations,
        r_hat=split_r_hat(sampler.get_chain()),
    )
    return Chain(sampler.get_chain(), sampler.get_log_prob(), summary)


def _on_surrogate(
    known: Recorded, prior: Prior, laplace: Laplace, walkers: int, random: np.random.RandomState
) -> tuple[emcee.EnsembleSampler, emcee.State]:
    """A sampler that walks on a surrogate of all that is known and some more, and where it stands after a burn-in."""
    surrogate = learn_surrogate(known, prior, laplace, random)
    moves = [(emcee.moves.MHMove(surrogate), _SURROGATE_SHARE)]
    if walkers >= 2 * laplace.mean.size:
        moves.append((emcee.moves.DEMove(), 1.0 - _SURROGATE_SHARE))
    sampler = emcee.EnsembleSampler(walkers, laplace.mean.size, known.many, moves=moves, vectorize=True)
    state = emcee.State(surrogate.draw(walkers, random), random_state=random.get_state())
    state = sampler.run_mcmc(state, _BURN_IN_STEPS, skip_initial_state_check=True)
    sampler.reset()
    return sampler, state
