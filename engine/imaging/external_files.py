"""Observations from anybody's FITS files: an image, a PSF, and a noise map or what is needed to make one."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from astropy.io import fits
from astropy.wcs import WCS
from astropy.wcs.utils import proj_plane_pixel_scales

from engine.conventions import FloatArray
from engine.errors import ObservationError
from engine.imaging.external import NoiseFromImage, PsfCentre, observation_from_arrays
from engine.imaging.observation import Observation

ImageUnit = Literal["e-/s", "e-"]
_SQUARE = 1e-3


@dataclass(frozen=True, eq=False)
class ForeignImage:
    """A two-dimensional image of a FITS file [its own unit] and the header that stands with it."""

    values: FloatArray
    header: fits.Header


def read_external_observation(
    image: str | Path,
    psf: str | Path,
    *,
    zero_point: float,
    noise: str | Path | None = None,
    mask: str | Path | None = None,
    pixel_scale: float | None = None,
    unit: ImageUnit = "e-/s",
    exposure_s: float | None = None,
    gain: float = 1.0,
    saturation_e_s: float | None = None,
    sky_rms_e_s: float | None = None,
    recentre_psf: PsfCentre | None = None,
    normalise_psf: bool = False,
) -> Observation:
    """Read an observation that somebody else made; each file's first two-dimensional image is taken.

    Parameters
    ----------
    image, psf
        North up, East left; the PSF on the same pixels.
    zero_point
        AB magnitude of 1 e-/s.
    noise
        1 sigma map in the image's unit. Without one it is made from the image
        (:class:`~engine.imaging.external.NoiseFromImage`).
    mask
        Not zero where a pixel may be used; all where None.
    pixel_scale
        [arcsec]; the image's world coordinates are asked where None.
    unit
        Of the image and its noise map: electrons, or electrons per second.
    exposure_s
        Needed for electrons, and to make a noise map; EXPTIME of the image's header where None.
    gain
        Electrons per count, should the image be in counts after all.
    saturation_e_s
        Rate [e-/s] from which on a pixel is saturated: it and its neighbours become invalid. With no noise map only.
    sky_rms_e_s
        Noise of the empty sky, where it is known better than the image tells. With no noise map only.
    recentre_psf, normalise_psf
        What may be done to the PSF; see :func:`~engine.imaging.external.observation_from_arrays`.

    Raises
    ------
    ObservationError
        It names the file and what is wrong with it.
    OSError
        A file cannot be read.
    """
    files = {"image": image, "psf": psf, "noise": noise, "valid": mask}
    found = {role: read_image(path) for role, path in files.items() if path is not None}
    header = found["image"].header
    seconds = header.get("EXPTIME") if exposure_s is None else exposure_s
    if seconds is None and (noise is None or unit == "e-"):
        raise ObservationError(f"{image}: has no EXPTIME, so exposure_s must be given")
    if seconds is not None and not (math.isfinite(float(seconds)) and float(seconds) > 0):
        raise ObservationError(f"{image}: got an exposure of {seconds} s, allowed is a positive one")
    factor = gain if unit == "e-/s" or seconds is None else gain / float(seconds)
    if not (math.isfinite(factor) and factor > 0):
        raise ObservationError(f"gain: got {gain}, allowed is a positive number")
    scale = pixel_scale if pixel_scale is not None else _pixel_scale(image, header)
    sigma: FloatArray | NoiseFromImage
    if noise is not None:
        sigma = found["noise"].values * factor
    elif seconds is not None:
        sigma = NoiseFromImage(exposure_s=float(seconds), saturation=saturation_e_s, sky_rms=sky_rms_e_s)
    record: dict[str, str | float | int] = {f"{role}_file": Path(path).name for role, path in files.items() if path}
    record |= {"unit": unit, "gain": float(gain)} | ({} if seconds is None else {"exposure_s": float(seconds)})
    try:
        return observation_from_arrays(
            found["image"].values * factor,
            sigma,
            found["psf"].values,
            scale,
            zero_point,
            recentre_psf=recentre_psf,
            normalise_psf=normalise_psf,
            valid=None if mask is None else np.asarray(found["valid"].values != 0),
            provenance=record,
            centre=_centre(header, found["image"].values.shape),
        )
    except ObservationError as error:
        role = str(error).partition(":")[0]
        raise ObservationError(f"{files.get(role) or image}: {error}") from error


def read_image(path: str | Path) -> ForeignImage:
    """The first two-dimensional image in a FITS file of anybody's, as float64 in native byte order."""
    try:
        with fits.open(path, memmap=False) as hdus:
            for hdu in hdus:
                if getattr(hdu, "is_image", False) and hdu.data is not None and hdu.data.ndim == 2:
                    return ForeignImage(np.asarray(hdu.data, dtype=np.float64), hdu.header.copy())
    except FileNotFoundError:
        raise
    except (OSError, ValueError, TypeError, fits.VerifyError) as error:
        raise ObservationError(f"{path}: not a FITS file that can be read ({error})") from error
    raise ObservationError(f"{path}: holds no two-dimensional image")


def _pixel_scale(path: str | Path, header: fits.Header) -> float:
    world = WCS(header)
    if not world.has_celestial:
        raise ObservationError(f"{path}: has no celestial coordinates, so pixel_scale must be given")
    along_x, along_y = (float(scale) * 3600.0 for scale in proj_plane_pixel_scales(world.celestial))
    if abs(along_x / along_y - 1.0) > _SQUARE:
        raise ObservationError(f"{path}: got pixels of {along_x} x {along_y} arcsec, allowed are square ones")
    return math.sqrt(along_x * along_y)


def _centre(header: fits.Header, shape: tuple[int, ...]) -> tuple[float, float] | None:
    world = WCS(header)
    if not world.has_celestial:
        return None
    middle = world.celestial.pixel_to_world((shape[1] - 1) / 2.0, (shape[0] - 1) / 2.0).icrs
    return float(middle.ra.deg) % 360.0, float(middle.dec.deg)
