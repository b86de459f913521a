"""Observations that somebody else made: masks, PSFs, missing noise maps, and the examples beside the project."""

import numpy as np
import pytest
from astropy.io import fits
from scipy import fft

from engine import Host, Realization, read_external_observation, simulate_realization
from engine.errors import ObservationError
from engine.imaging.external import observation_from_arrays
from engine.imaging.fits import read_observation, write_observation
from engine.imaging.noise_from_image import NoiseFromImage, noise_from_image
from engine.imaging.observation import Observation
from engine.imaging.psf_centre import recentred_psf

PAIRED = [f"sim_lens_{kind}_ID{number}" for kind in ("AGN", "transient") for number in (1, 4, 10, 27)]


def parts(**changes):
    psf = np.zeros((5, 5))
    psf[2, 2] = 1.0
    return {
        "image": np.arange(12.0).reshape(3, 4),
        "noise": np.ones((3, 4)),
        "psf": psf,
        "pixel_scale": 0.08,
        "zero_point": 25.9463,
    } | changes


def holed(value):
    noise = np.ones((3, 4))
    noise[1, 2] = value
    return noise


def gaussian(shape, row, column, sigma=2.0):
    y, x = np.arange(shape[0]) - row, np.arange(shape[1]) - column
    return np.exp(-0.5 * np.add.outer(y**2, x**2) / sigma**2)


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        (0.0, "noise_not_positive"),
        (-1.0, "noise_not_positive"),
        (np.nan, "noise_not_finite"),
        (np.inf, "noise_not_finite"),
    ],
)
def test_unusable_noise_makes_pixels_invalid_and_is_counted_by_reason(value, reason):
    observation = observation_from_arrays(**parts(noise=holed(value)))
    assert not observation.valid[1, 2]
    assert observation.valid.sum() == 11
    assert observation.noise[1, 2] == np.inf
    assert observation.provenance["unusable_pixels"] == observation.provenance[f"{reason}_pixels"] == 1


def test_a_pixel_that_is_unusable_twice_is_one_unusable_pixel():
    image = np.ones((3, 4))
    image[1, 2] = np.nan
    observation = observation_from_arrays(**parts(image=image, noise=holed(0.0)))
    record = observation.provenance
    assert (record["image_not_finite_pixels"], record["noise_not_positive_pixels"], record["unusable_pixels"]) == (
        1,
        1,
        1,
    )
    assert observation.image[1, 2] == 0.0


def test_foreign_mask_and_shapes_are_checked():
    valid = np.ones((3, 4), dtype=bool)
    valid[0] = False
    assert observation_from_arrays(**parts(noise=holed(0.0)), valid=valid).valid.sum() == 7
    with pytest.raises(ObservationError, match="valid"):
        observation_from_arrays(**parts(), valid=valid[:2])
    with pytest.raises(ObservationError, match="noise: got shape"):
        observation_from_arrays(**parts(noise=np.ones((4, 4))))
    with pytest.raises(ObservationError, match="no pixel"):
        observation_from_arrays(**parts(noise=np.zeros((3, 4))))
    with pytest.raises(ObservationError, match="psf"):
        observation_from_arrays(**parts(psf=np.full((3, 3), np.nan)), recentre_psf="pixel")


def test_a_psf_is_changed_on_request_alone_and_says_so():
    psf = np.full((8, 6), 0.1)
    psf[3, 4] = 2.0
    with pytest.raises(ObservationError, match="odd square"):
        observation_from_arrays(**parts(psf=psf))
    observation = observation_from_arrays(**parts(psf=psf), recentre_psf="pixel")
    assert observation.psf.shape == (9, 9)
    assert observation.psf[4, 4] == 2.0
    assert observation.psf.sum() == pytest.approx(psf.sum())
    record = observation.provenance
    assert (record["psf_centre"], record["psf_centre_was_at_row"], record["psf_centre_was_at_column"]) == (
        "pixel",
        3,
        4,
    )
    observation = observation_from_arrays(**parts(psf=psf), recentre_psf="pixel", normalise_psf=True)
    assert observation.psf.sum() == pytest.approx(1, abs=1e-15)
    assert observation.provenance["psf_divided_by"] == pytest.approx(psf.sum())


