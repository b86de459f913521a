import json
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from astropy import units
from astropy.io import fits
from astropy.wcs import WCS
from scipy import sparse

from engine.catalogue import load_camera, load_dither
from engine.errors import ObservationError
from engine.imaging.fits import read_observation, write_observation
from engine.imaging.observation import Observation


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
    write_observation(path, replace(observation, centre=(69.5619, -12.2875)))
    assert read_observation(path).centre == (69.5619, -12.2875)
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
    with pytest.raises(FileNotFoundError):
        read_observation(tmp_path / "absent.fits")


def test_the_exposures_behind_an_observation_are_kept(tmp_path):
    from engine.imaging.geometry import exposure_geometry
    from engine.imaging.optics.exposed import ExposedOptics

    geometry = exposure_geometry(load_camera("WFC3-IR_F160W"), load_dither("eight_point_quarter_pixel"), (12, 12))
    grid = np.arange(21) - 10
    psf = np.exp(-0.5 * np.add.outer(grid**2, grid**2) / 2.5**2)
    kernel = np.array([[0.0, 0.02, 0.0], [0.02, 0.92, 0.02], [0.0, 0.02, 0.0]])
    image = np.ones((12, 12))
    whole = Observation(image, image, np.ones((3, 3)), 0.08, 25.9, response=ExposedOptics(psf, geometry, kernel))
    write_observation(tmp_path / "o.fits", whole)
    again = read_observation(tmp_path / "o.fits")
    assert again.response.geometry == geometry
    np.testing.assert_array_equal(again.point_source(0.03, -0.11), whole.point_source(0.03, -0.11))


def identical(one, other):
    """Whether two observations agree in every bit."""
    for name in ("image", "noise", "psf", "valid"):
        a, b = getattr(one, name), getattr(other, name)
        assert a.dtype == b.dtype
        assert a.tobytes() == b.tobytes(), name
    assert (one.pixel_scale, one.zero_point, one.centre) == (other.pixel_scale, other.zero_point, other.centre)
    assert dict(one.provenance) == dict(other.provenance)
    assert [type(value) for value in one.provenance.values()] == [type(value) for value in other.provenance.values()]
    if one.covariance is None:
        assert other.covariance is None
    else:
        for part in ("data", "indices", "indptr"):
            assert getattr(one.covariance, part).tobytes() == getattr(other.covariance, part).tobytes(), part
    if one.response is None:
        assert other.response is None
    else:
        assert one.response.geometry == other.response.geometry
        assert one.response.psf.tobytes() == other.response.psf.tobytes()
        assert one.response.detector_kernel.tobytes() == other.response.detector_kernel.tobytes()
    return True


def test_a_simulated_observation_comes_back_bit_for_bit_and_so_does_its_copy(simulated, tmp_path):
    observation = simulated.observation
    write_observation(tmp_path / "one.fits", observation)
    again = read_observation(tmp_path / "one.fits")
    assert identical(observation, again)
    write_observation(tmp_path / "two.fits", again)
    assert identical(observation, read_observation(tmp_path / "two.fits"))
    # And the very file is the same, as long as nothing in it tells the time.
    assert (tmp_path / "one.fits").stat().st_size == (tmp_path / "two.fits").stat().st_size


@pytest.mark.parametrize("scale", [0.13 / 6, 1 / 3, 5e-324**0.01, 0.1 + 0.2])
def test_scales_and_centres_of_any_digits_come_back_bit_for_bit(observation, scale, tmp_path):
    odd = replace(observation, pixel_scale=scale, zero_point=25 + scale, centre=(scale * 100 % 360, -scale / 7))
    write_observation(tmp_path / "o.fits", odd)
    assert identical(odd, read_observation(tmp_path / "o.fits"))


