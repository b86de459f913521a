import numpy as np
import pytest
from scipy.special import ndtr

from engine.errors import ObservationError, SpecError
from engine.imaging.convolution import convolve, point_source_image
from engine.imaging.exposures import expose
from engine.imaging.geometry import Geometry, resized


def centroid(image, x, y):
    return (image * x).sum() / image.sum(), (image * y[:, None]).sum() / image.sum()


def test_grids_are_centred_on_the_target(setup):
    geometry = setup.geometry
    for x, y in (geometry.high_resolution_axes(), geometry.drizzled_axes()):
        assert x[0] == pytest.approx(-x[-1], abs=1e-12)
        assert y[0] == pytest.approx(-y[-1], abs=1e-12)
    first_x, first_y = geometry.native_axes(0)
    for index, (shift_x, shift_y) in enumerate(geometry.shifts):
        x, y = geometry.native_axes(index)
        step = geometry.pixel_scale / geometry.subpixels
        np.testing.assert_allclose(x - first_x, (shift_x - geometry.shifts[0][0]) * step, atol=1e-12)
        np.testing.assert_allclose(y - first_y, (shift_y - geometry.shifts[0][1]) * step, atol=1e-12)


def test_every_drizzled_pixel_lies_inside_every_exposure(setup):
    geometry = setup.geometry
    for index in range(geometry.n_dither):
        for native, drizzled in zip(geometry.native_axes(index), geometry.drizzled_axes(), strict=True):
            assert native[0] <= drizzled[0] - geometry.drizzled_scale / 2
            assert native[-1] >= drizzled[-1] + geometry.drizzled_scale / 2


def test_oversampling_that_the_dither_cannot_use_is_refused(f160w):
    with pytest.raises(SpecError, match="oversampling"):
        Geometry(0.13, (60, 60), 4, 6, ((0, 0),), (98, 98), 0.08)


