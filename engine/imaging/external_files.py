"""Observations from anybody's FITS files: what HST and JWST deliver, and what is made from it.

What is read, and where it stood, is in the provenance (:mod:`.readings`); what contradicts is refused by name, what is
odd becomes a note, and what is given goes before what a file says.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from astropy import units
from astropy.io import fits
from numpy.typing import NDArray

from engine.conventions import NORTH_UP, FloatArray, Orientation
from engine.errors import ObservationError, SpecError
from engine.imaging.calibration import Calibration, Given, ImageUnit, calibrate, unit_of
from engine.imaging.external import observation_from_arrays
from engine.imaging.fits_planes import Headers, Plane, Slices, companion, opened, require_plane
from engine.imaging.flags import usable_by_flags, usable_by_mask
from engine.imaging.noise_from_image import NoiseFromImage, drizzle_correlation
from engine.imaging.observation import Observation
from engine.imaging.psf_centre import PsfCentre
from engine.imaging.psf_stamp import binned, same_picture
from engine.imaging.readings import Findings, recorded
from engine.imaging.sharpness import sampled_more_finely
from engine.imaging.world import Placement, World, cutout, place, read_world

MOST_PIXELS = 640
"""Along a side of an image: a lens is a matter of arcseconds."""
_SCALE_AGREES, _PSF_SCALE_AGREES = 0.01, 0.02
_SCALE_KEYWORDS = ("PIXSCALE", "PIXELSCL", "SECPIX")
_MOST_NEGATIVE = 0.01


@dataclass(frozen=True, eq=False)
class _Science:
    """The image [e-/s] and what its own file says of it; the other arrays are None where the file has none."""

    values: FloatArray
    whole: tuple[int, int]
    where: Slices | None
    headers: Headers
    pixel_scale: float
    orientation: Orientation
    centre: tuple[float, float] | None
    calibration: Calibration
    noise: FloatArray | None
    weight: FloatArray | None
    good: NDArray[np.bool_] | None

    def part(self, plane: Plane) -> FloatArray:
        """Of a plane what the image shows: a plane as large as the whole is cut as the image was."""
        return plane.values(self.where if plane.shape == self.whole else None)


def read_external_observation(
    image: str | Path,
    psf: str | Path,
    *,
    zero_point: float | None = None,
    noise: str | Path | None = None,
    mask: str | Path | None = None,
    dq: str | Path | None = None,
    pixel_scale: float | None = None,
    unit: ImageUnit | None = None,
    exposure_s: float | None = None,
    gain: float | None = None,
    saturation_e_s: float | None = None,
    sky_rms_e_s: float | None = None,
    good_bits: str | None = None,
    center: tuple[str, str] | None = None,
    size: float | None = None,
    extension: str | int | None = None,
    recentre_psf: PsfCentre | None = None,
    normalise_psf: bool = False,
    mend_psf: bool = False,
    psf_oversampling: int | None = None,
    trust_options: bool = False,
) -> Observation:
    """Read an observation that somebody else made; planes are known by EXTNAME (:mod:`.fits_planes`).

    Parameters
    ----------
    image, psf
        The image, with ERR or WHT and DQ where it has them; the PSF on the same pixels.
    zero_point
        AB magnitude of 1 e-/s; PHOTFLAM with PHOTPLAM, PHOTMJSR or ABMAG where None.
    noise
        1 sigma map, in its own BUNIT or the image's unit. Without one the image's ERR is taken; without that it is made
        from the image (:class:`~engine.imaging.noise_from_image.NoiseFromImage`) and its WHT.
    mask, dq
        Not zero where a pixel may be used; flags, zero where a pixel is good.
    pixel_scale
        [arcsec]; the image's world coordinates are asked where None.
    unit
        Of the image; BUNIT where None, and e-/s where there is none.
    exposure_s
        Needed for electrons, and to make a noise map; EXPTIME or what a mission has instead where None.
    gain
        Electrons in a count, for an image in counts.
    saturation_e_s
        Rate [e-/s] from which on a pixel is saturated: it and its neighbours become invalid.
    sky_rms_e_s
        Noise of the empty sky, where it is known better than the image tells: a noise map is made with it.
    good_bits
        Bits of flags that do no harm, by value or name; those of the mission where None.
    center, size
        Cut out a square of ``size`` [arcsec] about (RA, Dec), or about the middle.
    extension
        Name or number of the image's plane, where the file has several.
    recentre_psf, normalise_psf, mend_psf
        What may be done to the PSF; see :func:`~engine.imaging.external.observation_from_arrays`.
    psf_oversampling
        How many times as finely as the image the PSF is sampled; where None what its own pixel scale says, or once.
    trust_options
        Go on where what is given and what the files say exclude each other, or a file cannot be what it is given for.

    Raises
    ------
    ObservationError
        It names the file and what is wrong with it.
    SpecError
        An option is none, or does not go with another.
    OSError
        A file cannot be read.
    """
    given = Given(pixel_scale, zero_point, unit, exposure_s, gain, saturation_e_s, sky_rms_e_s)
    if noise is not None and sky_rms_e_s is not None:
        raise SpecError("sky_rms_e_s", sky_rms_e_s, "none beside a noise map, which has it already")
    if center is not None and size is None:
        raise SpecError("size", None, "the side of the cutout in arcsec, where its center is given")
    found = Findings(trust_options)
    made = noise is None
    science = _science(
        image,
        given,
        found,
        center=center,
        size=size,
        extension=extension,
        good_bits=good_bits,
        made=made,
        dq=dq is None,
    )
    sigma: FloatArray | NoiseFromImage
    if noise is not None:
        sigma = _noise_map(noise, science, given, found)
    else:
        sigma = _made_noise(science, given, found) if science.noise is None else science.noise
    stamp, stated = _psf(psf, science, psf_oversampling, found)
    usable = [] if science.good is None else [science.good]
    roles: tuple[tuple[str | Path | None, Literal["valid", "dq"]], ...] = ((mask, "valid"), (dq, "dq"))
    usable += [_usable(path, role, science, good_bits, found) for path, role in roles if path is not None]
    files = {"image": image, "psf": psf, "noise": noise, "valid": mask, "dq": dq}
    record = {f"{role}_file": Path(path).name for role, path in files.items() if path} | recorded(found.readings)
    observed = partial(
        observation_from_arrays, science.values, sigma,
        pixel_scale=science.pixel_scale, zero_point=science.calibration.zero_point,
        recentre_psf=recentre_psf, normalise_psf=normalise_psf, mend_psf=mend_psf,
        valid=np.logical_and.reduce(usable) if usable else None, weight=science.weight,
        saturation=saturation_e_s, centre=science.centre, orientation=science.orientation,
    )  # fmt: skip
    try:
        seen = observed(psf=stamp, provenance=record, notes=tuple(found.notes))
        factor = None if stated else sampled_more_finely(seen, stamp)
        if factor is None:
            return seen
        found.note(
            f"psf: is taken for sampled {factor} times as finely as the image, whose stars are too sharp for it; "
            "--psf-oversampling says otherwise"
        )
        found.read("psf_oversampling", factor, "the point sources of the image")
        record |= recorded(found.readings)
        return observed(psf=binned(stamp, factor), provenance=record, notes=tuple(found.notes))
    except ObservationError as error:
        raise ObservationError(f"{files.get(str(error).partition(':')[0]) or image}: {error}") from error


def _science(
    path: str | Path,
    given: Given,
    found: Findings,
    *,
    center: tuple[str, str] | None,
    size: float | None,
    extension: str | int | None,
    good_bits: str | None,
    made: bool,
    dq: bool,
) -> _Science:
    """The image and what stands beside it; ``made``: no noise map is given, ``dq``: no flags are."""
    with opened(path) as hdus:
        plane = require_plane(hdus, path, "image", extension)
        if plane.others:
            found.note(f"image: {path} has {plane.others} more such planes; {plane.origin} is taken")
        world = _world(hdus, plane, given, found)
        where = None
        if size is not None:
            scale = _scale(plane, world, plane.shape, None, given, Findings(trusting=True))[0]
            where = cutout(world, plane.shape, center, size, scale)
        shape = plane.shape if where is None else (where[0].stop - where[0].start, where[1].stop - where[1].start)
        if max(shape) > MOST_PIXELS:
            raise ObservationError(
                f"image: {plane.origin} has {shape[1]} x {shape[0]} pixels, allowed are {MOST_PIXELS} along a side: "
                "cut the lens out by its center, RA and Dec, and a size in arcsec"
            )
        found.read("image", f"{shape[1]} x {shape[0]} pixels", plane.origin)
        scale, placement = _scale(plane, world, plane.shape, where, given, found)
        values = plane.values(where)
        error = companion(hdus, path, plane, "noise") if made and given.sky_rms_e_s is None else None
        weight = companion(hdus, path, plane, "weight")
        flags = companion(hdus, path, plane, "dq") if dq else None
        calibration = calibrate(plane.headers, given, scale, found, makes_noise=made and error is None)
        noise = None
        if error is not None:
            noise = error.values(where) * _noise_factor(error.headers, calibration, given, found)
            found.read("noise", "1 sigma", error.origin)
        weights = None if weight is None else weight.values(where)
        good = None if flags is None else usable_by_flags(flags.values(where), flags.headers, good_bits, found)
        if weight is not None and weights is not None:
            exposed = np.isfinite(weights) & (weights > 0)
            good = exposed if good is None else good & exposed
            found.read("weight", f"{np.count_nonzero(~exposed)} pixels without exposure", weight.origin)
        orientation = NORTH_UP if placement is None else placement.orientation
        return _Science(
            values * calibration.factor, plane.shape, where, plane.headers, scale, orientation,
            None if placement is None else placement.centre, calibration, noise, weights, good,
        )  # fmt: skip


def _world(hdus: fits.HDUList, plane: Plane, given: Given, found: Findings) -> World | None:
    """World coordinates; without them, where the pixel scale is given, a note if they are broken."""
    try:
        world = read_world(hdus, plane.headers)
        if world is not None:
            place(world, *_middle(plane.shape))
    except ObservationError as error:
        if given.pixel_scale is None:
            raise
        found.note(f"world coordinates: {error}; North is taken to be up, East to the left")
        return None
    found.notes.extend(() if world is None else world.notes)
    return world


def _middle(shape: tuple[int, int]) -> tuple[float, float]:
    """Row and column of the middle of an image."""
    return (shape[0] - 1) / 2.0, (shape[1] - 1) / 2.0


def _scale(
    plane: Plane, world: World | None, whole: tuple[int, int], where: Slices | None, given: Given, found: Findings
) -> tuple[float, Placement | None]:
    """The pixel scale [arcsec], and how the middle of what is used lies on the sky, where that is known."""
    rows, columns = where or (slice(0, whole[0]), slice(0, whole[1]))
    middle = (rows.start + rows.stop - 1) / 2.0, (columns.start + columns.stop - 1) / 2.0
    placement = None if world is None else place(world, *middle)
    if placement is None:
        keyword = plane.headers.number(*_SCALE_KEYWORDS)
        if given.pixel_scale is None and keyword is None:
            raise ObservationError(f"{plane.origin}: has no celestial coordinates, so pixel_scale must be given")
        scale, origin = (given.pixel_scale, "--pixel-scale") if given.pixel_scale else keyword or (math.nan, "")
        found.read("north", 0.0, "assumed: there are no world coordinates")
        found.read("east", "left of North", "assumed: there are no world coordinates")
    else:
        scale, origin = placement.pixel_scale, f"world coordinates of {plane.origin}"
        found.notes.extend(placement.notes)
        if given.pixel_scale is not None:
            if abs(given.pixel_scale / scale - 1.0) > _SCALE_AGREES:
                found.contradict(f"pixel_scale: {given.pixel_scale:g} arcsec is given, {origin} say {scale:.5g}")
            scale, origin = given.pixel_scale, "--pixel-scale"
        standing = placement.orientation
        found.read("north", math.remainder(math.degrees(standing.north) - 90.0, 360.0), f"{plane.origin}, from up")
        found.read("east", f"{'right' if standing.mirrored else 'left'} of North", plane.origin)
        found.read("centre", "{:.6f} {:+.6f}".format(*placement.centre), plane.origin)
    if not (math.isfinite(scale) and scale > 0):
        raise ObservationError(f"pixel_scale: got {scale} ({origin}), allowed is a positive number of arcsec")
    found.read("pixel_scale", float(scale), origin)
    return float(scale), placement


def _noise_map(path: str | Path, science: _Science, given: Given, found: Findings) -> FloatArray:
    """A noise map [e-/s] of a file of its own; an image that is given for one is refused."""
    with opened(path) as hdus:
        plane = require_plane(hdus, path, "noise")
        values = science.part(plane)
        sigma = np.asarray(values * _noise_factor(plane.headers, science.calibration, given, found))
    negative = float(np.mean(values < 0))
    if negative > _MOST_NEGATIVE:
        found.contradict(f"{plane.origin}: noise: {negative:.0%} is negative, allowed is 1 sigma: is it an image?")
    if same_picture(science.values, sigma):
        found.contradict(f"{plane.origin}: noise: is the image itself")
    found.read("noise", "1 sigma", plane.origin)
    return sigma


def _noise_factor(headers: Headers, calibration: Calibration, given: Given, found: Findings) -> float:
    """What makes e-/s of a noise map, by its own BUNIT; the image's factor where it has none, or the unit is given."""
    stated = headers.own.get("BUNIT")
    if given.unit is not None or not isinstance(stated, str) or not stated.strip():
        return calibration.factor
    own, seconds = unit_of(stated, f"BUNIT of {headers.origin}"), calibration.exposure_s
    if own.is_equivalent(calibration.unit):
        return calibration.factor * float(own.to(calibration.unit))
    for power in (1, -1):
        # A map of all the light beside an image of the light in a second, or the other way round.
        if seconds is not None and (own / units.s**power).is_equivalent(calibration.unit):
            return calibration.factor * float((own / units.s**power).to(calibration.unit)) * seconds**-power
    found.contradict(f"{headers.origin}: noise: is in {stated}, the image in {calibration.unit}")
    return calibration.factor


