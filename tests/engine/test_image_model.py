"""The parametric image model: its PSF, its rays and its derivatives."""

import math

import numpy as np
import pytest
from scipy import ndimage

from engine.conventions import ellipticity
from engine.imaging.observation import Observation
from engine.imaging.optics.spline import place_spline, place_stamp, spline_coefficients
from engine.imaging.optics.stamp_blur import deposit_matrix
from engine.lensing.power_law import PowerLawLens
from engine.light.sersic import SersicProfile
from engine.parametric.model import ImageModel, weights_sigma
from engine.parametric.parameters import ParameterSpace

SCALE = 0.08


def _psf(width: float = 1.1, side: int = 21) -> np.ndarray:
    axis = np.arange(side) - side // 2
    psf = np.exp(-0.5 * (axis[:, None] ** 2 + axis[None, :] ** 2) / width**2)
    return np.asarray(psf / psf.sum())


@pytest.fixture(scope="module")
def observation() -> Observation:
    rng = np.random.default_rng(2)
    return Observation(rng.normal(1.0, 0.1, (41, 43)), np.full((41, 43), 0.1), _psf(), SCALE, 25.0)


@pytest.fixture(scope="module")
def values() -> np.ndarray:
    lens, host = PowerLawLens(0.8, 0.7, 0.4, 2.1, 0.02, -0.01), SersicProfile(1.0, 0.25, 1.5, 0.8, 1.0, 0.06, 0.04)
    agn = [0.7, 0.5, -0.6, -0.4]
    deflector = [math.log(0.6), 3.0, 0.05, 0.02, 0.011, -0.013]
    mass = [lens.theta_E, *ellipticity(lens.q, lens.phi), lens.slope, lens.x, lens.y, 0.03, -0.02]
    light = [math.log(host.r_eff), host.n, *ellipticity(host.q, host.phi), host.x, host.y]
    return np.array([*agn, *deflector, *mass, *light])


def _model(observation: Observation, *, exact: bool, subrays: int = 2) -> ImageModel:
    ny, nx = observation.shape
    window = (slice(0, ny), slice(0, nx))
    space = ParameterSpace(2, deflector=True, shear=True)
    return ImageModel(observation, space, weights_sigma(observation), window, subrays=subrays, exact=exact)


def test_a_moved_stamp_keeps_its_light_and_its_whole_pixel_shape() -> None:
    psf = _psf()
    assert np.allclose(place_stamp(psf, (41, 41), 20.0, 20.0)[10:31, 10:31], psf, rtol=0, atol=1e-15)
    # The stamp ends at 1e-9 of its peak: what a spline spreads beyond is of that size.
    assert place_stamp(psf, (41, 41), 20.3, 19.6).sum() == pytest.approx(1.0, abs=1e-7)


def test_a_moved_undersampled_stamp_leaves_no_stripes() -> None:
    moved = place_stamp(_psf(0.45), (61, 61), 30.4, 30.3)
    far = np.abs(moved[:, 45:]).max()
    # Moved by a phase in Fourier space, the same stamp leaves 2e-3 of its peak 15 pixels away.
    assert far < 1e-7 * moved.max()


def test_the_derivative_of_a_stamp_is_that_of_its_spline() -> None:
    spline, step = spline_coefficients(_psf()), 1e-5
    for along, (dx, dy) in {"column": (step, 0.0), "row": (0.0, step)}.items():
        ahead, behind = (place_spline(spline, (41, 41), 20.3 + s * dx, 19.6 + s * dy) for s in (1, -1))
        given = place_spline(spline, (41, 41), 20.3, 19.6, along=along)
        # Second differences of a cubic over 1e-5: 1e-10, over rounding of 1e-17 / 1e-5.
        assert np.allclose((ahead - behind) / (2 * step), given, rtol=0, atol=1e-9)


@pytest.mark.parametrize("subrays", [1, 2, 3])
def test_a_ray_is_blurred_as_a_star_in_its_place(observation: Observation, subrays: int) -> None:
    model = _model(observation, exact=False, subrays=subrays)
    blur = model._inner
    fine = np.zeros((blur.y.size, blur.x.size))
    row, column = 20 * subrays + subrays - 1, 17 * subrays
    fine[row, column] = 1.0
    star = observation.point_source(float(blur.x[column]), float(blur.y[row]))
    # The spline of the PSF is the same for both: rounding of the Fourier transform is all that differs.
    assert np.allclose(blur(fine, integrated=False), star, rtol=0, atol=1e-12)


def test_rays_keep_their_light() -> None:
    for subrays in (1, 2, 5):
        inside = deposit_matrix(20, subrays).toarray()[:, 3 * subrays : -3 * subrays]
        assert np.allclose(inside.sum(axis=0), 1.0, rtol=0, atol=1e-14)


def test_the_jacobian_is_that_of_the_residuals(observation: Observation, values: np.ndarray) -> None:
    model = _model(observation, exact=False)
    space = model.space
    best, _, columns = model.amplitudes(values)
    given, amplitudes = model.full_jacobian(values)
    assert np.array_equal(amplitudes, best)
    step = 1e-5
    for k in range(space.size):
        ahead, behind = values.copy(), values.copy()
        ahead[k] += step
        behind[k] -= step
        moved = (model.columns(ahead) - model.columns(behind)) @ best / (2 * step)
        size = np.abs(moved).max()
        # One-sided differences of steps of 1e-5 to 1e-3 against central ones.
        assert np.allclose(given[: moved.size, k], moved, rtol=0, atol=5e-3 * size), k
    assert np.allclose(given[: columns.shape[0], space.size :], columns)
    projected = model.jacobian(values)
    for column in columns.T:
        # Kaufman's form: nothing is left along the amplitudes' columns.
        assert np.abs(column @ projected[: columns.shape[0]]).max() < 1e-6 * np.abs(projected).max() * (
            np.linalg.norm(column)
        )


def test_a_sampled_deflector_is_the_integrated_one_away_from_its_cusp(
    observation: Observation, values: np.ndarray
) -> None:
    exact, sampled = (_model(observation, exact=kind).columns(values)[:, 2] for kind in (True, False))
    y, x = np.indices(observation.shape)
    far = (np.hypot(x - 21, y - 20) > 8).ravel()
    assert np.allclose(exact[far], sampled[far], rtol=2e-2)


def test_pixels_without_weight_do_not_count(observation: Observation, values: np.ndarray) -> None:
    valid = np.ones(observation.shape, dtype=bool)
    valid[5:9, 6:12] = False
    image = np.where(valid, observation.image, 1e9)
    spoilt = Observation(image, observation.noise, observation.psf, SCALE, 25.0, valid=valid)
    rest = _model(spoilt, exact=False).amplitudes(values)[1].reshape(observation.shape)
    assert not rest[~valid].any()
    assert np.abs(rest).max() < 100.0


def test_light_from_beyond_the_image_is_brought_in_by_the_psf(observation: Observation) -> None:
    model = _model(observation, exact=True)
    wide = SersicProfile(1.0, 50.0, 0.5, 1.0, 0.0, 0.0, 0.0)
    image = model._light(wide, None)[0].reshape(observation.shape) / model.weight.reshape(observation.shape)
    # A profile so wide is flat; without the pixels outside, a corner would see a quarter of it.
    assert image[0, 0] == pytest.approx(image[20, 21], rel=1e-2)
    assert ndimage.standard_deviation(image) < 1e-2 * image.mean()
