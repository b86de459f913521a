import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from scipy import sparse

from engine.catalogue import load_camera, load_dither
from engine.errors import ObservationError
from engine.imaging.fits import read_image, read_observation, write_observation
from engine.imaging.observation import Observation, observation_from_arrays

PAIRED = [f"sim_lens_{kind}_ID{number}" for kind in ("AGN", "transient") for number in (1, 4, 10, 27)]


@pytest.fixture
def observation():
    rng = np.random.default_rng(1)
    band = sparse.diags([np.full(19, 0.1), np.full(20, 1 / 3), np.full(19, 0.1)], [-1, 0, 1])
    valid = np.ones((4, 5), dtype=bool)
    valid[2, 3] = False
    noise = rng.uniform(1, 2, (4, 5))
    noise[2, 3] = np.inf
    return Observation(
        rng.standard_normal((4, 5)),
        noise,
        rng.random((7, 7)),
        0.13 / 6,
        25.9463,
        covariance=band,
        valid=valid,
        provenance={
            "system": "HE0435",
            "noise_level": "author",
            "a long name with spaces": "text " * 60 + "end ",
            "seed": 2**62 + 1,
            "third": 1 / 3,
            "tiny": -1.2345678901234567e-130,
            "text that looks like a number": "1.0",
            "not ASCII": "Sérsic",
        },
    )


def test_an_observation_is_written_and_read_back_without_loss(observation, tmp_path):
    path = tmp_path / "observation.fits"
    write_observation(path, observation)
    again = read_observation(path)
    for name in ("image", "noise", "psf", "valid"):
        np.testing.assert_array_equal(getattr(again, name), getattr(observation, name))
    assert (again.pixel_scale, again.zero_point) == (observation.pixel_scale, observation.zero_point)
    assert dict(again.provenance) == dict(observation.provenance)
    assert [type(value) for value in again.provenance.values()] == [
        type(value) for value in observation.provenance.values()
    ]
    assert abs(again.covariance - observation.covariance).max() == 0
    with pytest.raises(OSError, match="exist"):
        write_observation(path, observation)


def test_the_file_is_good_fits_without_covariance_too(observation, tmp_path):
    plain = Observation(
        observation.image,
        observation.noise,
        observation.psf,
        0.08,
        25.0,
        valid=observation.valid,
    )
    path = tmp_path / "plain.fits"
    write_observation(path, plain)
    assert read_observation(path).covariance is None
    with fits.open(path, checksum=True) as hdus:
        hdus.verify("exception")


def test_celestial_coordinates_have_north_up_and_east_left(observation, tmp_path):
    path = tmp_path / "sky.fits"
    write_observation(path, observation, centre=(69.5619, -12.2875))
    with fits.open(path) as hdus:
        world = WCS(hdus["IMAGE"].header)
    centre = world.pixel_to_world(2.0, 1.5)  # the middle of 5 x 4 pixels
    assert (centre.ra.deg, centre.dec.deg) == pytest.approx((69.5619, -12.2875), abs=1e-12)
    east, north = centre.spherical_offsets_to(world.pixel_to_world(3.0, 1.5))
    assert (east.arcsec, north.arcsec) == pytest.approx((-observation.pixel_scale, 0), abs=1e-8)
    east, north = centre.spherical_offsets_to(world.pixel_to_world(2.0, 2.5))
    assert (east.arcsec, north.arcsec) == pytest.approx((0, observation.pixel_scale), abs=1e-8)


def test_linear_coordinates_are_arcsec_from_the_centre(observation, tmp_path):
    path = tmp_path / "linear.fits"
    write_observation(path, observation)
    with fits.open(path) as hdus:
        header = hdus["NOISE"].header
        world = WCS(header)
    assert [str(unit) for unit in world.wcs.cunit] == ["arcsec", "arcsec"]
    np.testing.assert_allclose(
        world.wcs_pix2world([[2.0, 1.5], [3.0, 2.5]], 0), [[0, 0], [observation.pixel_scale] * 2], atol=1e-14
    )


def test_files_that_are_not_observations_are_refused(tmp_path):
    text = tmp_path / "text.fits"
    text.write_text("not fits")
    empty = tmp_path / "empty.fits"
    fits.PrimaryHDU().writeto(empty)
    for path in (text, empty):
        with pytest.raises(ObservationError, match="not an observation"):
            read_observation(path)
    with pytest.raises(ObservationError, match="no two-dimensional image"):
        read_image(empty)
    with pytest.raises(FileNotFoundError):
        read_observation(tmp_path / "absent.fits")


@pytest.mark.parametrize("name", PAIRED)
def test_the_paired_lenses_can_be_read(shared_data, name, tmp_path):
    folder = shared_data / "paired_lens" / name
    arrays = [read_image(folder / f"{part}.fits") for part in ("Drz_QSO_image", "noise_map", "Drz_PSF")]
    observation = observation_from_arrays(*arrays, 0.08, 25.9463, recentre_psf=True)
    assert observation.shape == (99, 99)
    assert observation.valid.all()
    # The peak stood at (38, 38) of 81 x 81; four rows and columns of zeros put it into the middle.
    assert observation.psf.shape == (85, 85)
    assert observation.psf[42, 42] == observation.psf.max()
    assert observation.provenance["psf_peak_was_at_row"] == 38
    write_observation(tmp_path / "copy.fits", observation)
    np.testing.assert_array_equal(read_observation(tmp_path / "copy.fits").image, observation.image)


def test_the_real_image_of_rxj1131_can_be_read(shared_data):
    folder = shared_data / "rxj1131"
    image, psf = (read_image(folder / f"rxj1131_{part}.fits") for part in ("cutout", "psf1"))
    # No noise map comes with it: photon noise of the counts themselves, which leaves out pixels without any.
    noise = np.sqrt(np.clip(image, 0, None))
    observation = observation_from_arrays(image, noise, psf, 0.04, 25.957, normalise_psf=True)
    assert observation.shape == (175, 175)
    assert observation.valid.mean() > 0.9
    assert observation.psf.sum() == pytest.approx(1, abs=1e-12)


def test_the_exposures_behind_an_observation_are_kept(tmp_path):
    from engine.imaging.geometry import exposure_geometry
    from engine.imaging.response import PointResponse

    geometry = exposure_geometry(load_camera("WFC3-IR_F160W"), load_dither("eight_point_quarter_pixel"), (12, 12))
    grid = np.arange(21) - 10
    psf = np.exp(-0.5 * np.add.outer(grid**2, grid**2) / 2.5**2)
    kernel = np.array([[0.0, 0.02, 0.0], [0.02, 0.92, 0.02], [0.0, 0.02, 0.0]])
    image = np.ones((12, 12))
    whole = Observation(image, image, np.ones((3, 3)), 0.08, 25.9, response=PointResponse(psf, geometry, kernel))
    write_observation(tmp_path / "o.fits", whole)
    again = read_observation(tmp_path / "o.fits")
    assert again.response.geometry == geometry
    np.testing.assert_array_equal(again.point_source(0.03, -0.11), whole.point_source(0.03, -0.11))
