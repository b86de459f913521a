"""Optimum and chain on targets whose answer is known, and their failures."""

import math

import numpy as np
import pytest

from engine.errors import PosteriorError
from engine.likelihood.curvature import together
from engine.posterior.chain import autocorrelation_time, run_chain
from engine.posterior.optimum import Laplace, find_optimum, optimal_strength, start_covariance
from engine.posterior.proposal import StudentProposal
from engine.posterior.surrogate import learn_surrogate
from engine.posterior.target import Prior, Recorded, Target, wide_prior
from engine.source.regularisation import SourceModel
from tests.engine.dense_oracle import LENS, Case


class Gaussian:
    """A stand-in for the evidence with a known answer: the sampler cannot tell."""

    def __init__(self, dimensions: int = 5) -> None:
        rng = np.random.default_rng(0)
        root = rng.normal(size=(dimensions, dimensions)) + 2 * np.eye(dimensions)
        self.covariance = root @ root.T
        self.mean = rng.normal(size=dimensions)
        self.inverse = np.linalg.inv(self.covariance)
        self.prior = Prior.flat(tuple("abcdefgh"[:dimensions]), self.mean - 1e3, self.mean + 1e3)
        self.evaluations = 0

    def __call__(self, values: np.ndarray) -> float:
        self.evaluations += 1
        away = values - self.mean
        return float(-0.5 * away @ self.inverse @ away)


def test_the_optimum_of_a_gaussian_is_found_with_its_covariance() -> None:
    target = Gaussian()
    start = target.mean + 3.0
    laplace = find_optimum(target, start, np.eye(5))
    assert np.allclose(laplace.mean, target.mean, atol=1e-6)
    assert np.allclose(laplace.covariance, target.covariance, rtol=1e-5)


def test_mixed_derivatives_are_measured_once_where_the_scale_is_about_right() -> None:
    target, d = Gaussian(), 5
    start = target.mean + np.linalg.cholesky(target.covariance) @ np.full(d, 0.8)
    laplace = find_optimum(target, start, 2.0 * target.covariance)
    assert np.allclose(laplace.mean, target.mean, atol=1e-6)
    assert np.allclose(laplace.covariance, target.covariance, rtol=1e-5)
    # The start; steps along the axes both ways and the trial, twice; the pairs of axes.
    assert target.evaluations == 1 + 2 * (2 * d + 1) + d * (d - 1) // 2


def test_the_chain_samples_a_gaussian_from_a_poor_approximation() -> None:
    target = Gaussian()
    poor = Laplace(target.mean + 0.5 * np.sqrt(np.diag(target.covariance)), 2.0 * target.covariance, 0.0, 1)
    chain = run_chain(target, poor, walkers=20, max_steps=1500, rng=np.random.default_rng(1))
    assert chain.summary.status == "converged"
    flat = chain.flat()
    sd = np.sqrt(np.diag(target.covariance))
    error = 1.0 / math.sqrt(chain.summary.effective_samples)
    # Five standard errors of the mean, and of the deviation, for the effective number of samples.
    assert np.abs((flat.mean(axis=0) - target.mean) / sd).max() < 5 * error
    assert np.abs(flat.std(axis=0) / sd - 1).max() < 5 * error
    assert chain.summary.effective_samples > 200


def test_a_chain_that_is_too_short_says_so() -> None:
    target = Gaussian()
    chain = run_chain(
        target, Laplace(target.mean, target.covariance, 0.0, 1), walkers=20, max_steps=20, rng=np.random.default_rng(1)
    )
    assert chain.summary.status == "not_converged"
    assert chain.summary.steps == 20


class Banana:
    """A Gaussian bent along a parabola, as posteriors of faint arcs are: x1 = u1 + b (x0^2 - s^2)."""

    def __init__(self, dimensions: int = 7, bend: float = 0.3, spread: float = 1.5) -> None:
        self.bend, self.spread = bend, spread
        self.mean = np.zeros(dimensions)
        # Var(x0^2) = 2 s^4 of a normal x0.
        self.sd = np.ones(dimensions)
        self.sd[0], self.sd[1] = spread, math.sqrt(1.0 + 2.0 * bend**2 * spread**4)
        self.prior = Prior.flat(tuple("abcdefgh"[:dimensions]), self.mean - 50.0, self.mean + 50.0)
        self.evaluations = 0

    def __call__(self, values: np.ndarray) -> float:
        self.evaluations += 1
        straight = values.copy()
        straight[0] /= self.spread
        straight[1] -= self.bend * (values[0] ** 2 - self.spread**2)
        return float(-0.5 * straight @ straight)


