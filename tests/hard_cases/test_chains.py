"""Chains whose target is hard: strengths without end, two hills, wrong lessons."""

import math

import emcee
import numpy as np
import pytest

from engine.errors import InversionError, PosteriorError
from engine.likelihood.amplitudes import LinearData
from engine.likelihood.strength import find_strength
from engine.posterior.chain import autocorrelation_time, run_chain
from engine.posterior.optimum import Laplace, find_optimum, start_covariance
from engine.posterior.proposal import StudentProposal
from engine.posterior.surrogate import Surrogate, learn_surrogate
from engine.posterior.target import Prior, Target, wide_prior
from engine.source.regularisation import SourceModel
from tests.engine.dense_oracle import LENS, Case
from tests.engine.test_posterior import Gaussian

MODEL = SourceModel((8, 8))
SD = np.array([0.004, 0.02, 0.03, 0.03, 0.005, 0.005, 0.01, 0.01, 0.4])
"""About the widths of the posterior of a Case, ln lambda last."""


def target_of(case: Case, low: float, high: float) -> Target:
    prior = wide_prior(LENS, shear=True)
    below, above = prior.low.copy(), prior.high.copy()
    below[-1], above[-1] = low, high
    return Target(case.likelihood(), Prior.flat(prior.names, below, above), MODEL)


def test_a_chain_that_may_go_to_no_regularisation_at_all_stays_where_the_evidence_is() -> None:
    """ln lambda free from -300 to 300: lambda from 1e-130 to 1e130, in a chain.

    Could go wrong: lambda of 0 and infinity make matrices that cannot be factorised, or whose evidence is rounding,
    and a chain that trusts one of them never leaves it. Holds: the chain has the same mean and deviation of ln
    lambda as one between -30 and 30, to 5 standard errors, and all its samples are finite.
    """
    found = []
    for bound in (30.0, 300.0):
        target = target_of(Case(amplitudes=1), -bound, bound)
        best = find_strength(target.likelihood, LENS, MODEL).ln_lambda
        laplace = find_optimum(target, target.vector(LENS, best), np.diag(SD**2))
        chain = run_chain(target, laplace, walkers=20, max_steps=60, rng=np.random.default_rng(3))
        strengths = chain.flat()[:, -1]
        assert np.isfinite(chain.ln_posterior).all()
        found.append((strengths.mean(), strengths.std(), chain.summary.effective_samples))
    (mean, sd, n), (other_mean, other_sd, other_n) = found
    error = math.sqrt(1.0 / n + 1.0 / other_n)
    assert other_mean == pytest.approx(mean, abs=5 * sd * error)
    assert other_sd == pytest.approx(sd, rel=5 * error)


def test_a_chain_without_any_regularisation_is_refused_and_not_walked() -> None:
    """lambda to 0: a prior that leaves ln lambda between -300 and -200 alone, and more source pixels than data.

    Could go wrong: minus infinity everywhere, and walkers that stand still are called a posterior. Holds: no
    optimum is searched from there; a PosteriorError names the start, and the inversions that were refused are
    counted.
    """
    case = Case(amplitudes=1)
    prior = wide_prior(LENS, shear=True)
    low, high = prior.low.copy(), prior.high.copy()
    low[-1], high[-1] = -300.0, -200.0
    target = Target(case.likelihood(), Prior.flat(prior.names, low, high), SourceModel((30, 30)))
    with pytest.raises(PosteriorError, match="start"):
        find_optimum(target, target.vector(LENS, -250.0), start_covariance(1e-4 * np.eye(8)))
    assert target.refused == target.evaluations == 1
    with pytest.raises(PosteriorError, match="nothing anywhere"):
        run_chain(
            target, Laplace(target.vector(LENS, -250.0), np.diag(SD**2), 0.0, 1), walkers=20, max_steps=20,
            rng=np.random.default_rng(0),
        )  # fmt: skip
    assert target.refused == target.evaluations > 1


def test_a_chain_on_data_without_a_source_goes_to_infinite_regularisation_and_knows_nothing_of_the_lens() -> None:
    """lambda to infinity: data that are noise alone, ln lambda free from -12 to 60.

    Could go wrong: the evidence is flat beyond some strength, and a chain invents a maximum or ends in an error of
    the matrix. Holds: the strength has no maximum, which is an InversionError; a chain nonetheless fills ln lambda
    evenly up to its bound (mean and deviation of a flat distribution), and the evidence there is that of no source
    to 0.01.
    """
    case = Case(amplitudes=0)
    noise = 0.5 * np.sqrt(case.covariance) * np.random.default_rng(5).normal(size=case.data.size)
    case.linear = LinearData(noise, case.covariance, case.columns)
    target = target_of(case, -12.0, 60.0)
    with pytest.raises(InversionError, match="stands out"):
        find_strength(target.likelihood, LENS, MODEL)
    nothing = -0.5 * target.likelihood.dd + target.likelihood.ln_constant
    centre, wide = target.vector(LENS, 40.0), 0.2 * (target.prior.high - target.prior.low)
    chain = run_chain(
        target, Laplace(centre, np.diag(wide**2), nothing, 1), walkers=20, max_steps=150, rng=np.random.default_rng(3)
    )
    strengths = chain.flat()[:, -1]
    assert np.isfinite(chain.ln_posterior).all()
    beyond = chain.ln_posterior.ravel()[strengths > 40.0]
    assert np.abs(beyond - nothing).max() < 0.01
    # Flat from about 10, where the source has gone, to 60: its upper half holds half of the samples that lie there.
    flat = strengths[strengths > 20.0]
    error = math.sqrt(chain.summary.tau / strengths.size)
    assert np.mean(flat > 40.0) == pytest.approx(0.5, abs=3 * error + 0.03)
    assert strengths.max() > 58.0


