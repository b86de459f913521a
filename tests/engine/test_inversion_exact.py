"""ln Z, source, amplitudes and posterior covariance equal an inversion written out, to 1e-8."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import lapack

from engine.likelihood.amplitudes import LinearData
from engine.likelihood.evidence import invert, ln_evidence
from engine.source.lensing_matrix import RayBundle
from engine.source.regularisation import SourceModel
from tests.engine.explicit_inversion import LENS, Explicit, stamp, stamp_likelihood

SMALL, WIDE, TALL = SourceModel((10, 10)), SourceModel((10, 12)), SourceModel((16, 11), "gradient")
SET = [
    (Explicit(), SMALL),
    (Explicit(), WIDE),
    (Explicit(), TALL),
    (Explicit(), SourceModel((11, 17), "zeroth")),
    (Explicit(), SourceModel((12, 12), "gradient")),
    (Explicit(mask="partial"), SMALL),
    (Explicit(mask="partial", correlated=True), TALL),
    (Explicit(mask="holes"), SourceModel((15, 15), "zeroth")),
    (Explicit(mask="holes", correlated=True), WIDE),
    (Explicit(mask="disc", psf="wide"), SMALL),
    (Explicit(psf="symmetric"), TALL),
    (Explicit(psf="negative wings"), SMALL),
    (Explicit(psf="negative wings", mask="holes", correlated=True), SMALL),
    (Explicit(psf="one pixel"), TALL),
    (Explicit(subrays=1), SMALL),
    (Explicit(subrays=3), TALL),
    (Explicit(subrays=4), WIDE),
    (Explicit(columns=()), SMALL),
    (Explicit(columns=(), correlated=True), TALL),
    (Explicit(columns=("agn",)), WIDE),
    (Explicit(columns=("deflector",), correlated=True), SMALL),
    (Explicit(columns=("background",)), TALL),
    (Explicit(columns=("agn", "background"), correlated=True), SMALL),
    (Explicit(), SourceModel((30, 30))),
    (Explicit(correlated=True), SourceModel((20, 34), "gradient")),
    (Explicit(subrays=1), SourceModel((60, 10), "gradient")),
    (Explicit(), SourceModel((40, 40), "curvature")),
    pytest.param(Explicit(), SourceModel((60, 60)), marks=pytest.mark.long),
]


@pytest.mark.parametrize(("scene", "model"), SET, ids=str)
def test_the_inversion_is_exact(scene: Explicit, model: SourceModel) -> None:
    likelihood = scene.likelihood()
    largest = model.shape == (60, 60)
    for ln_lambda in (-1.0,) if largest else (-3.0, 1.0):
        expected = scene.solve(ln_lambda, model)
        found = invert(likelihood, scene.lens, ln_lambda, model)
        # 1e-8 of each quantity, of its largest element for vectors and matrices.
        assert found.ln_evidence == pytest.approx(expected.ln_evidence, rel=1e-8)
        assert ln_evidence(likelihood, scene.lens, ln_lambda, model) == pytest.approx(expected.ln_evidence, rel=1e-8)
        assert _difference(found.source.ravel(), expected.source) < 1e-8
        arc = likelihood.blurring @ found.lensing.apply(found.source.ravel())
        if expected.amplitudes.size:
            assert _difference(likelihood.fit_amplitudes(arc), expected.amplitudes) < 1e-8
        n = expected.source.size
        which = np.unique(np.linspace(0, n - 1, 60).astype(int)) if n > 400 else np.arange(n)
        if largest:
            unit = np.zeros((n, which.size))
            unit[which, np.arange(which.size)] = 1.0
            covariance, _ = lapack.dpotrs(found.factor, unit, lower=0)
        else:
            covariance = found.source_covariance()[:, which]
        assert _difference(covariance, expected.covariance_columns(which)) < 1e-8


def _difference(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.abs(found - expected).max() / np.abs(expected).max())


PROPERTY = settings(max_examples=12, deadline=None)
SCENES = st.sampled_from(
    [Explicit(), Explicit(correlated=True, mask="holes"), Explicit(columns=(), psf="negative wings", mask="partial")]
)
MODELS = st.sampled_from([SMALL, WIDE, TALL, SourceModel((9, 9), "zeroth")])


def _covariance(scene: Explicit) -> np.ndarray:
    covariance = scene.linear.covariance
    return np.diag(covariance) if covariance.ndim == 1 else covariance


@PROPERTY
@given(scene=SCENES, model=MODELS, seed=st.integers(0, 2**20))
def test_the_order_of_the_pixels_does_not_matter(scene: Explicit, model: SourceModel, seed: int) -> None:
    likelihood, linear, rays = scene.likelihood(), scene.linear, scene.likelihood().rays
    rng = np.random.default_rng(seed)
    data, light = rng.permutation(linear.data.size), rng.permutation(rays.pixels)
    per_pixel = rays.subrays**2
    moved = RayBundle(
        rays.x.reshape(-1, per_pixel)[light].ravel(),
        rays.y.reshape(-1, per_pixel)[light].ravel(),
        rays.subrays,
        rays.in_mask[light],
        rays.pixel_area,
        rays.anchors,
    )
    other = stamp_likelihood(
        LinearData(linear.data[data], _covariance(scene)[np.ix_(data, data)], linear.columns[data]),
        stamp(scene.psf),
        moved,
        tuple(axis[data] for axis in np.nonzero(scene.chosen)),  # type: ignore[arg-type]
        tuple(axis[light] for axis in np.nonzero(scene.rayed)),  # type: ignore[arg-type]
    )
    expected = ln_evidence(likelihood, LENS, 0.0, model)
    assert ln_evidence(other, LENS, 0.0, model) == pytest.approx(expected, rel=1e-9)


@PROPERTY
@given(scene=SCENES, model=MODELS, ln_factor=st.floats(-12.0, 12.0))
def test_other_units_of_flux_only_shift_the_evidence(scene: Explicit, model: SourceModel, ln_factor: float) -> None:
    linear, factor = scene.linear, math.exp(ln_factor)
    pixels = np.nonzero(scene.chosen), np.nonzero(scene.rayed)
    likelihood = scene.likelihood()
    scaled = LinearData(factor * linear.data, factor**2 * linear.covariance, linear.columns)
    other = stamp_likelihood(scaled, stamp(scene.psf), likelihood.rays, *pixels)
    here = invert(likelihood, LENS, 0.3, model)
    there = invert(other, LENS, 0.3 - 2 * ln_factor, model)
    # The flat prior of the amplitudes has units too: k of the M factors are theirs.
    shift = (likelihood.data_points - likelihood.amplitudes) * ln_factor
    assert there.ln_evidence == pytest.approx(here.ln_evidence - shift, abs=1e-7 * (1 + abs(shift)))
    assert _difference(there.source / factor, here.source) < 1e-9


@PROPERTY
@given(
    scene=SCENES,
    model=MODELS,
    dx=st.floats(-5.0, 5.0),
    dy=st.floats(-5.0, 5.0),
    sheared=st.booleans(),
)
def test_shifting_the_frame_shifts_the_source_grid_alone(
    scene: Explicit, model: SourceModel, dx: float, dy: float, sheared: bool
) -> None:
    likelihood = scene.likelihood()
    lens = LENS if sheared else LENS.with_values(gamma1=0.0, gamma2=0.0)
    rays = likelihood.rays
    moved = RayBundle(
        rays.x + dx, rays.y + dy, rays.subrays, rays.in_mask, rays.pixel_area, rays.anchors + np.array([dx, dy])
    )
    pixels = np.nonzero(scene.chosen), np.nonzero(scene.rayed)
    other = stamp_likelihood(scene.linear, stamp(scene.psf), moved, *pixels)
    here = invert(likelihood, lens, 0.0, model)
    there = invert(other, lens.with_values(x=lens.x + dx, y=lens.y + dy), 0.0, model)
    # Shear is about the origin of the frame: a shifted frame shifts the source by (1 - Gamma) of it.
    shift = (dx - lens.gamma1 * dx - lens.gamma2 * dy, dy - lens.gamma2 * dx + lens.gamma1 * dy)
    assert there.ln_evidence == pytest.approx(here.ln_evidence, rel=1e-8)
    assert np.allclose(there.grid.x, here.grid.x + shift[0], atol=1e-12)
    assert np.allclose(there.grid.y, here.grid.y + shift[1], atol=1e-12)


@PROPERTY
@given(model=MODELS, pixel=st.integers(0, 10**6), apart=st.floats(-3.0, 3.0))
def test_a_pixel_measured_twice_with_root_two_noise_says_the_same(model: SourceModel, pixel: int, apart: float) -> None:
    scene = Explicit()
    linear, likelihood = scene.linear, scene.likelihood()
    at = pixel % linear.data.size
    sigma = math.sqrt(linear.covariance[at])
    twice = np.append(np.arange(linear.data.size), at)
    data, variance = linear.data[twice].copy(), linear.covariance[twice].copy()
    data[[at, -1]] += apart * sigma * np.array([1.0, -1.0])
    variance[[at, -1]] *= 2.0
    rows, columns = np.nonzero(scene.chosen)
    other = stamp_likelihood(
        LinearData(data, variance, linear.columns[twice]),
        stamp(scene.psf),
        likelihood.rays,
        (rows[twice], columns[twice]),
        np.nonzero(scene.rayed),
    )
    here, there = invert(likelihood, LENS, 0.0, model), invert(other, LENS, 0.0, model)
    assert _difference(there.source, here.source) < 1e-9
    # The two measurements differ by 2 apart sigma with a deviation of 2 sigma: one Gaussian more in the evidence.
    extra = -0.5 * apart**2 - math.log(2.0 * sigma) - 0.5 * math.log(2.0 * math.pi)
    assert there.ln_evidence == pytest.approx(here.ln_evidence + extra, rel=1e-9)
