"""Arrays with a mask or a unit keep both; an Observation can be pickled and copied."""

import copy
import math
import pickle

import numpy as np
import pytest
from astropy import units
from astropy.nddata import CCDData, InverseVariance, StdDevUncertainty
from astropy.utils.masked import Masked

from engine import NoiseFromImage, ObservationError, observation_from_arrays
from engine.conventions import Orientation
from engine.imaging.observation import Observation

RATE = units.electron / units.s
IMAGE = np.arange(12.0).reshape(3, 4)
HOLE = np.zeros((3, 4), dtype=bool)
HOLE[1, 2] = True
PSF = np.zeros((5, 5))
PSF[2, 2] = 1.0


def made(image: object = IMAGE, noise: object = None, **options: object) -> Observation:
    given = np.ones((3, 4)) if noise is None else noise
    options = {"pixel_scale": 0.08, "zero_point": 25.0, "psf": PSF} | options
    return observation_from_arrays(image, given, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "image",
    [
        np.ma.MaskedArray(IMAGE, HOLE),
        Masked(IMAGE, HOLE),
        Masked(IMAGE * RATE, HOLE),
        CCDData(IMAGE, unit=RATE, mask=HOLE),
        CCDData(60.0 * IMAGE, unit=units.electron / units.min, mask=HOLE),
    ],
    ids=lambda image: type(image).__name__,
)
def test_a_mask_makes_pixels_invalid_and_a_unit_is_converted(image: object) -> None:
    seen = made(image)
    np.testing.assert_array_equal(seen.valid, ~HOLE)
    np.testing.assert_allclose(seen.image, np.where(HOLE, 0.0, IMAGE), rtol=1e-12)
    assert seen.provenance["masked_pixels"] == 1


def test_noise_keeps_its_mask_its_unit_and_its_kind() -> None:
    assert not made(noise=np.ma.MaskedArray(np.ones((3, 4)), HOLE)).valid[1, 2]
    for noise in (
        0.5 * np.ones((3, 4)) * RATE,
        30.0 * np.ones((3, 4)) * units.electron / units.min,
        StdDevUncertainty(0.5 * np.ones((3, 4)), unit=RATE),
        InverseVariance(4.0 * np.ones((3, 4))),
    ):
        np.testing.assert_allclose(made(noise=noise).noise, 0.5, rtol=1e-12)


@pytest.mark.parametrize("unit", [units.electron, units.adu / units.s, units.MJy / units.sr, units.one])
def test_a_unit_that_is_no_rate_of_electrons_is_refused_by_name(unit: units.UnitBase) -> None:
    with pytest.raises(ObservationError, match=r"image: got the unit .*, allowed is electron / s"):
        made(IMAGE * unit)
    with pytest.raises(ObservationError, match="noise: got the unit"):
        made(noise=np.ones((3, 4)) * unit)


def test_scale_and_zero_point_may_have_units() -> None:
    seen = made(pixel_scale=80.0 * units.mas, zero_point=25.5 * units.ABmag)
    assert (seen.pixel_scale, seen.zero_point) == (pytest.approx(0.08), 25.5)
    assert made(pixel_scale=0.08 * units.arcsec / units.pix).pixel_scale == pytest.approx(0.08)
    with pytest.raises(ObservationError, match="pixel_scale: got the unit"):
        made(pixel_scale=1.0 * units.m)


def test_an_observation_itself_refuses_what_it_would_strip() -> None:
    for image in (np.ma.MaskedArray(IMAGE, HOLE), IMAGE * RATE, CCDData(IMAGE, unit=RATE)):
        with pytest.raises(ObservationError, match=r"image: got a .*, whose mask or unit would be lost"):
            Observation(image, np.ones((3, 4)), PSF, 0.08, 25.0)  # type: ignore[arg-type]
    Observation(np.ma.MaskedArray(IMAGE), np.ones((3, 4)), PSF, 0.08, 25.0)


def test_nan_zero_and_masked_entries_of_a_mask_are_bad() -> None:
    valid = np.ones((3, 4))
    valid[0, 0], valid[0, 1] = np.nan, 0.0
    assert made(valid=valid).valid.sum() == 10
    assert made(valid=np.ma.MaskedArray(np.ones((3, 4), dtype=bool), HOLE)).valid.sum() == 11


def test_saturated_and_masked_pixels_do_not_tell_the_noise() -> None:
    rng = np.random.default_rng(0)
    image = np.ma.MaskedArray(0.01 * rng.standard_normal((60, 60)), np.zeros((60, 60), dtype=bool))
    image[:, 30:] = 1e3 * rng.standard_normal((60, 30))
    image.mask = np.arange(60)[None, :] >= np.full((60, 1), 30)
    seen = made(image, NoiseFromImage(exposure_s=1e4), psf=PSF)
    assert seen.provenance["noise_sky_rms"] == pytest.approx(0.01, rel=0.1)
    assert seen.valid.sum() == 1800


def test_an_observation_can_be_pickled_and_copied() -> None:
    seen = made(
        np.ma.MaskedArray(IMAGE, HOLE), provenance={"a": "b"}, centre=(1.0, 2.0),
        orientation=Orientation(math.radians(30), mirrored=True), notes=("odd",),
    )  # fmt: skip
    pickled = pickle.loads(pickle.dumps(seen))  # noqa: S301 - written a moment ago
    for other in (pickled, copy.copy(seen), copy.deepcopy(seen)):
        for name in ("image", "noise", "psf", "valid"):
            np.testing.assert_array_equal(getattr(other, name), getattr(seen, name))
            assert not getattr(other, name).flags.writeable
        assert dict(other.provenance) == dict(seen.provenance)
        assert (other.centre, other.orientation, other.notes) == (seen.centre, seen.orientation, ("odd",))