def test_point_source_has_its_flux_and_place(setup):
    geometry, rng = setup.geometry, np.random.default_rng(1)
    x, y = geometry.high_resolution_axes()
    own = centroid(setup.psf, *([(np.arange(len(setup.psf)) - len(setup.psf) // 2) * geometry.subpixel_scale] * 2))
    for position in rng.uniform(-0.2, 0.2, (5, 2)):
        image = point_source_image(position, 3.0, setup.psf, geometry)
        assert image.sum() == pytest.approx(3.0 * setup.psf.sum(), rel=1e-12)  # asked: 1e-6
        # The cut of the stamp moves its centroid a little; asked: a hundredth of a drizzled pixel.
        assert centroid(image, x, y) == pytest.approx(position + own, abs=1e-4 * geometry.drizzled_scale)


def test_point_source_is_the_psf_integrated_over_the_subpixels(f160w):
    # Against the sum over 9 x 9 points to the sub-pixel of a PSF computed that finely.
    from engine.imaging.psf import telescope_psf

    geometry = f160w.geometry
    args = {"field_of_view": 4.0, "pupil_pixels": 256}
    coarse = telescope_psf(f160w.camera, oversampling=4, **args)
    fine = telescope_psf(f160w.camera, oversampling=36, **args)
    image = point_source_image([[0.0, 0.0]], [1.0], coarse, geometry)
    ny, nx = image.shape
    assert ny % 2 == 1
    assert nx % 2 == 1
    middle, half = len(fine) // 2, 4
    blocks = fine[middle - 4 - 9 * half : middle + 5 + 9 * half, middle - 4 - 9 * half : middle + 5 + 9 * half]
    expected = blocks.reshape(2 * half + 1, 9, 2 * half + 1, 9).sum(axis=(1, 3))
    got = image[ny // 2 - half : ny // 2 + half + 1, nx // 2 - half : nx // 2 + half + 1]
    # The midpoint rule on 9 points a side is wrong by a^2 / (12 sigma^2 81) = 4e-4 of the peak, for
    # sub-pixels of a = 0.0325 arcsec and a core of sigma = 0.054.
    np.testing.assert_allclose(got, expected, atol=4e-4 * expected.max())


def test_point_source_beyond_the_grid_leaves_no_light_at_the_other_side(f160w):
    geometry = f160w.geometry
    x, _ = geometry.high_resolution_axes()
    image = point_source_image([[x[-1] + 0.3, 0.0]], [1.0], f160w.psf, geometry)
    assert image[:, : len(x) // 4].max() == 0
    assert not point_source_image([[99.0, 0.0]], [1.0], f160w.psf, geometry).any()
    assert not point_source_image(np.empty((0, 2)), np.empty(0), f160w.psf, geometry).any()


def test_convolution_equals_the_direct_sum_and_does_not_wrap(f160w):
    rng = np.random.default_rng(2)
    image, psf = rng.random((17, 12)), rng.random((9, 9))
    expected = np.zeros((17 + 8, 12 + 8))
    for (row, column), value in np.ndenumerate(image):
        expected[row : row + 9, column : column + 9] += value * psf
    np.testing.assert_allclose(convolve(image, psf), expected[4:-4, 4:-4], rtol=1e-12)
    # A stamp that is larger than the image.
    big = rng.random((41, 41))
    expected = np.array(
        [
            [sum(image[j, i] * big[20 + y - j, 20 + x - i] for j in range(17) for i in range(12)) for x in range(12)]
            for y in range(17)
        ]
    )
    np.testing.assert_allclose(convolve(image, big), expected, rtol=1e-12)


def test_extended_light_and_a_swarm_of_stars_give_the_same_exposures(f160w):
    # Pixel-integrated light convolved with the point-sampled PSF against stars, which are integrated when
    # placed.
    geometry, sigma = f160w.geometry, 0.05
    x, y = geometry.high_resolution_axes()
    half = geometry.subpixel_scale / 2
    along = [np.diff(ndtr(np.append(axis - half, axis[-1] + half) / sigma)) for axis in (x, y)]
    blurred = convolve(along[1][:, None] * along[0], f160w.psf)
    points = np.arange(-5, 5.1, 0.5) * sigma
    weights = np.exp(-(points**2) / (2 * sigma**2))
    positions = np.stack(np.meshgrid(points, points), axis=-1).reshape(-1, 2)
    fluxes = np.outer(weights, weights).ravel() / weights.sum() ** 2
    stars = point_source_image(positions, fluxes, f160w.psf, geometry)
    extended, swarm = (expose(light, geometry, f160w.kernel) for light in (blurred, stars))
    np.testing.assert_allclose(extended, swarm, rtol=0, atol=1e-5 * swarm.max())


def test_exposures_conserve_flux_and_are_centred(setup):
    geometry = setup.geometry
    own = centroid(setup.psf, *([(np.arange(len(setup.psf)) - len(setup.psf) // 2) * geometry.subpixel_scale] * 2))
    position = np.array([0.111, -0.067])
    exposures = expose(point_source_image(position, 1.0, setup.psf, geometry), geometry, setup.kernel)
    np.testing.assert_allclose(exposures.sum(axis=(1, 2)), setup.psf.sum(), rtol=1e-12)
    for index, exposure in enumerate(exposures):
        got = centroid(exposure, *geometry.native_axes(index))
        # Native pixels undersample the star, by most for F160W: its centroid is good to 2e-3 of a pixel.
        assert np.abs(np.array(got) - position - own).max() < 2e-3 * geometry.pixel_scale


def test_detector_kernel_is_applied_the_right_way_round(f160w):
    geometry = f160w.geometry
    kernel = np.zeros((3, 3))
    kernel[2, 1], kernel[1, 1] = 0.25, 0.75  # a quarter of the light moves one row up
    image = np.zeros(geometry.high_resolution_shape)
    image[150, 150] = 1.0
    plain = expose(image, geometry, np.pad([[1.0]], 1))
    moved = expose(image, geometry, kernel)
    np.testing.assert_allclose(moved, 0.75 * plain + 0.25 * np.roll(plain, 1, axis=1))


def test_wrong_shapes_are_refused(f160w):
    geometry = f160w.geometry
    with pytest.raises(ObservationError, match="high-resolution image"):
        expose(np.zeros((3, 3)), geometry, f160w.kernel)
    with pytest.raises(ObservationError, match="detector kernel"):
        expose(np.zeros(geometry.high_resolution_shape), geometry, np.ones((5, 5)))
    with pytest.raises(ObservationError, match="odd square"):
        convolve(np.zeros((5, 5)), np.ones((4, 4)))
    with pytest.raises(ObservationError, match="point sources"):
        point_source_image([[0.0, np.nan]], [1.0], f160w.psf, geometry)


def test_a_stamp_larger_than_the_image_changes_nothing_on_it(f160w):
    # Only the part of the stamp that can reach the grid is moved; the cut is where the PSF is 1e-5 of its
    # peak.
    from engine.imaging.psf import telescope_psf

    geometry = resized(f160w.geometry, (20, 20))
    psf = telescope_psf(f160w.camera, field_of_view=10.4, pupil_pixels=256)
    position, flux = [[0.31, -0.22]], [1.0]
    cut = point_source_image(position, flux, psf, geometry)
    whole = point_source_image(position, flux, psf, resized(f160w.geometry, (140, 140)))
    row, column = ((np.array(whole.shape) - np.array(cut.shape)) // 2).tolist()
    inner = whole[row : row + cut.shape[0], column : column + cut.shape[1]]
    np.testing.assert_allclose(cut, inner, rtol=0, atol=2e-7 * cut.max())