def _made_noise(science: _Science, given: Given, found: Findings) -> NoiseFromImage:
    """How a noise map is made from the image, and from its weights where it has some."""
    calibration = science.calibration
    if not calibration.electrons or calibration.exposure_s is None:
        raise ObservationError(
            f"{science.headers.origin}: has no ERR, and no noise map is made from {calibration.unit} without PHOTMJSR, "
            "gain and exposure_s: noise must be given"
        )
    origin = science.headers.origin
    correlation = _correlation(science.headers, science.pixel_scale, found)
    what = "made from the image" if science.weight is None else "made from the image and its weights"
    found.read("noise", what, origin)
    return NoiseFromImage(
        exposure_s=calibration.exposure_s, saturation=given.saturation_e_s, sky_rms=given.sky_rms_e_s,
        correlation=correlation,
    )  # fmt: skip


def _correlation(headers: Headers, pixel_scale: float, found: Findings) -> float:
    """By how much drizzle makes single pixels too quiet, by what AstroDrizzle or the JWST pipeline say they did."""
    pixfrac, native, ratio = (
        headers.number(*names) for names in (("D001PIXF", "PIXFRAC"), ("D001ISCL",), ("PXSCLRT",))
    )
    if pixfrac is None or not pixfrac[0] > 0 or (native is None and ratio is None):
        return 1.0
    scale_ratio = pixel_scale / native[0] if native is not None else (ratio or pixfrac)[0]
    factor = drizzle_correlation(pixfrac[0], scale_ratio)
    found.read("correlation", round(factor, 4), f"{pixfrac[1]}, pixels of {scale_ratio:.3f} native ones")
    return factor


