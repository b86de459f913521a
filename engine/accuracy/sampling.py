"""The chain: what its surrogate learns and how far it walks, walkers and length, against importance sampling."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from engine.accuracy.curves import SCATTER, Curve, Knob
from engine.accuracy.importance import WeightedPosterior
from engine.accuracy.subject import Subject
from engine.accuracy.timing import Measuring
from engine.conventions import FloatArray
from engine.errors import PosteriorError
from engine.posterior.chain import autocorrelation_time, run_chain
from engine.posterior.surrogate import USUAL_SCHOOLING, Schooling

STAGE = "sampling"
_QUANTITY = "error of means and widths, rms over lens parameters and ln lambda"
_UNIT = "posterior sigma"
_REFERENCE = "weighted independent draws from a Student density about the maximum: no chain, no surrogate"
_STATES = 320
"""Of the chains that are compared with one another."""
_SAME = f"surrogate learnt, and {_STATES} states"


def _knob(name: str, place: str, work: str, why_off_front: str = "") -> Knob:
    return Knob(STAGE, name, place, _QUANTITY, _UNIT, work, _REFERENCE, why_off_front, SCATTER)


LESSONS = _knob("surrogate lessons", "engine.posterior.surrogate.Schooling.good", _SAME)
WALK = _knob(
    "surrogate walk",
    "engine.posterior.surrogate.Schooling.walk",
    _SAME,
    "The walk itself costs next to nothing: what differs is how the chain that follows happens to go.",
)
WALKERS = _knob("walkers", "Analysis.walkers", _SAME)
LENGTH = _knob("chain length", "Analysis.chain_length", "surrogate learnt, and the chain")
_STEPS = 200
"""Of the one chain whose parts have all lengths."""
_CHUNK = 5
"""Steps after which a chain reports."""
_SEEDS = (2, 3)
"""Of the chains of each setting: their errors' rms."""


@dataclass(frozen=True)
class _Run:
    """A chain (steps, walkers, d), and CPU seconds up to each fifth step of it."""

    samples: FloatArray
    seconds: FloatArray

    def cost(self, steps: int) -> float:
        """CPU seconds up to a step."""
        return float(self.seconds[min(-(-steps // _CHUNK), self.seconds.size) - 1])


def _run(reference: WeightedPosterior, walkers: int, steps: int, schooling: Schooling, seed: int) -> _Run:
    """A chain of so many steps, if it does not end before because it is 100 autocorrelation times long."""
    told: list[float] = []
    began = time.thread_time()
    chain = run_chain(
        reference.target,
        reference.laplace,
        walkers=walkers,
        max_steps=steps,
        length=100.0,
        rng=np.random.default_rng(seed),
        progress=lambda _: told.append(time.thread_time() - began),
        schooling=schooling,
    )
    # A chain that was started anew has reported more often.
    return _Run(chain.samples, np.array(told[-chain.samples.shape[0] // _CHUNK :]))


def _usual_runs(walkers: int) -> list[tuple[int, int]]:
    """Seed and steps of the chains by the defaults: the first is long, for its parts."""
    return [(seed, _STEPS if seed == _SEEDS[0] else _STATES // walkers) for seed in _SEEDS]


def measure(subject: Subject) -> list[Curve]:
    """Chains by every knob of theirs."""
    reference, usual_walkers = subject.posterior, subject.analysis.walkers
    usual = [_run(reference, usual_walkers, steps, USUAL_SCHOOLING, seed) for seed, steps in _usual_runs(usual_walkers)]

    def one(walkers: int = usual_walkers, schooling: Schooling = USUAL_SCHOOLING) -> tuple[float, float]:
        steps = _STATES // walkers
        same = (walkers, schooling) == (usual_walkers, USUAL_SCHOOLING)
        runs = usual if same else [_run(reference, walkers, steps, schooling, seed) for seed in _SEEDS]
        errors = [reference.distance(run.samples[:steps].reshape(-1, run.samples.shape[-1])) for run in runs]
        return float(np.mean([run.cost(steps) for run in runs])), float(np.sqrt(np.mean(np.square(errors))))

    lessons, walk, number = (Measuring(knob, reference.error) for knob in (LESSONS, WALK, WALKERS))
    for good in (1.0, USUAL_SCHOOLING.good, 0.1):
        school = replace(USUAL_SCHOOLING, good=good)
        lessons.add(f"{good:g} in ln Z", partial(one, schooling=school), default=school == USUAL_SCHOOLING)
    for steps in (10, USUAL_SCHOOLING.walk, 120):
        school = replace(USUAL_SCHOOLING, walk=steps)
        walk.add(f"{steps} steps", partial(one, schooling=school), default=school == USUAL_SCHOOLING)
    for some in sorted({4, usual_walkers, 32}):
        number.add(f"{some}", partial(one, walkers=some), default=some == usual_walkers)
    return [lessons.curve(), walk.curve(), number.curve(), _lengths(subject, reference, usual[0])]


def _lengths(subject: Subject, reference: WeightedPosterior, run: _Run) -> Curve:
    """Parts of one chain, each as long as its setting: the rms of their errors."""
    tau, default = autocorrelation_time(run.samples), subject.analysis.chain_length
    found = Measuring(LENGTH, reference.error)
    steps_in_all = run.samples.shape[0]
    for length in sorted({5.0, 10.0, 30.0, default}):

        def one(length: float = length) -> tuple[float, float]:
            steps = min(max(_CHUNK, round(length * tau)), subject.analysis.max_steps)
            if steps > steps_in_all and length != default:
                raise PosteriorError(f"chain: {steps_in_all} steps were taken, {steps} are needed")
            steps = min(steps, steps_in_all)
            parts = [run.samples[k * steps : (k + 1) * steps] for k in range(steps_in_all // steps)]
            errors = [reference.distance(part.reshape(-1, part.shape[-1])) for part in parts]
            return run.cost(steps), float(np.sqrt(np.mean(np.square(errors))))

        found.add(f"{length:g} tau", one, default=length == default)
    return found.curve()
