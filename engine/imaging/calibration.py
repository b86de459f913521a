"""From a plane's own unit to e-/s and AB magnitudes: BUNIT, exposure, gain and zero point, where missions put them."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Literal

from astropy import units

from engine.errors import ObservationError
from engine.imaging.fits_planes import Headers
from engine.imaging.readings import Findings

ImageUnit = Literal["e-/s", "e-", "count/s", "count", "DN/s", "DN", "MJy/sr"]
EXPOSURE = ("EXPTIME", "TEXPTIME", "XPOSURE", "EFFEXPTM", "EXPOSURE")
_GAIN = ("ATODGAIN", "ADCGAIN", "CCDGAIN", "GAIN")
_ZERO_POINT = ("ABMAG", "ABMAGZP", "MAGZPT", "MAGZERO", "ZEROPNT")
_ALIASES = {
    **dict.fromkeys(("electrons", "e", "photoelectron", "photoelectrons"), units.electron),
    **dict.fromkeys(("counts", "adus"), units.ct),
    **dict.fromkeys(("sec", "seconds"), units.s),
    "cps": units.ct / units.s,
    "mjy": units.MJy,
}
_COUNTS = (units.adu, units.DN)
POSSIBLE_ZERO_POINTS, LIKELY_ZERO_POINTS = (0.0, 50.0), (15.0, 35.0)
_AREA_AGREES, _AREA_WRONG, _ZERO_POINT_AGREES = 0.02, 0.25, 0.05
_ST_ZERO_POINT = -21.1
_SHORTEST_EXPOSURE = 2.0


@dataclass(frozen=True)
class Given:
    """What somebody says of an image; None where the file is to say it. [arcsec], [mag], [s], [e-/s]."""

    pixel_scale: float | None = None
    zero_point: float | None = None
    unit: ImageUnit | None = None
    exposure_s: float | None = None
    gain: float | None = None
    saturation_e_s: float | None = None
    sky_rms_e_s: float | None = None

    def __post_init__(self) -> None:
        """Refuse what can be none of these; NaN among them."""
        for name in ("pixel_scale", "exposure_s", "gain", "saturation_e_s", "sky_rms_e_s"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise ObservationError(f"{name}: got {value}, allowed is a positive number")
        if self.zero_point is not None:
            require_zero_point(self.zero_point, "zero_point")
        if self.unit is not None:
            unit_of(self.unit, "unit")


@dataclass(frozen=True)
class Calibration:
    """``factor`` turns the image's ``unit`` into e-/s; ``zero_point`` is the AB magnitude of 1 e-/s."""

    unit: units.UnitBase
    factor: float
    zero_point: float
    exposure_s: float | None
    electrons: bool
    """Whether e-/s are that indeed, so that Poisson noise can be told from them."""


def require_zero_point(value: float, name: str) -> None:
    """An ObservationError where a zero point is beyond any that a telescope has."""
    low, high = POSSIBLE_ZERO_POINTS
    if not low <= value <= high:
        raise ObservationError(f"{name}: got {value:g}, allowed is an AB magnitude of 1 e-/s from {low:g} to {high:g}")


def unit_of(text: str, origin: str) -> units.UnitBase:
    """The unit that a text means, counts of any kind as ``ct``: an amount of light in a pixel, or its brightness.

    Raises
    ------
    ObservationError
        It is no unit, or none of light.
    """
    written = text.strip().replace("e-", "electron").replace("/pixel", "").replace("/pix", "")
    with warnings.catch_warnings(), units.set_enabled_aliases(_ALIASES):
        warnings.simplefilter("ignore", units.UnitsWarning)
        # HST writes capitals, which are other units: S is siemens.
        for spelling in dict.fromkeys((written, written.lower())):
            try:
                unit = units.Unit(spelling)
            except (ValueError, TypeError):
                continue
            for count in _COUNTS:
                unit = unit if count not in unit.bases else unit * units.ct / count
            if any(_is(unit, kind) for kind in _KINDS):
                return unit
    raise ObservationError(
        f"{origin}: got {text!r}, allowed is a unit of light: electron, count or DN (and per second), MJy/sr, Jy"
    )


_KINDS = (
    units.electron / units.s, units.electron, units.ct / units.s, units.ct, units.MJy / units.sr, units.Jy,
)  # fmt: skip