def _psf(path: str | Path, science: _Science, oversampling: int | None, found: Findings) -> tuple[FloatArray, bool]:
    """The PSF's stamp on the image's pixels, and whether anything says how finely it is sampled.

    The image in its place, or pixels that do not fit the image's, are refused.
    """
    with opened(path) as hdus:
        plane = require_plane(hdus, path, "psf")
        if max(plane.shape) > MOST_PIXELS:
            found.contradict(f"{plane.origin}: psf: has {plane.shape[1]} x {plane.shape[0]} pixels, no stamp has")
        values = plane.values()
        stated = plane.headers.number(*_SCALE_KEYWORDS)
        if stated is None:
            try:
                world = read_world(hdus, plane.headers)
                stated = (
                    None
                    if world is None
                    else (place(world, *_middle(plane.shape)).pixel_scale, f"WCS of {plane.origin}")
                )
            except ObservationError:
                # A star's own coordinates are of no use but for this.
                stated = None
    if same_picture(science.values, values):
        found.contradict(f"{plane.origin}: psf: is the image itself")
    factor, origin = (1, "") if oversampling is None else (oversampling, "--psf-oversampling")
    if stated is not None and stated[0] > 0 and oversampling is None:
        factor, origin = max(1, round(science.pixel_scale / stated[0])), stated[1]
    if stated is not None and abs(factor * stated[0] / science.pixel_scale - 1.0) > _PSF_SCALE_AGREES:
        found.contradict(f"psf: {stated[1]} says {stated[0]:.4g} arcsec a pixel, the image {science.pixel_scale:.4g}")
    found.read("psf", f"{plane.shape[1]} x {plane.shape[0]} pixels", plane.origin)
    if factor != 1:
        if not np.isfinite(values).all():
            raise ObservationError(f"{plane.origin}: psf: not finite everywhere")
        found.read("psf_oversampling", factor, origin)
    return binned(values, factor), stated is not None or oversampling is not None


def _usable(
    path: str | Path, role: Literal["valid", "dq"], science: _Science, good_bits: str | None, found: Findings
) -> NDArray[np.bool_]:
    """Pixels (ny, nx) that a mask, or flags, allow."""
    with opened(path) as hdus:
        plane = require_plane(hdus, path, role)
        values = science.part(plane)
    if values.shape != science.values.shape:
        raise ObservationError(
            f"{path}: {role}: got shape {values.shape}, allowed is the image's {science.values.shape}"
        )
    if role == "valid":
        return usable_by_mask(values, plane.origin, found)
    return usable_by_flags(values, plane.headers, good_bits, found)