def test_a_simulated_observation_is_good_fits(simulated, tmp_path):
    path = tmp_path / "o.fits"
    write_observation(path, simulated.observation)
    with fits.open(path, checksum=True) as hdus:
        hdus.verify("exception")
        assert [hdu.name for hdu in hdus[1:]] == ["IMAGE", "NOISE", "PSF", "VALID", "COVARIANCE", "EXPOSURES"]
    if shutil.which("fitsverify") is None:
        pytest.skip("fitsverify is not installed; astropy found nothing wrong")
    done = subprocess.run(["fitsverify", "-l", str(path)], capture_output=True, text=True, check=False)  # noqa: S607
    assert "0 warning(s) and 0 error(s)" in done.stdout, done.stdout


def test_the_header_says_where_an_observation_comes_from(simulated, tmp_path):
    from engine import engine_digest, engine_versions, realization_from_dict

    path = tmp_path / "o.fits"
    write_observation(path, simulated.observation)
    header = fits.getheader(path)
    expected = {
        "SYSTEM": "HE0435", "CAMERA": "WFC3-IR_F160W", "NOISE": "author", "NOISEREQ": "author",
        "DITHER": "eight_point_quarter_pixel", "N_DITHER": 8, "N_LONG": 2, "LONG_S": 599.0, "SHORT_S": 43.98,
        "KERNEL": "square", "PIXFRAC": 0.7, "SEED": 3, "L_ETA": 1.0, "MASSMOD": "recommended",
        "HOST_MAG": 21.0, "HOST_RE": 0.39, "HOST_N": 2.0, "HOST_Q": 0.7, "HOST_PA": 135.0, "ENGDIG": engine_digest(),
    }  # fmt: skip
    assert {key: header[key] for key in expected} == expected
    assert header["EXPTIME"] == pytest.approx(9940, rel=1e-3)  # Table 1
    assert json.loads(simulated.observation.provenance["VERSIONS"]) == engine_versions()
    # The whole specification is there: it can be simulated again from the file alone.
    spec = realization_from_dict(json.loads(read_observation(path).provenance["SPEC"]))
    assert spec.digest == header["SPECDIG"]


def test_an_agn_lies_where_its_right_ascension_and_declination_say(simulated, tmp_path):
    from astropy.coordinates import SkyCoord
    from astropy.wcs.utils import skycoord_to_pixel

    from engine.conventions import sky_to_image

    observation, scene = simulated.observation, simulated.scene
    path = tmp_path / "o.fits"
    write_observation(path, observation)
    with fits.open(path) as hdus:
        world = WCS(hdus["IMAGE"].header)
    target = SkyCoord(*scene.system.coordinates, unit="deg")
    ny, nx = observation.shape
    for source in scene.agn:
        east, north = sky_to_image((source.x, source.y))
        sky = target.spherical_offsets_by(east * units.arcsec, north * units.arcsec)
        column, row = skycoord_to_pixel(sky, world)
        # To the East is to the left.
        assert column == pytest.approx(-east / observation.pixel_scale + (nx - 1) / 2, abs=0.01)
        assert row == pytest.approx(north / observation.pixel_scale + (ny - 1) / 2, abs=0.01)
        # And there the light is: the brightest pixel is the one that the position falls into, or its neighbour.
        j, i = round(float(row)), round(float(column))
        window = observation.image[j - 3 : j + 4, i - 3 : i + 4]
        y, x = np.unravel_index(np.argmax(window), window.shape)
        assert max(abs(y - 3), abs(x - 3)) <= 1


def test_keywords_that_would_break_the_file_are_kept_out_of_its_cards_but_not_lost(observation, tmp_path):
    awkward = {"SIMPLE": "no", "NAXIS": 7, "END": "now", "HOSTLENS": 9, "PKEY0": "x", "LONG": "x" * 200, "NAN": np.nan}
    path = tmp_path / "o.fits"
    write_observation(path, replace(observation, provenance=awkward))
    again = read_observation(path).provenance
    assert {k: v for k, v in again.items() if k != "NAN"} == {k: v for k, v in awkward.items() if k != "NAN"}
    assert np.isnan(again["NAN"])
    with fits.open(path) as hdus:
        hdus.verify("exception")
        assert hdus[0].header["SIMPLE"] is True