def test_a_chain_follows_a_posterior_that_bends() -> None:
    target = Banana()
    laplace = find_optimum(target, target.mean + 0.3, np.eye(7))
    chain = run_chain(target, laplace, walkers=8, max_steps=600, length=100.0, rng=np.random.default_rng(1))
    assert chain.summary.status == "converged"
    # 1.8-3.6 was seen with four seeds; draws from the best t distribution have 10 and more.
    assert chain.summary.tau < 5.0
    error = 1.0 / math.sqrt(chain.summary.effective_samples)
    flat = chain.flat()
    assert np.abs((flat.mean(axis=0) - target.mean) / target.sd).max() < 5 * error
    # The square of the bent coordinate has heavier tails than a normal one: twice the standard error of a deviation.
    assert np.abs(flat.std(axis=0) / target.sd - 1).max() < 10 * error


def test_a_surrogate_knows_what_it_was_told_and_nothing_outside_the_prior() -> None:
    target = Banana()
    known = Recorded(target)
    laplace = find_optimum(target, target.mean + 0.3, np.eye(7))
    surrogate = learn_surrogate(known, target.prior, laplace, np.random.RandomState(0))
    points, values = np.array(known.points), np.array(known.values)
    near = values > values.max() - 7.0
    # It stops learning at an rms error of 0.3 at places that it does not know yet; those that it knows it smooths.
    error = surrogate.ln_density(points[near]) - values[near]
    assert np.sqrt(np.mean(error**2)) < 0.2
    assert np.abs(error).max() < 0.6
    assert surrogate.ln_density(np.full((1, 7), 60.0))[0] == -math.inf
    ends, _, _ = surrogate.walk(points[:9], 20, np.random.RandomState(1))
    assert all(target.prior.holds(end) for end in ends)


def test_a_target_that_is_nothing_wherever_it_is_asked_is_refused() -> None:
    target = Gaussian()
    laplace = Laplace(target.mean, target.covariance, 0.0, 1)

    class Nothing(Gaussian):
        def __call__(self, values: np.ndarray) -> float:
            return -math.inf

    with pytest.raises(PosteriorError, match="nothing anywhere"):
        run_chain(Nothing(), laplace, walkers=8, max_steps=50, rng=np.random.default_rng(0))
    target.prior = Prior.flat(target.prior.names, target.mean + 500.0, target.mean + 1e3)
    known = find_optimum(Gaussian(), target.mean, np.eye(5))
    with pytest.raises(PosteriorError, match="outside the prior"):
        run_chain(target, known, walkers=8, max_steps=50, rng=np.random.default_rng(0))


def test_the_same_seed_gives_the_same_chain() -> None:
    chains = []
    for _ in range(2):
        target = Gaussian()
        laplace = Laplace(target.mean, target.covariance, 0.0, 1)
        chains.append(run_chain(target, laplace, walkers=20, max_steps=30, rng=np.random.default_rng(5)))
    assert np.array_equal(chains[0].samples, chains[1].samples)


def test_thinned_states_are_states_of_the_chain_and_spread_over_it() -> None:
    target = Gaussian()
    laplace = Laplace(target.mean, target.covariance, 0.0, 1)
    chain = run_chain(target, laplace, walkers=20, max_steps=60, rng=np.random.default_rng(5))
    states = chain.thinned(30, np.random.default_rng(0))
    assert states.shape == (30, 5)
    steps = [int(np.argwhere((chain.samples == state).all(axis=2))[0][0]) for state in states]
    assert min(steps) == 0
    assert len(set(steps)) > 20


def test_the_autocorrelation_time_of_independent_samples_is_one() -> None:
    samples = np.random.default_rng(0).normal(size=(2000, 8, 2))
    assert autocorrelation_time(samples) == pytest.approx(1.0, abs=0.1)
    assert autocorrelation_time(np.zeros((10, 4, 2))) == math.inf