@pytest.mark.parametrize("about", ["peak", "centroid"])
@pytest.mark.parametrize("shape", [(41, 41), (40, 40), (40, 44), (45, 40)])
@pytest.mark.parametrize(("dy", "dx"), [(0.0, 0.0), (0.37, -0.21), (-0.5, 0.5), (1.3, -2.6)])
def test_a_psf_anywhere_in_a_stamp_of_any_shape_comes_to_the_middle_of_an_odd_square(about, shape, dy, dx):
    # A Gaussian of 2 pixels is band-limited to 1e-8 of its peak, so that the shift is exact to that.
    row, column = (shape[0] - 1) / 2 + dy, (shape[1] - 1) / 2 + dx
    psf = gaussian(shape, row, column)
    moved, found = recentred_psf(psf, about)
    assert found == pytest.approx((row, column), abs=1e-6)
    assert moved.shape[0] == moved.shape[1]
    assert moved.shape[0] % 2 == 1
    half = moved.shape[0] // 2
    # Light is neither lost nor made; the stamp's edge, 1e-12 of the peak and more, is all that rings.
    assert moved.sum() == pytest.approx(psf.sum(), rel=1e-12)
    np.testing.assert_allclose(moved, gaussian(moved.shape, half, half), atol=2e-6)


def test_peak_and_centroid_differ_for_a_lopsided_psf_and_both_do_what_they_say():
    psf = gaussian((41, 41), 20.0, 20.0) + 0.2 * gaussian((41, 41), 20.0, 24.0, 3.0)
    by_peak, at_peak = recentred_psf(psf, "peak")
    by_light, at_light = recentred_psf(psf, "centroid")
    assert 20.0 < at_peak[1] < at_light[1]
    for moved, about in ((by_peak, "peak"), (by_light, "centroid")):
        middle = moved.shape[0] // 2
        assert recentred_psf(moved, about)[1] == pytest.approx((middle, middle), abs=1e-6)


def test_a_psf_without_a_smooth_peak_is_refused_for_a_peak_and_taken_by_pixel():
    impulse = np.zeros((9, 9))
    impulse[3, 3] = 1.0
    assert recentred_psf(impulse, "pixel")[1] == (3, 3)
    with pytest.raises(ObservationError, match="recentre it by"):
        recentred_psf(np.zeros((9, 9)), "peak")
    with pytest.raises(ObservationError, match="got the sum"):
        recentred_psf(np.zeros((9, 9)), "centroid")
    with pytest.raises(ObservationError, match="not finite"):
        recentred_psf(np.full((3, 3), np.inf), "centroid")


@pytest.mark.parametrize("system", ["HE0435", "HS2209", pytest.param("RXJ1131", marks=pytest.mark.long)])
def test_a_noise_map_made_from_an_image_agrees_with_the_one_that_the_simulation_knows(system):
    # Handbook noise is sky, dark, read noise and Poisson, as the map assumes. The sky of a full cutout is known to
    # 15 % (the wings of the deflector are in it); in the arc, Poisson noise counts and the drizzle's correlation
    # lowers the variance of a pixel by a known factor, which the map does not know: up to 1.6.
    host = Host(n=2.0, r_eff=0.4, magnitude=20.5)
    spec = Realization(system=system, l_eta=1.0, host=host, noise_level="handbook")
    simulation = simulate_realization(spec)
    observation, plan = simulation.observation, simulation.scene.system.exposures
    exposure_s = simulation.exposures.geometry.n_dither * plan.n_long * plan.long_s
    estimate = noise_from_image(np.array(observation.image), NoiseFromImage(exposure_s=exposure_s))
    sky = float(np.percentile(observation.noise, 10))
    assert estimate.sky_rms == pytest.approx(sky, rel=0.15)
    arc = simulation.arc > 0.3 * simulation.arc.max()
    ratio = np.median(estimate.sigma[arc] / observation.noise[arc])
    assert 0.9 < ratio < 1.6


def test_the_pieces_of_a_noise_map_are_what_they_say():
    rng = np.random.default_rng(5)
    image = 0.3 + 0.02 * rng.standard_normal((80, 80))
    image[40:43, 40:43] += 50.0
    image[0, :5] = 0.0
    image[1, 1] = np.nan
    estimate = noise_from_image(image, NoiseFromImage(exposure_s=500.0, gain=2.0, saturation=40.0))
    # 1,600 of the 6,400 pixels measure the sky: 1.8 % on its rms; the median of 121 takes 1/121 of the variance.
    assert estimate.sky_rms == pytest.approx(0.02, rel=0.05)
    assert estimate.sky == pytest.approx(0.3, abs=0.005)
    assert estimate.saturated.sum() == 25  # nine pixels and their neighbours
    assert estimate.sigma[41, 41] == pytest.approx(np.sqrt(0.02**2 + 50.0 / 1000.0), rel=0.01)
    known = noise_from_image(image, NoiseFromImage(exposure_s=500.0, sky_rms=0.07))
    assert known.sky_rms == 0.07
    with pytest.raises(ObservationError, match="pixels with data"):
        noise_from_image(np.zeros((50, 50)), NoiseFromImage(exposure_s=1.0))
    with pytest.raises(ObservationError, match="rms"):
        noise_from_image(np.ones((50, 50)), NoiseFromImage(exposure_s=1.0))


