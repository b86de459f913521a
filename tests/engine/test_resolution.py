"""The resolution of the source: what a noise-free source becomes, and the two ends of the regularisation."""

from dataclasses import replace

import numpy as np
import pytest

from engine.likelihood.amplitudes import LinearData
from engine.likelihood.evidence import invert
from engine.likelihood.resolution import resolution_matrix, source_resolution
from engine.posterior.traces import trace_evidence
from engine.source.regularisation import SourceModel
from tests.engine.dense_oracle import LENS, Case

MODEL = SourceModel((9, 11))


def test_the_resolution_matrix_is_what_a_noise_free_source_becomes() -> None:
    scene = Case(amplitudes=2)
    first = invert(scene.likelihood(), LENS, 2.0, MODEL)
    true = np.random.default_rng(4).normal(size=first.source.size)
    clean = scene.blurring @ first.lensing.apply(true) + scene.columns @ np.array([3.0, -2.0])
    scene.linear = LinearData(clean, scene.covariance, scene.columns)
    inversion = invert(scene.likelihood(), LENS, 2.0, MODEL)
    expected = resolution_matrix(inversion) @ true
    assert np.allclose(inversion.source.ravel(), expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())


def test_the_shares_of_the_data_add_up_to_the_effective_parameters() -> None:
    inversion = invert(Case().likelihood(), LENS, 1.0, MODEL)
    share = source_resolution(inversion).data_share
    assert share.shape == (9, 11)
    assert share.sum() == pytest.approx(inversion.effective_parameters(), rel=1e-9)
    assert (share > 0.0).all()
    # The corners of the rectangle round the traced ring see fewest rays.
    assert share[4, 5] > 3 * share[[0, 0, -1, -1], [0, -1, 0, -1]].max()


def test_without_a_prior_each_pixel_is_resolved_and_with_a_strong_one_none() -> None:
    likelihood = Case().likelihood()
    free = invert(likelihood, LENS, -28.0, SourceModel((6, 6)))
    resolution = source_resolution(free)
    assert np.allclose(resolution.data_share, 1.0, atol=1e-3)
    # The identity leaves a cell, whose second moment is (dx^2 + dy^2) / 12; FWHM is 2.3548 sigma.
    dx, dy = np.diff(free.grid.x)[0], np.diff(free.grid.y)[0]
    assert np.allclose(resolution.width, 2.3548 * np.sqrt((dx**2 + dy**2) / 12), rtol=0.01)
    held = source_resolution(invert(likelihood, LENS, 14.0, SourceModel((6, 6))))
    assert held.data_share.max() < 0.1
    assert held.width.min() > 2 * resolution.width.max()


def test_a_source_pixel_that_no_light_comes_from_has_no_width_and_no_share_of_the_data() -> None:
    inversion = invert(Case().likelihood(), LENS, 1.0, SourceModel((6, 6)))
    curvature = inversion.curvature.copy()
    curvature[0, :] = curvature[:, 0] = 0.0
    resolution = source_resolution(replace(inversion, curvature=curvature))
    assert resolution.data_share[0, 0] == pytest.approx(0.0, abs=1e-12)
    assert np.isinf(resolution.width).sum() == 1


def test_the_traces_of_a_gaussian_are_its_parabolas() -> None:
    root = np.array([[0.02, 0.0, 0.0], [0.03, 0.01, 0.0], [-0.2, 0.1, 0.4]])
    covariance, mean = root @ root.T, np.array([1.2, 3.1, -9.0])
    precision = np.linalg.inv(covariance)

    def target(values: np.ndarray) -> float:
        away = values - mean
        return float(7.0 - 0.5 * away @ precision @ away) if values[0] < 1.25 else -np.inf

    traces = trace_evidence(target, ("q", "phi", "ln_lambda"), mean, covariance)
    assert [trace.name for trace in traces] == ["q", "phi", "ln_lambda"]
    for trace, sd in zip(traces, np.sqrt(np.diag(covariance)), strict=True):
        assert trace.sd == pytest.approx(sd, rel=1e-12)
        finite = np.isfinite(trace.ln_evidence)
        assert np.allclose(trace.ln_evidence[finite], -0.5 * trace.offsets[finite] ** 2, atol=1e-9)
    # Beyond the prior of q, 2.5 of its standard deviations away.
    assert np.array_equal(np.isfinite(traces[0].ln_evidence), traces[0].offsets < 2.5)