def test_the_autocorrelation_time_of_a_markov_chain_is_the_textbook_one() -> None:
    # An AR(1) process with coefficient a has tau = (1 + a)/(1 - a).
    rng, a = np.random.default_rng(1), 0.8
    samples = np.zeros((20_000, 4, 1))
    for k in range(1, samples.shape[0]):
        samples[k] = a * samples[k - 1] + rng.standard_normal((4, 1))
    assert autocorrelation_time(samples) == pytest.approx(9.0, rel=0.1)


def test_a_walker_that_is_stuck_lengthens_the_autocorrelation_time() -> None:
    samples = np.random.default_rng(0).normal(size=(400, 8, 1))
    samples[:, 0] = 3.0
    assert 5.0 < autocorrelation_time(samples) < math.inf


def test_the_strength_that_maximises_the_evidence_is_found() -> None:
    likelihood = Case(amplitudes=1).likelihood()
    target = Target(likelihood, wide_prior(LENS, shear=True), SourceModel((9, 9)))
    best = optimal_strength(target, LENS)
    values = [target(target.vector(LENS, best + step)) for step in (-0.3, 0.0, 0.3)]
    assert values[1] > max(values[0], values[2])


def test_a_strength_without_a_maximum_is_refused() -> None:
    likelihood = Case(amplitudes=1).likelihood()
    target = Target(likelihood, wide_prior(LENS, shear=True), SourceModel((9, 9)))
    best = optimal_strength(target, LENS)
    with pytest.raises(PosteriorError, match="ln lambda"):
        optimal_strength(target, LENS, low=best + 3.0, high=best + 9.0)


def test_outside_the_prior_nothing_is_evaluated() -> None:
    target = Target(Case().likelihood(), wide_prior(LENS, shear=True), SourceModel((6, 6)))
    outside = target.vector(LENS, 0.0)
    outside[1] = 1.2
    assert target(outside) == -math.inf
    assert target.evaluations == 0
    with pytest.raises(PosteriorError, match="start"):
        find_optimum(target, outside, start_covariance(np.eye(8) * 1e-4))


def test_places_asked_for_together_have_the_value_that_each_has_alone_bit_by_bit() -> None:
    """More of them than share a pass over W, one outside the prior and one whose inversion is refused among them."""
    target = Target(Case().likelihood(), wide_prior(LENS, shear=True), SourceModel((20, 20)))
    assert together(400) == 4
    places = np.array([target.vector(LENS.with_values(slope=2.0 + 0.01 * k), -1.0 + 0.1 * k) for k in range(7)])
    places[2, 1] = 1.2
    target.prior.low[-1] = -300.0
    places[4, -1] = -250.0
    found = target.many(places)
    assert (target.evaluations, target.refused) == (6, 1)
    assert found.tolist() == [target(values) for values in places]
    assert np.flatnonzero(~np.isfinite(found)).tolist() == [2, 4]


def test_a_surrogate_of_a_gaussian_has_nothing_to_unlearn() -> None:
    """Where the approximation is right, one round of lessons shows it: no more are taken."""
    target = Gaussian()
    laplace = find_optimum(target, target.mean, np.eye(5))
    found = target.evaluations
    known = Recorded(target, *map(list, laplace.known or ([], [])))
    surrogate = learn_surrogate(known, target.prior, laplace, np.random.RandomState(0))
    assert target.evaluations - found == 30
    # A Student density of 30 degrees of freedom differs from the normal one by 0.4 there.
    states = StudentProposal(target.mean, 0.3 * target.covariance).draw(100, np.random.RandomState(1))
    error = surrogate.ln_density(states) - np.array([target(state) for state in states])
    assert np.abs(error - error.mean()).max() < 0.25


def test_a_lens_without_shear_has_no_shear_parameters() -> None:
    plain = LENS.with_values(gamma1=0.0, gamma2=0.0)
    prior = wide_prior(plain, shear=False)
    assert prior.names == ("theta_E", "q", "phi", "slope", "x", "y", "ln_lambda")
    target = Target(Case().likelihood(), prior, SourceModel((6, 6)))
    assert target.lens(target.vector(plain, 0.0)) == plain