@pytest.fixture
def files(tmp_path):
    """An image of 60 x 60 with coordinates and exposure time, a noise map, a PSF of even side, a mask."""
    rng = np.random.default_rng(2)
    header = fits.Header()
    for axis, name, value, step in ((1, "RA---TAN", 150.0, -0.05), (2, "DEC--TAN", 2.0, 0.05)):
        header[f"CTYPE{axis}"], header[f"CRVAL{axis}"] = name, value
        header[f"CRPIX{axis}"], header[f"CDELT{axis}"] = 30.5, step / 3600
    header["EXPTIME"] = 1000.0
    noise = np.full((60, 60), 20.0)
    noise[3, 3], noise[4, 4] = 0.0, np.nan
    mask = np.ones((60, 60))
    mask[:5] = 0
    arrays = {
        "image": 1000.0 + 20.0 * rng.standard_normal((60, 60)),
        "noise": noise,
        "psf": 7.0 * gaussian((24, 24), 11.3, 12.1, 1.8),
        "mask": mask,
    }
    for name, values in arrays.items():
        fits.PrimaryHDU(values.astype(np.float32), header if name == "image" else None).writeto(
            tmp_path / f"{name}.fits"
        )
    return tmp_path


def read(folder, **options):
    paths = {"image": folder / "image.fits", "psf": folder / "psf.fits"}
    return read_external_observation(**paths, **({"zero_point": 25.0, "recentre_psf": "peak"} | options))


def test_foreign_files_make_the_same_object_as_our_own_and_are_written_and_read_like_it(files):
    observation = read(files, noise=files / "noise.fits", mask=files / "mask.fits", unit="e-", normalise_psf=True)
    assert isinstance(observation, Observation)
    assert observation.pixel_scale == pytest.approx(0.05, rel=1e-9)
    assert observation.centre == pytest.approx((150.0, 2.0), abs=1e-9)
    assert observation.image.mean() == pytest.approx(1.0, rel=1e-3)
    assert observation.noise[30, 30] == pytest.approx(0.02)
    assert observation.valid.sum() == 55 * 60
    assert observation.psf.sum() == pytest.approx(1.0, abs=1e-12)
    assert observation.psf.argmax() == observation.psf.size // 2
    record = observation.provenance
    assert (record["noise_not_positive_pixels"], record["noise_not_finite_pixels"]) == (1, 1)
    assert (record["image_file"], record["unit"], record["exposure_s"]) == ("image.fits", "e-", 1000.0)
    write_observation(files / "copy.fits", observation)
    again = read_observation(files / "copy.fits")
    np.testing.assert_array_equal(again.image, observation.image)
    assert dict(again.provenance) == dict(record)


def test_without_a_noise_map_one_is_made_and_the_provenance_says_how(files):
    observation = read(files, unit="e-", saturation_e_s=1.05)
    record = observation.provenance
    assert record["noise_sky_rms"] == pytest.approx(0.02, rel=0.05)
    assert record["noise_exposure_s"] == 1000.0
    assert record["saturated_pixels"] == np.count_nonzero(~observation.valid) > 0


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"noise": "psf.fits"}, "psf.fits: noise: got shape"),
        ({"mask": "psf.fits"}, "psf.fits: valid: got shape"),
        ({"recentre_psf": None}, "psf.fits: psf: got shape"),
        ({"psf": "text.fits"}, "text.fits: not a FITS file"),
        ({"psf": "table.fits"}, "table.fits: holds no two-dimensional image"),
        ({"image": "psf.fits", "pixel_scale": 0.05}, r"psf.fits\[0\]: has no EXPTIME"),
        ({"image": "psf.fits", "exposure_s": 10.0}, r"psf.fits\[0\]: has no celestial coordinates"),
        ({"exposure_s": -1.0}, "exposure_s: got -1.0"),
        ({"gain": 0.0}, "gain"),
        ({"pixel_scale": -0.1}, "pixel_scale"),
    ],
)
def test_foreign_files_that_do_not_fit_are_refused_by_name(files, options, told):
    (files / "text.fits").write_text("not fits")
    fits.HDUList([fits.PrimaryHDU()]).writeto(files / "table.fits")
    paths = {name: files / f"{name}.fits" for name in ("image", "psf")}
    given = {key: files / value if str(value).endswith(".fits") else value for key, value in options.items()}
    with pytest.raises(ObservationError, match=told):
        read_external_observation(**(paths | {"zero_point": 25.0, "recentre_psf": "peak"} | given))


