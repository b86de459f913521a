"""The strength of the regularisation, against the evidence itself."""

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from engine.errors import InversionError, SpecError
from engine.likelihood.amplitudes import LinearData
from engine.likelihood.evidence import invert, ln_evidence
from engine.likelihood.strength import find_strength
from engine.source.regularisation import SourceModel
from tests.engine.dense_oracle import LENS, Case

MODELS = [
    SourceModel((10, 10), "curvature"),
    SourceModel((9, 13), "gradient"),
    SourceModel((12, 7), "zeroth"),
]


def brent(likelihood, model) -> float:
    found = minimize_scalar(
        lambda t: -ln_evidence(likelihood, LENS, float(t), model),
        bounds=(-20.0, 10.0),
        method="bounded",
        options={"xatol": 1e-6},
    )
    return float(found.x)


@pytest.mark.parametrize("model", MODELS, ids=str)
def test_the_strength_is_the_maximum_of_the_evidence(model: SourceModel) -> None:
    likelihood = Case(amplitudes=2).likelihood()
    best = brent(likelihood, model)
    found = find_strength(likelihood, LENS, model)
    # Asked for is 1e-3. Brent itself cannot do better than the square root of rounding in ln Z.
    assert found.ln_lambda == pytest.approx(best, abs=1e-3)


@pytest.mark.parametrize("away", [-15.0, -6.0, -1.0, 0.0, 1.0, 6.0, 15.0])
def test_few_factorisations_find_the_strength_from_anywhere(away: float) -> None:
    likelihood, model = Case(amplitudes=2).likelihood(), SourceModel((12, 12))
    best = brent(likelihood, model)
    found = find_strength(likelihood, LENS, model, start=best + away)
    assert found.ln_lambda == pytest.approx(best, abs=1e-3)
    # Two to enclose the maximum, one more for each eight of ln lambda, and half a dozen by Brent.
    assert found.factorisations <= (9 if abs(away) <= 6 else 11)


def test_data_without_a_source_have_no_strength() -> None:
    scene, model = Case(amplitudes=0), SourceModel((9, 9))
    # Data half as noisy as their noise map says: the evidence rises until there is no source at all.
    noise = 0.5 * np.sqrt(scene.covariance) * np.random.default_rng(5).normal(size=scene.data.size)
    scene.linear = LinearData(noise, scene.covariance, scene.columns)
    likelihood = scene.likelihood()
    for start in (None, *np.arange(-12.0, 80.0, 4.0)):
        with pytest.raises(InversionError, match="stands out"):
            find_strength(likelihood, LENS, model, start=start)


def test_a_host_below_the_noise_is_inverted_and_its_strength_large() -> None:
    scene, model = Case(amplitudes=0), SourceModel((9, 9))
    likelihood = scene.likelihood()
    bright = find_strength(likelihood, LENS, model)
    rng = np.random.default_rng(2)
    inversion = invert(likelihood, LENS, bright.ln_lambda, model)
    arc = likelihood.blurring @ inversion.lensing.apply(inversion.source.ravel())
    sigma = np.sqrt(scene.covariance)
    # Even the brightest pixel is at 0.9 sigma.
    faint_data = 0.9 / (arc / sigma).max() * arc + sigma * rng.normal(size=arc.size)
    scene.linear = LinearData(faint_data, scene.covariance, scene.columns)
    faint = find_strength(scene.likelihood(), LENS, model)
    assert faint.ln_lambda > bright.ln_lambda + 2
    decided = [
        invert(data, LENS, strength.ln_lambda, model).effective_parameters()
        for data, strength in ((scene.likelihood(), faint), (likelihood, bright))
    ]
    assert 0 < decided[0] < 0.5 * decided[1]


def test_an_interval_the_wrong_way_round_is_refused() -> None:
    with pytest.raises(SpecError, match="ln lambda"):
        find_strength(Case(amplitudes=0).likelihood(), LENS, SourceModel((6, 6)), low=1.0, high=-1.0)


def test_an_interval_without_the_maximum_is_refused_at_either_side() -> None:
    likelihood, model = Case(amplitudes=1).likelihood(), SourceModel((9, 9))
    best = find_strength(likelihood, LENS, model).ln_lambda
    with pytest.raises(InversionError, match="upper"):
        find_strength(likelihood, LENS, model, low=best - 9.0, high=best - 3.0)
    with pytest.raises(InversionError, match="lower"):
        find_strength(likelihood, LENS, model, low=best + 3.0, high=best + 9.0)
