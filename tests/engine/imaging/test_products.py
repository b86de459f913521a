"""Files that telescopes deliver, and what people do to them: each is read rightly, or refused or warned of by name."""

import math
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.nddata import Cutout2D
from astropy.wcs import WCS

from engine import EngineError, ObservationError, SpecError, read_external_observation, write_observation
from engine.imaging.fits import read_observation
from engine.imaging.observation import Observation
from engine.imaging.readings import Reading, readings
from engine.plausibility import unlikely

SIDE, SCALE, EXPOSURE = 60, 0.05, 2000.0
PHOTFLAM, PHOTPLAM = 7.0e-20, 8045.0
# -2.5 log10(PHOTFLAM) - 5 log10(PHOTPLAM) - 2.408, as in the HST data handbooks.
ZERO_POINT = -2.5 * math.log10(PHOTFLAM) - 5.0 * math.log10(PHOTPLAM) - 2.408


def world(turn: float = 0.0, mirrored: bool = False, scale: float = SCALE, side: int = SIDE) -> fits.Header:
    """A tangential projection whose North is ``turn`` degrees counter-clockwise of up."""
    t, east = math.radians(turn), 1.0 if mirrored else -1.0
    header = fits.Header()
    for axis, (name, value) in enumerate((("RA---TAN", 150.0), ("DEC--TAN", 2.0)), start=1):
        header[f"CTYPE{axis}"], header[f"CRVAL{axis}"], header[f"CRPIX{axis}"] = name, value, (side + 1) / 2
    # Rows: what one pixel along the columns and the rows is to the East, and to the North.
    east_row = (east * math.cos(t), east * math.sin(t))
    north_row = (-math.sin(t), math.cos(t))
    for row, steps in ((1, east_row), (2, north_row)):
        for column, step in ((1, steps[0]), (2, steps[1])):
            header[f"CD{row}_{column}"] = step * scale / 3600
    return header


def gaussian(shape: tuple[int, int], row: float, column: float, sigma: float) -> np.ndarray:
    y, x = np.arange(shape[0]) - row, np.arange(shape[1]) - column
    return np.exp(-0.5 * np.add.outer(y**2, x**2) / sigma**2)


def sky(side: int = SIDE) -> np.ndarray:
    """A blob on noise of 0.01 e-/s."""
    rng = np.random.default_rng(3)
    return 0.01 * rng.standard_normal((side, side)) + 2.0 * gaussian((side, side), side / 2, side / 2, 3.0)