def _is(unit: units.UnitBase, kind: units.UnitBase) -> bool:
    return bool(unit.is_equivalent(kind))


def calibrate(headers: Headers, given: Given, pixel_scale: float, found: Findings, *, makes_noise: bool) -> Calibration:
    """How an image's values become e-/s, and the zero point of these; all that is read goes to ``found``.

    Raises
    ------
    ObservationError
        Something is missing, no number, or contradicts what is given.
    """
    unit = _unit(headers, given, found)
    in_flux = _is(unit, units.Jy) or _is(unit, units.MJy / units.sr)
    total = _is(unit, units.electron) or _is(unit, units.ct)
    seconds = _exposure(headers, given, found, needed=total or makes_noise, divides=total)
    gain = _gain(headers, given, unit, found, needed=not in_flux or makes_noise)
    if in_flux:
        return _from_flux(headers, given, unit, seconds, gain, pixel_scale, found)
    plain = next(kind for kind in _KINDS if _is(unit, kind))
    factor = float(unit.to(plain)) * (gain or 1.0) / (seconds if total and seconds else 1.0)
    stated = _stated_zero_point(headers)
    if stated is not None and gain:
        # It is that of 1 count/s, of which an electron is the gain's fraction.
        stated = (stated[0] + 2.5 * math.log10(gain), stated[1])
    return Calibration(unit, factor, _zero_point(given, stated, headers, found), seconds, electrons=True)


def _unit(headers: Headers, given: Given, found: Findings) -> units.UnitBase:
    stated = headers.find("BUNIT")
    stated = None if stated is None or not str(stated[0]).strip() else stated
    if given.unit is None:
        text, origin = ("e-/s", "assumed: there is no BUNIT") if stated is None else (str(stated[0]), stated[1])
    else:
        text, origin = given.unit, "--unit"
    unit = unit_of(text, origin)
    if given.unit is not None and stated is not None:
        try:
            same = unit == unit_of(str(stated[0]), stated[1])
        except ObservationError:
            same = False
        if not same:
            found.contradict(f"unit: --unit says {text}, {stated[1]} says {str(stated[0])!r}")
    found.read("unit", text, origin)
    return unit


def _exposure(headers: Headers, given: Given, found: Findings, *, needed: bool, divides: bool) -> float | None:
    if given.exposure_s is not None:
        found.read("exposure_s", float(given.exposure_s), "--exposure")
        return float(given.exposure_s)
    try:
        stated = _stated_exposure(headers)
    except ObservationError as error:
        if needed:
            raise
        found.note(f"exposure: {error}; it is not needed")
        return None
    if stated is None:
        if needed:
            why = "its electrons are divided by it" if divides else "a noise map is made with it"
            raise ObservationError(f"{headers.origin}: has no EXPTIME, so exposure_s must be given ({why})")
        return None
    found.read("exposure_s", *stated)
    if needed and stated[0] < _SHORTEST_EXPOSURE:
        found.note(f"exposure: {stated[0]:g} s of {stated[1]} look like a placeholder, and what is made of it is wrong")
    return stated[0]


def _stated_exposure(headers: Headers) -> tuple[float, str] | None:
    stated = headers.number(*EXPOSURE)
    if stated is not None and not stated[0] > 0:
        raise ObservationError(f"{stated[1]}: got {stated[0]:g} s, allowed is a positive exposure")
    return stated


def _gain(headers: Headers, given: Given, unit: units.UnitBase, found: Findings, *, needed: bool) -> float | None:
    """Electrons in a count; None where the unit has them already, or where none is known or needed."""
    in_electrons = _is(unit, units.electron) or _is(unit, units.electron / units.s)
    if given.gain is not None:
        if in_electrons and given.gain != 1.0 and (given.unit is not None or headers.find("BUNIT") is not None):
            found.contradict(f"gain: --gain says {given.gain:g}, but the image is in electrons already")
        found.read("gain", float(given.gain), "--gain")
        return float(given.gain)
    if in_electrons:
        found.read("gain", 1.0, "the image is in electrons")
        return None
    stated = headers.number(*_GAIN) if needed else None
    if stated is not None and stated[0] > 0:
        found.read("gain", *stated)
        return stated[0]
    if needed:
        raise ObservationError(f"{headers.origin}: is in {unit}, so the gain, electrons in a count, must be given")
    return None


