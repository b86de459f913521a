"""What the three noise treatments say of noise that was really drizzled."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.linalg import solve_triangular

from engine.errors import ObservationError
from engine.imaging.drizzling import drizzle_weights
from engine.imaging.noise import draw_noise
from engine.lensing.power_law import PowerLawLens
from engine.likelihood.amplitudes import MarginalLikelihood
from engine.likelihood.evidence import invert
from engine.likelihood.problem import Problem, prepare_problem
from engine.likelihood.strength import find_strength
from engine.simulation.scene import Scene
from engine.simulation.simulate import Simulation
from engine.source.regularisation import SourceModel
from engine.spec.analysis import Analysis
from tests.engine.true_fit import true_fit

TREATMENTS = ("diagonal", "covariance", "paper_code")


def whiten(problem: Problem, values: np.ndarray) -> np.ndarray:
    factor = problem.likelihood.whitened.covariance
    if factor.ndim == 1:
        return values / (factor if values.ndim == 1 else factor[:, None])
    return solve_triangular(factor, values, lower=True)


@dataclass(frozen=True)
class Observed:
    """HE0435 with the linear problems of all treatments, and its noise drawn again and again through the drizzle."""

    simulation: Simulation
    lens: PowerLawLens
    problems: dict[str, Problem]

    def noise(self, rng: np.random.Generator) -> np.ndarray:
        exposures = self.simulation.exposures
        drizzled = drizzle_weights(exposures.geometry) @ draw_noise(exposures.noise, rng).ravel()
        return drizzled.reshape(self.simulation.observation.shape)[self.problems["diagonal"].mask]


@pytest.fixture(scope="module")
def observed(scene: Scene, simulation: Simulation) -> Observed:
    # The true positions: what is tested is the noise, not the parametric fit.
    fit = true_fit(scene)
    problems = {
        name: prepare_problem(simulation.observation, fit, Analysis(noise_treatment=name)) for name in TREATMENTS
    }
    return Observed(simulation, scene.lens, problems)


def test_noise_alone_has_the_chi2_and_the_scatter_of_its_covariance_only(observed: Observed) -> None:
    rng, chosen = np.random.default_rng(3), ~observed.problems["diagonal"].core[observed.problems["diagonal"].mask]
    mask = np.flatnonzero(observed.problems["diagonal"].mask)[chosen]
    covariance = observed.simulation.observation.covariance[mask][:, mask].toarray()
    factor, sigma, m = np.linalg.cholesky(covariance), np.sqrt(np.diag(covariance)), mask.size
    paper = observed.problems["paper_code"].likelihood.whitened.covariance[chosen]
    white, diagonal, coded = [], [], []
    for _ in range(300):
        noise = observed.noise(rng)[chosen]
        white.append(np.sum(solve_triangular(factor, noise, lower=True) ** 2) / m)
        diagonal.append(np.sum((noise / sigma) ** 2) / m)
        coded.append(np.sum((noise / paper) ** 2) / m)
    # 300 draws know the mean to 0.002 and the deviation to 4 %.
    assert np.mean(white) == pytest.approx(1.0, abs=0.01)
    assert np.std(white) == pytest.approx(math.sqrt(2 / m), rel=0.15)
    # The diagonal has the right mean by construction, and a wrong scatter: sum of squared correlations, not M.
    correlation = covariance / np.outer(sigma, sigma)
    assert np.mean(diagonal) == pytest.approx(1.0, abs=0.01)
    scatter = math.sqrt(2 * np.sum(correlation**2)) / m
    assert np.std(diagonal) == pytest.approx(scatter, rel=0.15)
    assert scatter > 1.15 * math.sqrt(2 / m)
    # The paper's scripts overstate the noise of the arc by far.
    assert np.mean(coded) < 0.05


def test_an_inversion_of_drizzled_noise_has_chi2_one_with_the_covariance_and_not_with_the_diagonal(
    observed: Observed,
) -> None:
    model, rng = SourceModel((16, 16)), np.random.default_rng(4)
    names = ("diagonal", "covariance")
    first = observed.problems["diagonal"].likelihood
    strength = find_strength(first, observed.lens, model).ln_lambda
    truth = invert(first, observed.lens, strength, model)
    # Data that the model can describe: whatever chi^2 differs from one by is the noise model's.
    arc = first.blurring @ truth.lensing.apply(truth.source.ravel())
    parts = {}
    for name in names:
        problem = observed.problems[name]
        basis, _ = np.linalg.qr(problem.likelihood.whitened.columns)
        parts[name] = basis, whiten(problem, problem.likelihood.blurring.toarray())
    chi2: dict[str, list[float]] = {name: [] for name in names}
    source_error: dict[str, list[float]] = {name: [] for name in names}
    for _ in range(12):
        data = arc + observed.noise(rng)
        for name in names:
            problem = observed.problems[name]
            likelihood = _with_data(problem, data, *parts[name])
            found = find_strength(likelihood, observed.lens, model)
            inversion = invert(likelihood, observed.lens, found.ln_lambda, model)
            fitted = likelihood.blurring @ inversion.lensing.apply(inversion.source.ravel())
            gamma = inversion.effective_parameters()
            freedom = int((problem.mask & ~problem.core).sum()) - likelihood.amplitudes - gamma
            chi2[name].append(likelihood.chi2(fitted, likelihood.fit_amplitudes(fitted)) / freedom)
            off = (inversion.source - truth.source).ravel()
            source_error[name].append(float(off @ inversion.curvature @ off) / gamma)
    # One realization scatters by 0.04; twelve know the mean to 0.012.
    assert np.mean(chi2["covariance"]) == pytest.approx(1.0, abs=0.04)
    assert np.mean(chi2["diagonal"]) < 0.94
    # The error of the source in units of what the data determine it to: stated rightly, and understated. A source
    # is pulled towards its prior, which is worth ten per cent.
    assert np.mean(source_error["covariance"]) == pytest.approx(1.0, abs=0.15)
    assert np.mean(source_error["diagonal"]) > 1.4


def _with_data(problem: Problem, data: np.ndarray, basis: np.ndarray, white_blurring: np.ndarray) -> MarginalLikelihood:
    white = whiten(problem, data)
    projected = white - basis @ (basis.T @ white)
    return replace(
        problem.likelihood,
        wd=white_blurring.T @ projected,
        dd=float(projected @ projected),
        whitened=replace(problem.likelihood.whitened, data=white),
    )


def test_the_treatments_differ_as_they_are_described(observed: Observed) -> None:
    observation = observed.simulation.observation
    problem = observed.problems["diagonal"]
    chosen = ~problem.core[problem.mask]
    sigma = observation.noise[problem.mask]
    stored = {name: observed.problems[name].likelihood.whitened.covariance for name in TREATMENTS}
    assert np.allclose(stored["diagonal"][chosen], sigma[chosen], rtol=1e-14)
    assert (stored["diagonal"][~chosen] > 999 * sigma[~chosen]).all()
    expected = np.sqrt(sigma**2 + 0.01 * np.abs(observation.image[problem.mask]))
    assert np.allclose(stored["paper_code"][chosen], expected[chosen], rtol=1e-14)
    rows = np.flatnonzero(problem.mask)
    covariance = observation.covariance[rows][:, rows].toarray()
    found = stored["covariance"] @ stored["covariance"].T
    scale = np.outer(sigma, sigma)[np.ix_(chosen, chosen)]
    difference = found[np.ix_(chosen, chosen)] - covariance[np.ix_(chosen, chosen)]
    assert np.abs(difference / scale).max() < 1e-6
    without = replace(observation, covariance=None)
    with pytest.raises(ObservationError, match="noise_treatment"):
        prepare_problem(without, true_fit(observed.simulation.scene), Analysis(noise_treatment="covariance"))