class Files:
    """A product of HST in a folder, with what a test changes of it."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.primary, self.science = folder, fits.Header(), world()
        self.primary["TELESCOP"], self.primary["EXPTIME"] = "HST", EXPOSURE
        self.science["BUNIT"] = "ELECTRONS/S"
        self.science["PHOTFLAM"], self.science["PHOTPLAM"], self.science["PHOTZPT"] = PHOTFLAM, PHOTPLAM, -21.1
        self.image = sky()
        self.planes: dict[str, np.ndarray] = {}
        self.before: dict[str, np.ndarray] = {}
        self.psf = gaussian((41, 41), 20, 20, 1.3)
        self.psf_header: fits.Header | None = None

    def write(self) -> Path:
        hdus = [fits.PrimaryHDU(header=self.primary)]
        hdus += [fits.ImageHDU(plane, name=name) for name, plane in self.before.items()]
        hdus.append(fits.ImageHDU(self.image.astype(np.float32), self.science, name="SCI"))
        hdus += [fits.ImageHDU(plane, name=name) for name, plane in self.planes.items()]
        fits.HDUList(hdus).writeto(self.folder / "drz.fits", overwrite=True)
        return self.folder / "drz.fits"

    def read(self, **options: object) -> Observation:
        psf = self.folder / "psf.fits"
        fits.writeto(psf, self.psf.astype(np.float32), self.psf_header, overwrite=True)
        options = {"recentre_psf": "pixel", "normalise_psf": True, "mend_psf": True} | options
        return read_external_observation(self.write(), options.pop("psf", psf), **options)  # type: ignore[arg-type]

    def save(self, name: str, values: np.ndarray, header: fits.Header | None = None) -> Path:
        fits.writeto(self.folder / name, values, header, overwrite=True)
        return self.folder / name


@pytest.fixture
def files(tmp_path: Path) -> Files:
    return Files(tmp_path)


def told(observation: Observation, name: str) -> Reading:
    (found,) = (reading for reading in readings(observation) if reading.name == name)
    return found


def noted(observation: Observation, text: str) -> bool:
    return any(text in note for note in observation.notes)


def test_a_drizzled_product_of_hst_is_read_as_it_is_and_says_where_everything_stood(files: Files) -> None:
    files.planes["WHT"] = np.full((SIDE, SIDE), EXPOSURE, dtype=np.float32)
    seen = files.read()
    # Calibrated in e-/s already, to the 32 bits of the file.
    np.testing.assert_allclose(seen.image, files.image, rtol=1e-6, atol=1e-8)
    assert seen.zero_point == pytest.approx(ZERO_POINT, abs=1e-3)
    assert seen.pixel_scale == pytest.approx(SCALE, rel=1e-6)
    assert seen.centre == pytest.approx((150.0, 2.0), abs=1e-7)
    assert (told(seen, "unit").value, told(seen, "unit").origin) == ("ELECTRONS/S", "BUNIT of drz.fits[SCI,1]")
    assert told(seen, "exposure_s").origin == "EXPTIME of drz.fits[0]"
    assert "PHOTFLAM of drz.fits[SCI,1]" in told(seen, "zero_point").origin
    assert "drz.fits[SCI,1]" in told(seen, "pixel_scale").origin
    assert told(seen, "image").origin == "drz.fits[SCI,1]"
    assert told(seen, "weight").origin == "drz.fits[WHT,1]"
    assert told(seen, "psf").value == "41 x 41 pixels"
    # What is read is kept in our own files as well.
    write_observation(files.folder / "own.fits", seen)
    assert readings(read_observation(files.folder / "own.fits")) == readings(seen)


@pytest.mark.parametrize(
    ("unit", "factor", "options"),
    [
        ("ELECTRONS", EXPOSURE, {}),
        ("electron", EXPOSURE, {}),
        ("electron / s", 1.0, {}),
        ("COUNTS/S", 1 / 1.5, {"gain": 1.5}),
        ("DN/s", 1 / 1.5, {"gain": 1.5}),
        ("DN", EXPOSURE / 1.5, {"gain": 1.5}),
        ("adu", EXPOSURE / 1.5, {"gain": 1.5}),
    ],
)
def test_the_unit_that_bunit_names_is_turned_into_electrons_a_second(
    files: Files, unit: str, factor: float, options: dict[str, float]
) -> None:
    true = files.image
    files.science["BUNIT"], files.image = unit, factor * true
    seen = files.read(**options)
    np.testing.assert_allclose(seen.image, true, rtol=2e-6, atol=1e-7)
    # PHOTFLAM is that of 1 count/s, which has as many electrons as the gain says.
    assert seen.zero_point == pytest.approx(ZERO_POINT + 2.5 * math.log10(options.get("gain", 1.0)), abs=1e-3)


def test_a_noise_map_has_its_own_unit(files: Files) -> None:
    header = fits.Header({"BUNIT": "ELECTRONS"})
    noise = files.save("noise.fits", np.full((SIDE, SIDE), 20.0), header)
    assert files.read(noise=noise).noise[0, 0] == pytest.approx(20.0 / EXPOSURE)
    files.science["BUNIT"] = "ELECTRONS"
    noise = files.save("noise.fits", np.full((SIDE, SIDE), 0.01), fits.Header({"BUNIT": "ELECTRONS/S"}))
    assert files.read(noise=noise).noise[0, 0] == pytest.approx(0.01)
    noise = files.save("noise.fits", np.full((SIDE, SIDE), 0.01), fits.Header({"BUNIT": "MJy/sr"}))
    with pytest.raises(ObservationError, match=r"noise\.fits\[0\]: noise: is in MJy/sr"):
        files.read(noise=noise)


@pytest.mark.parametrize(
    ("unit", "options", "complaint"),
    [
        ("K", {}, r"BUNIT of drz.fits\[SCI,1\]: got 'K'"),
        ("COUNTS/S", {}, "gain, electrons in a count, must be given"),
        ("ELECTRONS/S", {"unit": "e-"}, "--unit says e-, BUNIT of .* says 'ELECTRONS/S'"),
        ("ELECTRONS/S", {"gain": 2.0}, "gain: --gain says 2, but the image is in electrons already"),
    ],
)
def test_units_that_contradict_or_lack_something_are_refused_by_name(
    files: Files, unit: str, options: dict[str, object], complaint: str
) -> None:
    files.science["BUNIT"] = unit
    with pytest.raises(ObservationError, match=complaint):
        files.read(**options)


def test_an_option_that_is_trusted_overrules_the_file_and_says_so(files: Files) -> None:
    seen = files.read(unit="e-", trust_options=True)
    np.testing.assert_allclose(seen.image, files.image / EXPOSURE, rtol=2e-6, atol=1e-9)
    assert noted(seen, "--unit says e-")


def jwst(files: Files, photmjsr: float = 2.0) -> float:
    """Make a JWST product of the same image in MJy/sr; the AB magnitude of 1 DN/s."""
    area = (SCALE / 3600 * math.pi / 180) ** 2
    files.primary = fits.Header({"TELESCOP": "JWST", "EFFEXPTM": EXPOSURE})
    files.science = world()
    files.science["BUNIT"], files.science["PHOTMJSR"], files.science["PIXAR_SR"] = "MJy/sr", photmjsr, area
    files.science["XPOSURE"] = EXPOSURE
    files.image = photmjsr * files.image
    return -2.5 * math.log10(photmjsr * 1e6 * area / 3631.0)


def test_an_i2d_of_jwst_is_read_by_its_planes_and_calibrated_by_photmjsr(files: Files) -> None:
    true, zero_point = files.image.copy(), jwst(files)
    files.planes = {"ERR": np.full((SIDE, SIDE), 0.02), "CON": np.ones((SIDE, SIDE)), "WHT": np.ones((SIDE, SIDE))}
    seen = files.read()
    np.testing.assert_allclose(seen.image, true, rtol=2e-6, atol=1e-7)
    assert seen.noise[5, 5] == pytest.approx(0.01)
    assert seen.zero_point == pytest.approx(zero_point, abs=1e-3)
    assert told(seen, "noise").origin == "drz.fits[ERR,1]"
    assert "PHOTMJSR of drz.fits[SCI,1]" in told(seen, "zero_point").origin
    assert told(seen, "exposure_s").origin == "XPOSURE of drz.fits[SCI,1]"
    # So is the same light in DN/s.
    files.science["BUNIT"], files.image = "DN/s", true
    assert files.read(gain=1.0).zero_point == pytest.approx(zero_point, abs=1e-3)
    files.science["BUNIT"], files.image = "MJy/sr", 2.0 * true
    # The gain turns DN into electrons: image and zero point move together.
    more = files.read(gain=1.8)
    assert more.zero_point == pytest.approx(zero_point + 2.5 * math.log10(1.8), abs=1e-3)
    np.testing.assert_allclose(more.image, 1.8 * true, rtol=2e-6, atol=1e-7)
    # Without PHOTMJSR nJy are counted, whose AB zero point is 31.4; both say the same brightness.
    del files.science["PHOTMJSR"]
    bare = files.read()
    assert bare.zero_point == pytest.approx(31.4, abs=1e-3)
    difference = -2.5 * np.log10(bare.image[30, 30] / seen.image[30, 30])
    assert difference + bare.zero_point == pytest.approx(seen.zero_point, abs=1e-3)
    files.science["PIXAR_SR"] *= 2.0
    with pytest.raises(ObservationError, match="pixel_area: PIXAR_SR"):
        files.read()


def test_noise_is_not_made_from_flux_densities_without_electrons(files: Files) -> None:
    jwst(files)
    with pytest.raises(ObservationError, match="gain"):
        files.read()
    assert files.read(gain=1.8).noise[5, 5] == pytest.approx(0.018, rel=0.1)


def test_zero_points_from_other_keywords_and_given_ones(files: Files) -> None:
    del files.science["PHOTFLAM"], files.science["PHOTZPT"]
    files.science["ABMAG"] = 25.5
    assert files.read().zero_point == 25.5
    del files.science["ABMAG"]
    files.science["PHOTZPT"] = 25.6
    assert files.read().zero_point == 25.6
    given = files.read(zero_point=26.6)
    assert given.zero_point == 26.6
    assert noted(given, "zero_point: 26.600 is given and holds")
    files.science["PHOTZPT"] = -21.1
    with pytest.raises(ObservationError, match="zero_point must be given"):
        files.read()
    for absurd in (1e6, -3.0, math.nan, math.inf):
        with pytest.raises(ObservationError, match="zero_point: got"):
            files.read(zero_point=absurd)
    assert noted(files.read(zero_point=12.0), "unlikely")


def test_the_exposure_is_where_the_mission_puts_it(files: Files) -> None:
    files.science["BUNIT"] = "ELECTRONS"
    files.primary["EXPTIME"] = "unknown"
    with pytest.raises(ObservationError, match=r"EXPTIME of drz.fits\[0\]: got 'unknown', allowed is a number"):
        files.read()
    files.primary["EXPTIME"] = 0.0
    with pytest.raises(ObservationError, match="got 0 s"):
        files.read()
    del files.primary["EXPTIME"]
    files.science["XPOSURE"] = EXPOSURE
    assert told(files.read(), "exposure_s").origin == "XPOSURE of drz.fits[SCI,1]"
    # Where nothing is divided by it, it does no harm.
    files.science["BUNIT"], files.science["XPOSURE"] = "ELECTRONS/S", "unknown"
    noise = files.save("noise.fits", np.full((SIDE, SIDE), 0.01))
    assert noted(files.read(noise=noise), "exposure: XPOSURE")
    files.science["XPOSURE"] = 1.0
    assert noted(files.read(), "placeholder")


@pytest.mark.parametrize("turn", [0.0, 60.0, 200.0])
@pytest.mark.parametrize("mirrored", [False, True])
def test_orientation_and_parity_come_from_the_world_coordinates(files: Files, turn: float, mirrored: bool) -> None:
    photometry = {key: files.science[key] for key in ("BUNIT", "PHOTFLAM", "PHOTPLAM")}
    files.science = world(turn, mirrored)
    files.science.update(photometry)
    seen = files.read()
    assert seen.pixel_scale == pytest.approx(SCALE, rel=1e-6)
    assert seen.orientation.mirrored is mirrored
    assert math.remainder(seen.orientation.north - math.radians(turn + 90.0), 2 * math.pi) == pytest.approx(0, abs=1e-6)
    # Against the world coordinates themselves: a place in the image frame is where they say.
    column, row = 40.0, 25.0
    x, y = (column - (SIDE - 1) / 2) * SCALE, (row - (SIDE - 1) / 2) * SCALE
    east, north = (
        WCS(files.science)
        .pixel_to_world((SIDE - 1) / 2, (SIDE - 1) / 2)
        .spherical_offsets_to(WCS(files.science).pixel_to_world(column, row))
    )
    assert seen.orientation.on_sky(x, y) == pytest.approx((east.arcsec, north.arcsec), abs=1e-5)
    # Our own file keeps it, in its world coordinates too.
    write_observation(files.folder / "own.fits", seen)
    assert read_observation(files.folder / "own.fits").orientation == seen.orientation
    copy = WCS(fits.getheader(files.folder / "own.fits", "IMAGE")).pixel_to_world(column, row)
    assert copy.separation(WCS(files.science).pixel_to_world(column, row)).arcsec < 1e-4


def test_world_coordinates_without_a_scale_are_refused_unless_one_is_given(files: Files) -> None:
    for name in [key for key in files.science if key.startswith("CD")]:
        del files.science[name]
    with pytest.raises(ObservationError, match="3600 arcsec a pixel: is CDELT or CD missing"):
        files.read()
    seen = files.read(pixel_scale=0.05)
    assert seen.pixel_scale == 0.05
    assert noted(seen, "North is taken to be up")


def test_a_pixel_scale_against_the_world_coordinates_is_refused_by_name(files: Files) -> None:
    with pytest.raises(ObservationError, match=r"pixel_scale: 0\.08 arcsec is given, .*drz.fits.* say 0\.05"):
        files.read(pixel_scale=0.08)
    trusted = files.read(pixel_scale=0.08, trust_options=True)
    assert trusted.pixel_scale == 0.08
    assert noted(trusted, "pixel_scale")
    assert not files.read(pixel_scale=0.0501).notes


def test_no_bunit_no_world_coordinates_are_assumptions_that_are_told(files: Files) -> None:
    files.science = fits.Header()
    seen = files.read(pixel_scale=0.05, zero_point=25.0)
    assert told(seen, "unit").origin.startswith("assumed")
    assert told(seen, "north").origin.startswith("assumed")


def test_a_weight_before_the_image_is_not_measured(files: Files) -> None:
    files.before["WHT"] = np.full((SIDE, SIDE), EXPOSURE, dtype=np.float32)
    np.testing.assert_allclose(files.read().image, files.image, rtol=1e-6, atol=1e-8)
    hdus = [fits.PrimaryHDU(header=files.primary), fits.ImageHDU(np.ones((SIDE, SIDE)), name="WHT")]
    fits.HDUList(hdus).writeto(files.folder / "wht.fits")
    with pytest.raises(ObservationError, match="holds no image plane but WHT"):
        read_external_observation(files.folder / "wht.fits", files.folder / "psf.fits")


def test_of_several_science_planes_one_is_told_and_another_can_be_asked_for(files: Files) -> None:
    files.planes["SCI"] = np.full((SIDE, SIDE), 7.0, dtype=np.float32)
    path = files.write()
    with fits.open(path, mode="update") as hdus:
        hdus[2].header["EXTVER"] = 2
        hdus[2].header.update(files.science)
        hdus[2].header["EXTVER"] = 2
    psf = files.save("psf.fits", files.psf)
    how = {"noise": files.save("noise.fits", np.full((SIDE, SIDE), 0.01))}
    first = read_external_observation(path, psf, **how)
    assert any("1 more such planes" in note for note in first.notes)
    for extension in ("SCI,2", 2):
        assert read_external_observation(path, psf, extension=extension, **how).image[0, 0] == 7.0
    with pytest.raises(ObservationError, match="extension 'ERR' is no image"):
        read_external_observation(path, psf, extension="ERR", **how)


def test_science_and_errors_given_as_noise_are_taken_by_name(files: Files) -> None:
    files.planes["ERR"] = np.full((SIDE, SIDE), 0.02, dtype=np.float32)
    seen = files.read(noise=files.write())
    assert seen.noise[0, 0] == pytest.approx(0.02)
    assert told(seen, "noise").origin == "drz.fits[ERR,1]"
    del files.planes["ERR"]
    with pytest.raises(ObservationError, match="holds no noise plane but SCI"):
        files.read(noise=files.write())


def test_an_image_given_for_its_noise_is_refused(files: Files) -> None:
    with pytest.raises(ObservationError, match=r"noise: .* is negative"):
        files.read(noise=files.save("noise.fits", files.image.astype(np.float32)))
    files.image = np.abs(files.image)
    with pytest.raises(ObservationError, match="noise: is the image itself"):
        files.read(noise=files.save("noise.fits", files.image.astype(np.float32)))


def test_our_own_file_as_psf_gives_its_psf(files: Files) -> None:
    own = Observation(sky(), np.full((SIDE, SIDE), 0.01), gaussian((21, 21), 10, 10, 1.1), SCALE, 25.0)
    write_observation(files.folder / "own.fits", own)
    seen = files.read(psf=files.folder / "own.fits")
    np.testing.assert_allclose(seen.psf, own.psf / own.psf.sum(), rtol=1e-12)
    assert told(seen, "psf").origin == "own.fits[PSF,1]"
    # And as an image beside a PSF, with its own scale, zero point and noise map.
    parts = read_external_observation(files.folder / "own.fits", files.folder / "own.fits", normalise_psf=True)
    np.testing.assert_array_equal(parts.image, own.image)
    np.testing.assert_array_equal(parts.noise, own.noise)
    assert (parts.pixel_scale, parts.zero_point) == (SCALE, 25.0)


def test_a_psf_on_other_pixels_or_the_image_as_psf_are_refused(files: Files) -> None:
    with pytest.raises(ObservationError, match="psf: is the image itself"):
        files.read(psf=files.write())
    for scale in (0.03, 0.1):
        files.psf_header = fits.Header({"PIXELSCL": scale})
        with pytest.raises(ObservationError, match=rf"psf: PIXELSCL of psf.fits\[0\] says {scale} arcsec a pixel"):
            files.read()


@pytest.mark.parametrize("factor", [2, 3, 4])
def test_an_oversampled_psf_comes_to_the_pixels_of_the_image(files: Files, factor: int) -> None:
    # A Gaussian of 1.5 pixels, integrated over pixels by the error function.
    edges = (np.arange(22) - 10.5) / (1.5 * math.sqrt(2.0))
    mean = np.diff([math.erf(edge) for edge in edges])
    true = np.outer(mean, mean) / mean.sum() ** 2
    side = 21 * factor - (factor % 2 == 0)
    files.psf = gaussian((side, side), side // 2, side // 2, 1.5 * factor)
    files.psf_header = fits.Header({"PIXELSCL": SCALE / factor})
    seen = files.read()
    # Sums over fine pixels for integrals: the midpoint rule, or the trapezoidal one, whose errors go with their square.
    np.testing.assert_allclose(seen.psf, np.pad(true, (seen.psf.shape[0] - 21) // 2), atol=1.5e-3 / (factor / 2) ** 2)
    assert told(seen, "psf_oversampling") == Reading("psf_oversampling", factor, "PIXELSCL of psf.fits[0]")
    files.psf_header = None
    np.testing.assert_array_equal(files.read(psf_oversampling=factor).psf, seen.psf)
    with pytest.raises(ObservationError, match="psf_oversampling: got 0"):
        files.read(psf_oversampling=0)


@pytest.mark.parametrize("factor", [1, 2, 3, 4])
def test_stars_say_how_finely_a_psf_is_sampled_where_no_keyword_does(files: Files, factor: int) -> None:
    stars = [gaussian(files.image.shape, row, column, 1.0) for row, column in ((24.2, 30.0), (38.0, 21.3))]
    files.image = files.image + sum(stars) / stars[0].max() * 300.0 * files.image.std()
    side = 41 * factor - (factor % 2 == 0)
    files.psf = gaussian((side, side), side // 2, side // 2, 1.0 * factor)
    seen = files.read()
    if factor == 1:
        assert not [reading for reading in readings(seen) if reading.name == "psf_oversampling"]
        return
    assert told(seen, "psf_oversampling") == Reading("psf_oversampling", factor, "the point sources of the image")
    assert any(note.startswith(f"psf: is taken for sampled {factor} times as finely") for note in seen.notes)
    np.testing.assert_array_equal(files.read(psf_oversampling=factor).psf, seen.psf)
    # Whoever says that it is on the pixels of the image is believed, with a note.
    assert any("times as sharp" in note for note in unlikely(files.read(psf_oversampling=1), trusting=True))


def test_a_hot_pixel_and_a_pedestal_are_taken_out_of_a_psf_and_told(files: Files) -> None:
    clean = files.read().psf
    files.psf[5, 30] = 4.0
    seen = files.read()
    assert noted(seen, "1 hot pixels, as that in row 5, column 30")
    np.testing.assert_allclose(seen.psf, clean, atol=1e-5)
    files.psf = gaussian((41, 41), 20, 20, 1.3) + 0.01
    seen = files.read()
    assert noted(seen, "a pedestal of 0.01")
    np.testing.assert_allclose(seen.psf, clean, atol=1e-4)
    # Wings, noise and an undersampled peak are none of these.
    r = np.hypot(*np.meshgrid(np.arange(-20, 21), np.arange(-20, 21)))
    for fine in (
        (1.0 + (r / 1.5) ** 2) ** -1.5,
        gaussian((41, 41), 20, 20, 0.5),
        gaussian((41, 41), 20, 20, 1.3) + 1e-3 * np.random.default_rng(1).standard_normal((41, 41)),
        gaussian((15, 15), 7, 7, 2.5),
    ):
        files.psf = fine
        assert not noted(files.read(), "psf")
    files.psf = np.zeros((9, 9))
    files.psf[4, 4] = 1.0
    with pytest.raises(ObservationError, match="in a single pixel"):
        files.read()


def test_saturation_counts_beside_a_noise_map(files: Files) -> None:
    noise = files.save("noise.fits", np.full((SIDE, SIDE), 0.01))
    seen = files.read(noise=noise, saturation_e_s=1.9)
    assert not seen.valid[30, 30]
    assert seen.provenance["saturated_pixels"] == np.count_nonzero(~seen.valid)
    with pytest.raises(SpecError, match="sky_rms"):
        files.read(noise=noise, sky_rms_e_s=0.01)


def test_nan_in_a_mask_is_bad_and_flags_or_masks_inside_out_are_refused(files: Files) -> None:
    mask = np.ones((SIDE, SIDE))
    mask[3, 4], mask[5, 6] = np.nan, 0.0
    seen = files.read(mask=files.save("mask.fits", mask))
    assert not seen.valid[3, 4]
    assert np.count_nonzero(~seen.valid) == 2
    flags = np.zeros((SIDE, SIDE), dtype=np.int16)
    flags[:3], flags[10, 10], flags[11, 11] = 4, 256, 4096 + 64
    with pytest.raises(ObservationError, match=r"mask: got the values 0, 4, 256, 4160, .* given as dq"):
        files.read(mask=files.save("mask.fits", flags))
    with pytest.raises(ObservationError, match=r"leaves 5.1% of the pixels.*inside out"):
        files.read(mask=files.save("mask.fits", (flags > 0).astype(np.uint8)))
    assert files.read(mask=files.folder / "mask.fits", trust_options=True).valid.sum() == np.count_nonzero(flags)
    with pytest.raises(ObservationError, match="dq: allowed are flags"):
        files.read(dq=files.save("dq.fits", mask))


def test_bits_of_dq_planes_have_names_and_the_harmless_ones_do_no_harm(files: Files) -> None:
    flags = np.zeros((SIDE, SIDE), dtype=np.int16)
    flags[10, 10], flags[11, 11], flags[12, 12] = 256, 64, 4096 + 64
    files.planes["DQ"] = flags
    seen = files.read()
    assert not seen.valid[10, 10]
    assert seen.valid[11, 11]
    assert not seen.valid[12, 12]
    assert told(seen, "dq").value == "2 pixels out, SATURATED 1, COSMIC_RAY_DRIZZLE 1"
    assert files.read(good_bits="WARM,COSMIC_RAY_DRIZZLE").valid.sum() == SIDE**2 - 1
    with pytest.raises(ObservationError, match="good_bits"):
        files.read(good_bits="NONSENSE")
    # A plane of its own goes before; JWST's rule is DO_NOT_USE.
    files.primary["TELESCOP"] = "JWST"
    header = fits.Header({"TELESCOP": "JWST"})
    alone = np.zeros((SIDE, SIDE), dtype=np.int32)
    alone[1, 1], alone[2, 2] = 1 + 2048, 4
    seen = files.read(dq=files.save("dq.fits", alone, header))
    assert told(seen, "dq").value == "1 pixels out, DO_NOT_USE 1"


def test_noise_is_made_from_weights_counts_and_the_correlation_of_drizzle(files: Files) -> None:
    weight = np.full((SIDE, SIDE), EXPOSURE)
    weight[:, :20] = EXPOSURE / 4
    weight[0, 0] = 0.0
    rng = np.random.default_rng(5)
    files.image = 2.0 * gaussian((SIDE, SIDE), 30, 40, 3.0)
    files.image += 0.01 * np.sqrt(EXPOSURE / np.maximum(weight, 1.0)) * rng.standard_normal((SIDE, SIDE))
    files.planes["WHT"] = weight.astype(np.float32)
    seen = files.read()
    # Two thirds of 900 pixels tell the sky: 3 %; the median over a window takes some of it.
    assert seen.noise[50, 50] == pytest.approx(0.01, rel=0.1)
    # What stands above the sky there is noise, too, and adds its counts.
    assert seen.noise[50, 5] / seen.noise[50, 50] == pytest.approx(2.0, rel=0.03)
    # Counts above the sky: 2 e-/s for 2000 s.
    assert seen.noise[30, 40] == pytest.approx(math.sqrt(2.0 / EXPOSURE + 1e-4), rel=0.05)
    assert not seen.valid[0, 0]
    # Weights that are inverse variances say the same.
    files.planes["WHT"] = (weight * 3e4).astype(np.float32)
    np.testing.assert_allclose(files.read().noise, seen.noise, rtol=1e-5)
    # Casertano et al. (2000), eq. A20: pixfrac 0.8 on pixels of 0.6 native ones, F_A^-1/2 = 1 / (s/p (1 - s/(3p))).
    files.science["D001PIXF"], files.science["D001ISCL"] = 0.8, SCALE / 0.6
    s, p = 0.6, 0.8
    again = files.read()
    assert again.provenance["correlation"] == pytest.approx(1.0 / (s / p * (1.0 - s / (3.0 * p))), rel=1e-3)
    ratio = (again.noise[50, 50] ** 2 - seen.noise[50, 50] ** 2) / 0.01**2
    assert ratio == pytest.approx(again.provenance["correlation"] ** 2 - 1.0, rel=0.2)


def test_a_field_of_4000_pixels_is_refused_and_cut_out_by_a_place_on_the_sky(files: Files) -> None:
    side = 4000
    files.image = np.zeros((side, side), dtype=np.float32)
    files.image[3000 - 30 : 3000 + 30, 1000 - 30 : 1000 + 30] = sky()
    photometry = {key: files.science[key] for key in ("BUNIT", "PHOTFLAM", "PHOTPLAM")}
    files.science = world(side=side)
    files.science.update(photometry)
    with pytest.raises(ObservationError, match=r"4000 x 4000 pixels, allowed are 640.*cut the lens out"):
        files.read()
    place = WCS(files.science).pixel_to_world(1000, 3000)
    noise = files.save("noise.fits", np.full((side, side), 0.01, dtype=np.float32))
    for center in (
        (f"{place.ra.deg:.7f}", f"{place.dec.deg:.7f}"),
        (place.ra.to_string(unit="hour", sep=":", precision=4), place.dec.to_string(sep=":", precision=3)),
    ):
        seen = files.read(noise=noise, center=center, size=2.5)
        assert seen.shape == (49, 49)
        assert seen.centre == pytest.approx((place.ra.deg, place.dec.deg), abs=1e-7)
        expected = Cutout2D(files.image, (1000, 3000), 49).data
        np.testing.assert_allclose(seen.image, expected, rtol=1e-6, atol=1e-8)
    for center, size in ((("10", "80"), 3.0), (("x", "y"), 3.0), (("150", "2"), -1.0), (("150", "2"), None)):
        with pytest.raises(SpecError, match=r"center|size"):
            files.read(center=center, size=size)


DISTORTIONS = {
    "CPDIS": {"CPDIS1": "LOOKUP", "DP1.EXTVER": 1.0, "DP1.NAXES": 2.0},
    "SIP": {
        "A_ORDER": 2,
        "A_2_0": 1e-6,
        "B_ORDER": 2,
        "B_0_2": 1e-6,
        "CTYPE1": "RA---TAN-SIP",
        "CTYPE2": "DEC--TAN-SIP",
    },
    "half a SIP": {"A_ORDER": 2, "A_2_0": 1e-6},
    "D2IM": {"D2IMDIS1": "LOOKUP", "D2IM1.EXTVER": 1.0},
    "D2IM of no kind": {"D2IMDIS1": "GARBAGE"},
}


@pytest.mark.parametrize("kind", DISTORTIONS)
def test_tables_of_distortion_are_warned_of_and_not_fatal(files: Files, kind: str) -> None:
    files.science.update(DISTORTIONS[kind])
    seen = files.read()
    assert noted(seen, "distortion: ")
    assert seen.pixel_scale == pytest.approx(SCALE, rel=1e-3)


BROKEN = {
    "CDELT 0": {"CDELT1": 0.0, "CDELT2": 0.0, "CD1_1": None, "CD1_2": None, "CD2_1": None, "CD2_2": None},
    "RADESYS": {"RADESYS": "NONSENSE"},
    "CTYPE": {"CTYPE1": "RA---XYZ", "CTYPE2": "DEC--XYZ"},
    "two latitudes": {"CTYPE1": "DEC--TAN"},
    "CUNIT": {"CUNIT1": "furlong", "CUNIT2": "furlong"},
    "singular": {"CD1_1": 0.0, "CD1_2": 0.0, "CD2_1": 0.0, "CD2_2": 0.0},
    "oblong": {"CD1_1": -SCALE / 3600 * 2},
}


@pytest.mark.parametrize("kind", BROKEN)
def test_broken_world_coordinates_are_one_line_and_a_note_where_the_scale_is_given(files: Files, kind: str) -> None:
    for name, value in BROKEN[kind].items():
        if value is None:
            del files.science[name]
        else:
            files.science[name] = value
    with pytest.raises(EngineError, match=r"drz\.fits") as caught:
        files.read()
    assert "\n" not in str(caught.value)
    seen = files.read(pixel_scale=0.05)
    assert noted(seen, "world coordinates")


@pytest.mark.parametrize("name", ["exposure_s", "gain", "pixel_scale", "saturation_e_s", "sky_rms_e_s"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_zero_and_nan_parameters_are_refused_by_name(files: Files, name: str, value: float) -> None:
    with pytest.raises(ObservationError, match=f"{name}: got"):
        files.read(**{name: value})


def test_broken_files_are_one_line(files: Files) -> None:
    path = files.write()
    whole = path.read_bytes()
    psf = files.save("psf.fits", files.psf)
    for name, content in {
        "cut.fits": whole[: len(whole) // 2],
        "head.fits": whole[:1000],
        "flipped.fits": whole.replace(b"BITPIX  =                  -32", b"BITPIX  =                   17"),
        "empty.fits": b"",
    }.items():
        (files.folder / name).write_bytes(content)
        with pytest.raises(EngineError, match=name) as caught:
            read_external_observation(files.folder / name, psf, zero_point=25.0)
        assert "\n" not in str(caught.value)