def _stated_zero_point(headers: Headers) -> tuple[float, str] | None:
    """AB magnitude of one unit of the image per second, as the headers have it."""
    flux, pivot = headers.number("PHOTFLAM"), headers.number("PHOTPLAM")
    if flux is not None and pivot is not None and flux[0] > 0 and pivot[0] > 0:
        density = flux[0] * units.erg / units.s / units.cm**2 / units.AA
        magnitude = density.to_value(units.ABmag, units.spectral_density(pivot[0] * units.AA))
        base = headers.number("PHOTZPT")
        # Of the ST system, whose constant it repeats; anything else it says is no part of this sum.
        away = 0.0 if base is None or abs(base[0] - _ST_ZERO_POINT) > 1.0 else base[0] - _ST_ZERO_POINT
        return float(magnitude) + away, f"{flux[1]} and PHOTPLAM"
    response, area = headers.number("PHOTMJSR"), headers.number("PIXAR_SR")
    if response is not None and area is not None and response[0] > 0 and area[0] > 0:
        return float((response[0] * area[0] * units.MJy).to_value(units.ABmag)), f"{response[1]} and PIXAR_SR"
    stated = headers.number("PHOTZPT", *_ZERO_POINT)
    if stated is not None and abs(stated[0] - _ST_ZERO_POINT) < 1.0:
        stated = headers.number(*_ZERO_POINT)
    return stated


def _zero_point(given: Given, stated: tuple[float, str] | None, headers: Headers, found: Findings) -> float:
    if given.zero_point is None:
        if stated is None:
            raise ObservationError(
                f"{headers.origin}: has no PHOTFLAM with PHOTPLAM, PHOTMJSR or ABMAG, so zero_point must be given"
            )
        value, origin = stated
        require_zero_point(value, origin)
    else:
        value, origin = float(given.zero_point), "--zeropoint"
        if stated is not None and abs(stated[0] - value) > _ZERO_POINT_AGREES:
            found.note(f"zero_point: {value:.3f} is given and holds, {stated[1]} say {stated[0]:.3f}")
    low, high = LIKELY_ZERO_POINTS
    if not low <= value <= high:
        found.note(f"zero_point: {value:g} ({origin}) is unlikely for 1 e-/s, most lie from {low:g} to {high:g}")
    found.read("zero_point", value, origin)
    return value


def _from_flux(
    headers: Headers,
    given: Given,
    unit: units.UnitBase,
    seconds: float | None,
    gain: float | None,
    pixel_scale: float,
    found: Findings,
) -> Calibration:
    """An image of flux densities, MJy/sr above all: PHOTMJSR makes DN/s of them, and nJy are counted without it."""
    area = (pixel_scale * units.arcsec).to_value(units.rad) ** 2
    if _is(unit, units.MJy / units.sr):
        stated = headers.number("PIXAR_SR")
        if stated is None or not stated[0] > 0:
            found.read("pixel_area_sr", area, "the pixel scale: there is no PIXAR_SR")
        else:
            wrong = abs(stated[0] / area - 1.0)
            if wrong > _AREA_WRONG:
                found.contradict(f"pixel_area: {stated[1]} says {stated[0]:.4g} sr, the pixel scale {area:.4g} sr")
            elif wrong > _AREA_AGREES:
                found.note(f"pixel_area: {stated[1]} says {stated[0]:.4g} sr, the pixel scale {area:.4g} sr")
            area = stated[0]
            found.read("pixel_area_sr", *stated)
        flux = (unit * units.sr).to(units.MJy) * area
    else:
        flux = unit.to(units.MJy)
    response = headers.number("PHOTMJSR") if _is(unit, units.MJy / units.sr) else None
    if response is None or not response[0] > 0:
        rate, origin = 1e-15, f"the unit: 1 nJy is counted as 1 e-/s, {headers.origin} has no PHOTMJSR"
    else:
        # [MJy] of one electron in a second: PHOTMJSR is the brightness of 1 DN/s.
        rate, origin = response[0] * area / (gain or 1.0), f"{response[1]} and the area of a pixel"
        found.read("photmjsr", *response)
    stated_zero_point = (float((rate * units.MJy).to_value(units.ABmag)), origin)
    zero_point = _zero_point(given, stated_zero_point, headers, found)
    electrons = response is not None and gain is not None
    return Calibration(unit, float(flux / rate), zero_point, seconds, electrons=electrons)
