"""The evidence and the solution against a dense oracle that writes out every matrix."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.errors import InversionError
from engine.imaging.convolution import convolve
from engine.imaging.optics.stamp_matrix import pixel_kernel
from engine.lensing.power_law import PowerLawLens
from engine.likelihood.amplitudes import LinearData, marginalise_amplitudes
from engine.likelihood.evidence import invert, ln_evidence
from engine.source.lensing_matrix import RayBundle, map_rays
from engine.source.regularisation import SourceModel, ln_determinant, sparse_regularisation
from tests.engine.dense_oracle import LENS, SCALE, Case

CASES = [
    {},
    {"mask": "partial", "psf": "gaussian"},
    {"mask": "holes", "psf": "negative wings"},
    {"subrays": 1},
    {"subrays": 3, "amplitudes": 6},
    {"amplitudes": 0},
    {"correlated": True},
    {"amplitude_sd": 0.02},
    {"amplitude_sd": 0.3, "correlated": True},
    {"correlated": True, "amplitudes": 0, "mask": "holes"},
]
MODELS = [
    SourceModel((10, 10), "curvature"),
    SourceModel((9, 13), "gradient"),
    SourceModel((12, 7), "zeroth"),
]


@pytest.mark.parametrize("model", MODELS, ids=str)
@pytest.mark.parametrize("case", CASES, ids=str)
def test_evidence_source_and_covariance_equal_the_dense_oracle(case: dict[str, object], model: SourceModel) -> None:
    scene = Case(**case)
    likelihood = scene.likelihood()
    for ln_lambda in (-3.0, 2.0):
        value, solution, covariance = scene.oracle(LENS, ln_lambda, model)
        inversion = invert(likelihood, LENS, ln_lambda, model)
        n = inversion.source.size
        assert ln_evidence(likelihood, LENS, ln_lambda, model) == inversion.ln_evidence
        assert inversion.ln_evidence == pytest.approx(value, rel=1e-8, abs=1e-6)
        assert np.allclose(inversion.source.ravel(), solution[:n], rtol=1e-8, atol=1e-8 * np.abs(solution[:n]).max())
        variance = inversion.source_variance().ravel()
        assert np.allclose(variance, np.diag(covariance)[:n], rtol=1e-7)
        arc = likelihood.blurring @ inversion.lensing.apply(inversion.source.ravel())
        if solution.size > n:
            assert np.allclose(likelihood.fit_amplitudes(arc), solution[n:], rtol=1e-6, atol=1e-8)


def test_the_effective_parameters_are_those_that_the_prior_does_not_decide() -> None:
    scene, model = Case(amplitudes=2), SourceModel((8, 8))
    inversion = invert(scene.likelihood(), LENS, 1.0, model)
    _, _, covariance = scene.oracle(LENS, 1.0, model)
    prior_share = math.e * np.trace(covariance[:64, :64] @ sparse_regularisation(model).toarray())
    assert inversion.effective_parameters() == pytest.approx(64 - prior_share, rel=1e-8)


def test_the_source_draws_have_the_posterior_mean_and_covariance() -> None:
    scene = Case(amplitudes=1)
    inversion = invert(scene.likelihood(), LENS, 1.0, SourceModel((6, 6)))
    rng = np.random.default_rng(3)
    draws = np.array([inversion.draw_source(rng).ravel() for _ in range(4000)])
    sd = np.sqrt(inversion.source_variance().ravel())
    # 4,000 draws: the mean is known to 0.016 sd, the deviation to 1.1 %; four of those over 36 pixels.
    assert np.abs((draws.mean(axis=0) - inversion.source.ravel()) / sd).max() < 0.065
    assert np.abs(draws.std(axis=0) / sd - 1).max() < 0.05
    _, _, covariance = scene.oracle(LENS, 1.0, SourceModel((6, 6)))
    expected = covariance[:36, :36] / np.outer(sd, sd)
    assert np.abs(np.corrcoef(draws.T) - expected).max() < 0.08


@pytest.mark.parametrize("name", ["zeroth", "gradient", "curvature"])
@pytest.mark.parametrize("shape", [(2, 2), (5, 9), (14, 11)])
def test_ln_determinant_of_the_regularisation(name: str, shape: tuple[int, int]) -> None:
    model = SourceModel(shape, name)  # type: ignore[arg-type]
    h = sparse_regularisation(model).toarray()
    sign, expected = np.linalg.slogdet(h)
    assert sign == 1.0
    assert ln_determinant(model) == pytest.approx(expected, abs=1e-8)
    assert np.allclose(h, h.T, rtol=1e-12)


@settings(max_examples=15, deadline=None)
@given(factor=st.floats(0.1, 10.0))
def test_scaling_data_noise_and_source_together_only_shifts_the_evidence(factor: float) -> None:
    scene = Case(amplitudes=2)
    model = SourceModel((8, 8))
    reference = ln_evidence(scene.likelihood(), LENS, 0.5, model)
    m, k = scene.data.size, 2
    scene.linear = LinearData(factor * scene.data, factor**2 * scene.covariance, scene.columns)
    scaled = ln_evidence(scene.likelihood(), LENS, 0.5 - 2 * math.log(factor), model)
    assert scaled == pytest.approx(reference - (m - k) * math.log(factor), abs=1e-6)


def test_shifting_the_frame_changes_nothing() -> None:
    scene, model = Case(), SourceModel((9, 9))
    rays = scene.rays
    moved = RayBundle(rays.x + 0.37, rays.y - 0.21, rays.subrays, rays.in_mask, rays.pixel_area, rays.anchors)
    likelihood = scene.likelihood()
    # The shear acts about the origin: without it the whole problem moves rigidly.
    lens = LENS.with_values(gamma1=0.0, gamma2=0.0)
    shifted = marginalise_amplitudes(scene.linear, likelihood.blurring, moved)
    there = ln_evidence(shifted, lens.with_values(x=lens.x + 0.37, y=lens.y - 0.21), 0.0, model)
    assert there == pytest.approx(ln_evidence(likelihood, lens, 0.0, model), abs=1e-7)


def test_leaving_out_a_component_equals_having_none() -> None:
    scene, model = Case(amplitudes=0), SourceModel((9, 9))
    empty = ln_evidence(scene.likelihood(), LENS, 0.0, model)
    value, _, _ = scene.oracle(LENS, 0.0, model)
    assert empty == pytest.approx(value, rel=1e-10)
    plain = LENS.with_values(gamma1=0.0, gamma2=0.0)
    without = ln_evidence(scene.likelihood(), PowerLawLens(0.8, 0.8, 0.4, 2.05, 0.02, -0.01), 0.0, model)
    assert ln_evidence(scene.likelihood(), plain, 0.0, model) == without


def test_noise_that_is_not_positive_and_dependent_amplitudes_are_refused() -> None:
    scene = Case(amplitudes=2)
    scene.linear = LinearData(scene.data, np.zeros(scene.data.size), scene.columns)
    with pytest.raises(InversionError, match="noise"):
        scene.likelihood()
    twice = np.repeat(scene.columns[:, :1], 2, axis=1)
    scene.linear = LinearData(scene.data, scene.covariance, twice)
    with pytest.raises(InversionError, match="amplitudes"):
        scene.likelihood()


def test_rays_of_the_mask_are_inside_the_grid_and_those_far_outside_carry_no_light() -> None:
    scene = Case(subrays=1)
    mapping = map_rays(scene.rays, LENS, (7, 7))
    inside = mapping.entries > 0
    assert inside[scene.rays.in_mask].all()
    total = np.array([mapping.weights[p, : mapping.entries[p]].sum() for p in range(mapping.entries.size)])
    # Bilinear weights of a ray add up to one ray's area, to less where the source falls to zero beyond the grid.
    assert np.allclose(total[scene.rays.in_mask], SCALE**2, rtol=1e-9)
    assert ((total[inside] > 0) & (total[inside] <= SCALE**2 * (1 + 1e-12))).all()
    assert (~inside).any()
    assert (total[~scene.rays.in_mask & inside] < 0.99 * SCALE**2).any()


def test_the_pixel_kernel_undoes_the_average_over_the_subrays() -> None:
    # A smooth source sampled by sub-rays, averaged and blurred, equals the point-sampled source blurred by the PSF.
    n, subrays = 41, 2
    grid = np.arange(n) - 20
    psf = np.exp(-0.5 * np.add.outer(grid**2, grid**2) / 1.3**2)[8:-8, 8:-8]
    psf /= psf.sum()

    def blob(dx: float, dy: float) -> np.ndarray:
        return np.exp(-0.5 * np.add.outer((grid + dy) ** 2, (grid + dx - 0.3) ** 2) / 2.0**2)

    averaged = sum(blob(a, b) for a in (-0.25, 0.25) for b in (-0.25, 0.25)) / 4
    ours = convolve(averaged, pixel_kernel(psf, subrays))
    exact = convolve(blob(0, 0), psf)
    naive = convolve(averaged, psf)
    inner = slice(10, -10)
    error = np.abs(ours - exact)[inner, inner].max()
    assert error < 2e-4 * exact.max()
    assert np.abs(naive - exact)[inner, inner].max() > 20 * error
