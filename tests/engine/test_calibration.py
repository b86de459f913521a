"""A measurement corrected by simulations like the image."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from engine import Host, ImageMeasurement, Realization, SpecError, calibrate, measure_image, simulate_realization
from engine.calibration import _calibrated, _image_with, _noise
from engine.result import Quantity
from engine.simulation.simulate import Simulation
from tests.engine.conftest import cut


@pytest.fixture(scope="module")
def ring() -> ImageMeasurement:
    """A host without AGN and without a deflector's light: a second a fit."""
    system = replace(cut(pixels=48), agn=(), deflector=None)
    realization = Realization(system=system, l_eta=1.0, host=Host(n=1.5, r_eff=0.3, magnitude=21.0))
    observation = replace(simulate_realization(realization).observation, response=None, covariance=None)
    return measure_image(observation, agn_images=0, deflector=False, theta_E=1.2, inversion=False)


def test_simulations_like_the_image_correct_and_widen_its_answer(ring: ImageMeasurement) -> None:
    steps: list[float] = []
    found = calibrate(ring, 6, seed=3, progress=lambda _, done: steps.append(done))
    assert steps == pytest.approx([k / 6 for k in range(1, 7)])
    assert found.simulations + sum(found.failed.values()) == 6
    magnitude = found.quantities["magnitude"]
    assert magnitude.measured == ring.host.magnitude
    assert magnitude.corrected.mean == pytest.approx(ring.host.magnitude.mean - magnitude.bias)
    # The model is the truth of its simulations: no bias but what rendering and priors leave, and scatter as the errors
    # say; six tell it to a third.
    assert abs(magnitude.bias) < magnitude.measured.sd
    assert 0.2 < magnitude.pull_sd < 2.0
    for one in found.quantities.values():
        assert one.corrected.sd >= one.measured.sd
        assert 4 <= one.covered95 <= 6
    document = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert document["quantities"]["radius"]["corrected"]["interval95"][0] > 0


def test_a_simulation_has_the_scatter_and_the_light_of_the_image(ring: ImageMeasurement) -> None:
    fit, observation = ring.fit, ring.observation
    again = _image_with(ring, fit.host, np.random.default_rng(0))
    np.testing.assert_array_equal(again, _image_with(ring, fit.host, np.random.default_rng(0)))
    residual = (again - fit.model) / (ring.noise_scale * observation.noise)
    # 2,304 pixels: their scatter is known to 1.5 %.
    assert float(residual.std()) == pytest.approx(1.0, abs=0.06)
    brighter = _image_with(ring, replace(fit.host, flux=2 * fit.host.flux), np.random.default_rng(0))
    np.testing.assert_allclose((brighter - again).sum(), fit.arc.sum(), rtol=1e-6)


def test_noise_is_drawn_with_its_covariance(simulation: Simulation) -> None:
    observation = simulation.observation
    assert observation.covariance is not None
    draws = np.stack([_noise(observation, np.random.default_rng(seed)).ravel() for seed in range(40)])
    covariance = observation.covariance.tocsr()
    rows, deviations = np.arange(700, 3400, 10), np.sqrt(covariance.diagonal())
    for step in (0, 1, 64, 65):
        scale = deviations[rows] * deviations[rows + step]
        wanted = np.asarray(covariance[rows, rows + step]).ravel() / scale
        found = (draws[:, rows] * draws[:, rows + step]).mean(axis=0) / scale
        # 40 draws of 270 pixels: their mean correlation is known to 0.014.
        assert found.mean() == pytest.approx(wanted.mean(), abs=0.05)
        assert step == 0 or wanted.mean() > 0.02, "a correlation that there is"


@pytest.mark.parametrize(("bias", "scatter"), [(0.0, 1.0), (0.4, 1.0), (-0.2, 2.0)])
def test_a_calibrated_interval_covers_whatever_the_bias_and_the_scatter(bias: float, scatter: float) -> None:
    rng, inside, trials, sd = np.random.default_rng(1), 0, 600, 0.1
    for _ in range(trials):
        measured = [Quantity(20.0 + bias + scatter * sd * rng.standard_normal(), sd) for _ in range(13)]
        found = _calibrated(measured[0], [(one, 20.0) for one in measured[1:]])
        low, high = found.corrected.interval95
        inside += low < 20.0 < high
    # 600 trials: 0.9 % of scatter. It may cover by more, since an interval never shrinks.
    assert 0.93 < inside / trials < 0.985


def test_what_cannot_be_calibrated_is_refused_by_name(ring: ImageMeasurement) -> None:
    with pytest.raises(SpecError, match="calibrate"):
        calibrate(ring, 5)
    with pytest.raises(SpecError, match="not_detected"):
        calibrate(replace(ring, status="not_detected"), 6)