def test_a_file_that_is_not_there_is_told_as_such(files):
    with pytest.raises(FileNotFoundError):
        read_external_observation(files / "absent.fits", files / "psf.fits", zero_point=25.0)


@pytest.mark.parametrize("name", PAIRED)
def test_the_paired_lenses_can_be_read(shared_data, name, tmp_path):
    folder = shared_data / "paired_lens" / name
    observation = read_external_observation(
        folder / "Drz_QSO_image.fits", folder / "Drz_PSF.fits", noise=folder / "noise_map.fits",
        pixel_scale=0.08, zero_point=25.9463, recentre_psf="pixel",
    )  # fmt: skip
    assert observation.shape == (99, 99)
    assert observation.valid.all()
    # The peak stood at (38, 38) of 81 x 81; four rows and columns of zeros put it into the middle.
    assert observation.psf.shape == (85, 85)
    assert observation.psf[42, 42] == observation.psf.max()
    assert observation.provenance["psf_centre_was_at_row"] == observation.provenance["psf_centre_was_at_column"] == 38
    # The light of the core is centred within 0.13 pixels of that.
    psf = fits.getdata(folder / "Drz_PSF.fits").astype(np.float64)
    for about in ("peak", "centroid"):
        moved, (row, column) = recentred_psf(psf, about)
        assert max(abs(row - 38), abs(column - 38)) < 0.15
        assert moved.sum() == pytest.approx(psf.sum(), rel=1e-12)
    write_observation(tmp_path / "copy.fits", observation)
    np.testing.assert_array_equal(read_observation(tmp_path / "copy.fits").image, observation.image)
    # Their own noise map is within 40 % of what the image tells: their kernel correlates pixels more than ours.
    made = noise_from_image(np.array(observation.image), NoiseFromImage(exposure_s=9600.0))
    assert made.sky_rms == pytest.approx(float(np.percentile(observation.noise, 10)), rel=0.4)


def test_the_real_image_of_rxj1131_can_be_read_and_gets_a_noise_map(shared_data):
    folder = shared_data / "rxj1131"
    observation = read_external_observation(
        folder / "rxj1131_cutout.fits", folder / "rxj1131_psf1.fits",
        zero_point=25.957, unit="e-", saturation_e_s=80.0, recentre_psf="centroid", normalise_psf=True,
    )  # fmt: skip
    assert observation.shape == (175, 175)
    assert observation.pixel_scale == pytest.approx(0.04, rel=1e-6)
    # Table 1 gives 11:31:51.6 -12:31:57, to a second of time.
    assert observation.centre == pytest.approx((172.965, -12.5325), abs=15 / 3600)
    record = observation.provenance
    assert record["exposure_s"] == 1980.0
    # Read noise and sky of four exposures of 495 s come to 0.005-0.008 e/s in a pixel of 0.04 arcsec.
    assert 0.003 < record["noise_sky_rms"] < 0.01
    # Images A and B are saturated, C and D are not: 30 pixels 1.19 arcsec apart, a bright core each.
    assert 20 < record["saturated_pixels"] < 80
    rows, columns = np.nonzero(~observation.valid)
    assert np.ptp(rows) * 0.04 == pytest.approx(1.19, abs=0.4)
    assert np.ptp(columns) * 0.04 < 0.5
    assert observation.psf.sum() == pytest.approx(1, abs=1e-12)


def test_the_shift_is_a_phase_in_fourier_space():
    # Against the definition, on an odd stamp: every frequency turns by its phase and keeps its modulus.
    psf = gaussian((31, 31), 15.2, 14.9)
    moved, _ = recentred_psf(psf, "peak")
    np.testing.assert_allclose(np.abs(fft.fft2(moved)), np.abs(fft.fft2(psf)), atol=1e-9 * psf.sum())
