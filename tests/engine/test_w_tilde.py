"""The fast path of the evidence against plain matrices: blocks of W, banded noise, the curvature matrix."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scipy import sparse

from engine.errors import InversionError
from engine.imaging.optics.stamp_matrix import blurring_matrix
from engine.likelihood.amplitudes import LinearData, MarginalLikelihood, marginalise_amplitudes
from engine.likelihood.curvature import curvature_matrix
from engine.likelihood.evidence import ln_evidence
from engine.likelihood.noise import factorise_noise
from engine.likelihood.w_tilde import TILE, compute_w_tilde
from engine.source.lensing_matrix import LensingMatrix, cast_rays, map_rays
from engine.source.regularisation import SourceModel
from tests.engine.dense_oracle import LENS, SCALE

SIDE = 45
LENS_HERE = LENS.with_values(theta_E=1.3)


def plain_curvature(likelihood: MarginalLikelihood, mapping: LensingMatrix) -> np.ndarray:
    """F from dense matrices, the amplitudes projected out of the whitened problem."""
    white = likelihood.whitened
    factor = np.diag(white.covariance) if white.covariance.ndim == 1 else white.covariance
    g = np.linalg.solve(factor, likelihood.blurring.toarray() @ mapping.dense())
    if likelihood.amplitudes:
        q, _ = np.linalg.qr(white.columns)
        g = g - q @ (q.T @ g)
    return np.asarray(g.T @ g)


def ring_likelihood(correlation: float, amplitudes: int, extra: int = 0) -> MarginalLikelihood:
    """A ring several PSFs wide, each pixel of which answers differently."""
    rng = np.random.default_rng(4)
    axis = (np.arange(SIDE) - SIDE // 2) * SCALE
    r = np.hypot(*np.meshgrid(axis, axis))
    mask, lit = (r > 0.5) & (r < 2.0), r < 2.2
    rays = cast_rays(mask, lit, axis, axis, SCALE, 2)
    offset = np.arange(-3, 4)
    blurring = blurring_matrix(np.exp(-0.3 * np.add.outer(offset**2, offset**2)), np.nonzero(mask), np.nonzero(lit))
    blurring.data *= rng.uniform(0.8, 1.2, blurring.data.size)
    m = int(mask.sum())
    blurring = sparse.hstack([blurring, rng.normal(size=(m, extra))], format="csr")
    covariance = rng.uniform(0.5, 1.5, m)
    if correlation:
        near = np.full((3, 3), correlation)
        near[1, 1] = 1.0
        deviations = sparse.diags(np.sqrt(covariance))
        covariance = deviations @ blurring_matrix(near, np.nonzero(mask), np.nonzero(mask)) @ deviations
    linear = LinearData(rng.normal(size=m), covariance, rng.normal(size=(m, amplitudes)))
    return marginalise_amplitudes(linear, blurring, rays)


@pytest.mark.parametrize("shape", [(8, 8), (11, 13), (5, 30)])
@pytest.mark.parametrize(("correlation", "amplitudes"), [(0.0, 0), (0.0, 4), (0.1, 3)])
def test_the_curvature_matrix_equals_the_plain_one(correlation: float, amplitudes: int, shape: tuple[int, int]) -> None:
    likelihood = ring_likelihood(correlation, amplitudes)
    mapping = map_rays(likelihood.rays, LENS_HERE, shape)
    fast = np.tril(curvature_matrix(likelihood.w_tilde, likelihood.border, mapping))
    plain = plain_curvature(likelihood, mapping)
    # Both round each of some thousand products once.
    assert np.abs(fast - np.tril(plain)).max() < 1e-13 * np.abs(plain).max()


@pytest.mark.parametrize("correlation", [0.0, 0.1])
def test_the_blocks_hold_the_whole_of_w_and_leave_out_what_does_not_interact(correlation: float) -> None:
    likelihood = ring_likelihood(correlation, 0, extra=1)
    b, noise = likelihood.blurring, likelihood.whitened.noise
    white = noise.whiten(b.toarray())
    plain = white.T @ white
    assert np.abs(likelihood.w_tilde.dense() - plain).max() < 1e-14 * np.abs(plain).max()
    patches = -(-b.shape[1] // TILE)
    assert likelihood.w_tilde.blocks.shape[0] < (0.7 if correlation == 0.0 else 1.01) * patches * (patches + 1) / 2


def test_under_a_covariance_only_what_is_next_to_nothing_is_left_out() -> None:
    # A strip ten times as long as light and the inverse of the covariance reach, so that both substitutions end early.
    shape, rng = (150, 6), np.random.default_rng(5)
    lit = np.ones(shape, dtype=bool)
    axes = (np.arange(size) * SCALE for size in shape[::-1])
    rays = cast_rays(lit, np.zeros(shape, dtype=bool), *axes, SCALE, 1)
    blurring = blurring_matrix(rng.uniform(0.5, 1.0, (5, 5)), np.nonzero(lit), np.nonzero(lit))
    near = np.full((3, 3), 0.05)
    near[1, 1] = 1.0
    # Pixels that are left out by their noise are as quiet as the end of a substitution, and are none.
    deviations = sparse.diags(np.where(np.arange(lit.size) % 7 == 0, 1e18, rng.uniform(0.8, 1.2, lit.size)))
    noise = factorise_noise(deviations @ blurring_matrix(near, np.nonzero(lit), np.nonzero(lit)) @ deviations)
    w_tilde = compute_w_tilde(blurring, noise, rays)
    white = noise.whiten(blurring.toarray())
    plain = white.T @ white
    scale = np.sqrt(np.diag(plain))
    # Entries below 1e-12 of their diagonals may be missing; the plain matrix rounds by less than that.
    assert (np.abs(w_tilde.dense() - plain) / np.outer(scale, scale)).max() < 1.1e-12
    patches = w_tilde.start.size - 1
    assert w_tilde.blocks.shape[0] < 0.5 * patches * (patches + 1) / 2
    assert w_tilde.blocks.ctypes.data % 64 == 0


def test_a_column_of_the_blurring_that_is_no_pixel_takes_part_in_the_evidence() -> None:
    without, likelihood = ring_likelihood(0.0, 2), ring_likelihood(0.0, 2, extra=1)
    mapping = map_rays(without.rays, LENS_HERE, (9, 9))
    # One more row of L, which takes light from the third source pixel alone.
    more = LensingMatrix(
        mapping.grid,
        np.vstack([mapping.columns, np.full((1, mapping.columns.shape[1]), 3, dtype=np.int32)]),
        np.vstack([mapping.weights, np.full((1, mapping.columns.shape[1]), 0.7)]),
        np.append(mapping.entries, 1).astype(np.int32),
    )
    fast = np.tril(curvature_matrix(likelihood.w_tilde, likelihood.border, more))
    plain = plain_curvature(likelihood, more)
    assert np.abs(fast - np.tril(plain)).max() < 1e-13 * np.abs(plain).max()


def test_banded_noise_whitens_as_the_dense_factor_does() -> None:
    likelihood = ring_likelihood(0.1, 0)
    noise, factor = likelihood.whitened.noise, likelihood.whitened.covariance
    assert noise.bands.shape[0] < noise.bands.shape[1] / 5
    values = np.random.default_rng(0).normal(size=(factor.shape[0], 3))
    assert np.allclose(factor @ noise.whiten(values), values, atol=1e-12)
    assert np.allclose(factor.T @ noise.whiten_transposed(values[:, 0]), values[:, 0], atol=1e-12)
    assert noise.ln_determinant == pytest.approx(np.linalg.slogdet(factor @ factor.T)[1], rel=1e-12)
    assert np.allclose(noise.variances(), np.diag(factor @ factor.T), rtol=1e-12)
    with pytest.raises(InversionError, match="covariance"):
        factorise_noise(np.array([[1.0, 2.0], [2.0, 1.0]]))


def test_the_banded_factor_is_that_of_the_covariance_to_its_last_band() -> None:
    rng = np.random.default_rng(7)
    root = np.tril(np.triu(rng.normal(size=(30, 30)), -4))
    root[np.diag_indices(30)] = rng.uniform(1.0, 2.0, 30)
    noise = factorise_noise(sparse.csr_matrix(root @ root.T))
    assert noise.bands.shape == (5, 30)
    for offset in range(5):
        assert np.allclose(noise.bands[offset, : 30 - offset], np.diag(root, -offset), atol=1e-12), offset
    values = rng.normal(size=30)
    assert np.allclose(noise.whiten(values), np.linalg.solve(root, values), atol=1e-10)


def test_dark_pixels_without_any_response_are_no_obstacle() -> None:
    likelihood = ring_likelihood(0.0, 0)
    b = likelihood.blurring.toarray()
    b[:, :100] = 0.0
    w_tilde = compute_w_tilde(sparse.csr_matrix(b), likelihood.whitened.noise, likelihood.rays)
    white = likelihood.whitened.noise.whiten(b)
    assert np.allclose(w_tilde.dense(), white.T @ white, atol=1e-13)


def test_threads_evaluate_at_once_without_disturbing_each_other() -> None:
    likelihood = ring_likelihood(0.0, 3)
    lenses = [LENS_HERE.with_values(theta_E=1.2 + 0.01 * k) for k in range(8)]
    models = [SourceModel((12, 12)), SourceModel((9, 14))]
    jobs = [(lens, model) for lens in lenses for model in models]
    alone = [ln_evidence(likelihood, lens, 0.0, model) for lens, model in jobs]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda job: ln_evidence(likelihood, job[0], 0.0, job[1]), jobs))
    assert together == alone