class Hills:
    """A normal hill, and three tenths of the weight on one half as wide, three deviations away."""

    away, width, weight = 3.0, 0.5, 0.3

    def __init__(self, dimensions: int = 5) -> None:
        self.prior = Prior.flat(tuple("abcdefgh"[:dimensions]), np.full(dimensions, -30.0), np.full(dimensions, 30.0))
        self.evaluations = 0

    def __call__(self, values: np.ndarray) -> float:
        self.evaluations += 1
        other = (values - self.away * np.eye(values.size)[0]) / self.width
        ln_other = math.log(self.weight) - values.size * math.log(self.width) - 0.5 * other @ other
        return float(np.logaddexp(math.log(1.0 - self.weight) - 0.5 * values @ values, ln_other))


def test_a_posterior_with_two_hills_has_both_in_the_right_share(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two hills three deviations apart, three tenths of the weight on one half as wide, started on the larger alone.

    Could go wrong: the Gaussian approximation knows one hill, the walkers stay on it, and R-hat and tau are
    content. Holds: what the chain finds on its way teaches the surrogate and it begins anew; it converges, and the
    mean is that of both hills to 5 standard errors. All evaluations are accounted for.
    """
    lessons = []

    def counted(known, *rest):
        lessons.append(len(known.values))
        return learn_surrogate(known, *rest)

    monkeypatch.setattr("engine.posterior.chain.learn_surrogate", counted)
    target, done = Hills(), []
    chain = run_chain(
        target, Laplace(np.zeros(5), np.eye(5), 0.0, 1), walkers=12, max_steps=600, rng=np.random.default_rng(1),
        progress=done.append,
    )  # fmt: skip
    assert len(lessons) >= 2
    # What the chain went through is what the surrogate learns from.
    assert lessons[1] > lessons[0] + 12 * 60
    summary = chain.summary
    assert summary.status == "converged"
    # Steps that were a lesson are burn-in: all evaluations are accounted for, to half a step of all walkers.
    assert abs(summary.evaluations - summary.walkers * (summary.steps + summary.burn_in)) <= summary.walkers / 2
    x = chain.flat()[:, 0]
    assert x.mean() == pytest.approx(
        target.weight * target.away, abs=5 * x.std() / math.sqrt(summary.effective_samples)
    )
    second = np.mean(x > 0.5 * target.away + 0.5)
    assert second == pytest.approx(target.weight, abs=5 * 0.46 / math.sqrt(summary.effective_samples) + 0.02)
    assert all(0.0 < fraction <= 1.0 for fraction in done)


def test_a_surrogate_taught_by_wrong_lessons_costs_acceptance_and_nothing_else() -> None:
    """A surrogate that was taught the values of another target, displaced by 0.4 deviations in every direction.

    Could go wrong: the chain samples the surrogate instead of the target. Holds: fewer proposals are accepted, and
    mean and deviations are those of the target to 5 standard errors.
    """
    target = Gaussian()
    wrong = Gaussian()
    wrong.mean = target.mean + 0.4 * np.linalg.cholesky(target.covariance).sum(axis=1)
    random = np.random.RandomState(3)
    points = StudentProposal(wrong.mean, wrong.covariance).draw(200, random)
    values = np.array([wrong(point) for point in points])
    surrogate = Surrogate(target.prior, points, values, wrong.mean, wrong.covariance)
    sampler = emcee.EnsembleSampler(50, 5, target, moves=emcee.moves.MHMove(surrogate))
    sampler.run_mcmc(emcee.State(points[:50], random_state=random.get_state()), 400, skip_initial_state_check=True)
    chain = sampler.get_chain(discard=50)
    assert 0.1 < sampler.acceptance_fraction.mean() < 0.8
    error = math.sqrt(autocorrelation_time(chain) / (chain.shape[0] * chain.shape[1]))
    sd = np.sqrt(np.diag(target.covariance))
    flat = chain.reshape(-1, 5)
    assert np.abs((flat.mean(axis=0) - target.mean) / sd).max() < 5 * error
    assert np.abs(flat.std(axis=0) / sd - 1).max() < 5 * error


def test_lessons_that_are_noise_leave_the_posterior_as_it_is() -> None:
    """A surrogate whose lessons are random numbers with a scatter of three in ln of the target.

    Could go wrong: the walk leads to places that noise has raised, and stays there. Holds: proposals are still
    accepted, and mean and deviations are those of the target to 5 standard errors.
    """
    target = Gaussian(3)
    random = np.random.RandomState(4)
    points = StudentProposal(target.mean, target.covariance).draw(60, random)
    values = np.array([target(point) for point in points]) + 3.0 * random.standard_normal(60)
    surrogate = Surrogate(target.prior, points, values, target.mean, target.covariance)
    sampler = emcee.EnsembleSampler(50, 3, target, moves=emcee.moves.MHMove(surrogate))
    sampler.run_mcmc(emcee.State(points[:50], random_state=random.get_state()), 500, skip_initial_state_check=True)
    chain = sampler.get_chain(discard=100)
    assert 0.02 < sampler.acceptance_fraction.mean() < 0.8
    error = math.sqrt(autocorrelation_time(chain) / (chain.shape[0] * chain.shape[1]))
    sd = np.sqrt(np.diag(target.covariance))
    flat = chain.reshape(-1, 3)
    assert np.abs((flat.mean(axis=0) - target.mean) / sd).max() < 5 * error
    assert np.abs(flat.std(axis=0) / sd - 1).max() < 5 * error
