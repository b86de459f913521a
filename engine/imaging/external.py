"""Observations that somebody else made: arrays of any origin become an Observation like our own.

Pixels that cannot be used become invalid and are counted; the PSF is moved, scaled or mended on request alone; a noise
map that is missing can be made from the image (:mod:`.noise_from_image`). What was done stands in the provenance.
"""

from __future__ import annotations

import numpy as np
from astropy import units
from astropy.nddata import NDData, NDUncertainty
from numpy.typing import ArrayLike

from engine.conventions import NORTH_UP, FloatArray, Orientation
from engine.errors import ObservationError
from engine.imaging.containers import scalar, unpacked, usable
from engine.imaging.noise_from_image import NoiseFromImage, noise_from_image, saturated_pixels
from engine.imaging.observation import Observation, Provenance
from engine.imaging.psf_centre import PsfCentre, recentred_psf
from engine.imaging.psf_stamp import mended


def observation_from_arrays(
    image: ArrayLike | NDData,
    noise: ArrayLike | NDData | NDUncertainty | NoiseFromImage,
    psf: ArrayLike | NDData,
    pixel_scale: float | units.Quantity,
    zero_point: float | units.Quantity,
    *,
    recentre_psf: PsfCentre | None = None,
    normalise_psf: bool = False,
    mend_psf: bool = False,
    valid: ArrayLike | None = None,
    weight: ArrayLike | None = None,
    saturation: float | None = None,
    provenance: Provenance | None = None,
    centre: tuple[float, float] | None = None,
    orientation: Orientation = NORTH_UP,
    notes: tuple[str, ...] = (),
) -> Observation:
    """Make an Observation from arrays that somebody else made.

    Pixels whose noise is zero, negative, NaN or infinite, whose image is not finite, that are masked or saturated,
    become invalid (and hold 0 in the image and infinity in the noise map); the provenance counts each kind and says
    what was done to the PSF. Masks and units that arrays carry (masked arrays, CCDData, Quantities) count.

    Parameters
    ----------
    image
        (ny, nx) [e-/s per pixel].
    noise
        1 sigma, same shape; or how to make it from the image.
    psf
        PSF on the image's pixels, any shape where it is recentred, else an odd square.
    pixel_scale, zero_point
        [arcsec]; AB magnitude of 1 e-/s.
    recentre_psf
        ``pixel``: the brightest pixel goes to the middle, nothing is interpolated. ``peak``: the brightest point of
        the band-limited interpolation does. ``centroid``: the centre of light of the core does. In each case the
        stamp is padded with zeros to the odd square that loses nothing; even sides need one of them.
    normalise_psf, mend_psf
        Divide the PSF by its sum; take hot pixels and a pedestal out first (:func:`~engine.imaging.psf_stamp.mended`).
    valid
        Pixels that may be used, in addition to the rule above: where it is neither zero nor NaN.
    weight
        Of each pixel, for a noise map that is made (:func:`~engine.imaging.noise_from_image.noise_from_image`).
    saturation
        e-/s from which on a pixel is saturated, it and its neighbours.
    centre, orientation, notes
        As of the Observation.

    Raises
    ------
    ObservationError
        For shapes that do not fit, units that are others, a PSF that is not an odd square, and all that Observation
        refuses.
    """
    pixels, unmasked = unpacked("image", image)
    record: dict[str, str | float | int] = dict(provenance or {})
    saturated = saturated_pixels(pixels, saturation)
    if isinstance(noise, NoiseFromImage):
        weights = None if weight is None else unpacked("weight", weight, unit=None)[0]
        if weights is not None and weights.shape != pixels.shape:
            raise ObservationError(f"weight: got shape {weights.shape}, allowed is the image's {pixels.shape}")
        estimate = noise_from_image(np.where(unmasked, pixels, np.nan), noise, weights)
        sigma, saturated = np.array(estimate.sigma), saturated | estimate.saturated
        record |= {"noise_sky": estimate.sky, "noise_sky_rms": estimate.sky_rms}
        record |= {"noise_exposure_s": noise.exposure_s, "noise_gain": noise.gain}
        record |= {"noise_correlation": noise.correlation} if noise.correlation != 1.0 else {}
    else:
        sigma, with_noise = unpacked("noise", noise)
        if sigma.shape != pixels.shape:
            raise ObservationError(f"noise: got shape {sigma.shape}, allowed is the image's {pixels.shape}")
        unmasked = unmasked & with_noise
    reasons = {
        "image_not_finite": ~np.isfinite(pixels),
        "noise_not_finite": ~np.isfinite(sigma),
        "noise_not_positive": np.isfinite(sigma) & (sigma <= 0),
        "masked": ~unmasked,
        "saturated": saturated,
    }
    unusable = np.logical_or.reduce(list(reasons.values()))
    record |= {f"{name}_pixels": int(found.sum()) for name, found in reasons.items() if found.any()}
    if unusable.any():
        record["unusable_pixels"] = int(unusable.sum())
    pixels[unusable], sigma[unusable] = 0.0, np.inf
    allowed = ~unusable if valid is None else ~unusable & usable("valid", valid, pixels.shape)
    stamp, said = _stamp(psf, recentre_psf, record, normalise=normalise_psf, mend=mend_psf)
    return Observation(
        pixels, sigma, stamp, scalar("pixel_scale", pixel_scale, units.arcsec),
        scalar("zero_point", zero_point, units.ABmag), valid=allowed, provenance=record, centre=centre,
        orientation=orientation, notes=(*notes, *said),
    )  # fmt: skip


def _stamp(
    psf: ArrayLike | NDData,
    about: PsfCentre | None,
    record: dict[str, str | float | int],
    *,
    normalise: bool,
    mend: bool,
) -> tuple[FloatArray, tuple[str, ...]]:
    """The PSF as it is wanted, and what was wrong with it; ``record`` is told what was done."""
    stamp, unmasked = unpacked("psf", psf, unit=None if normalise else units.dimensionless_unscaled)
    if not unmasked.all():
        raise ObservationError(f"psf: got {np.count_nonzero(~unmasked)} masked pixels, allowed is a whole stamp")
    stamp, said = mended(stamp) if mend else (stamp, ())
    if about is not None:
        stamp, found_at = recentred_psf(stamp, about)
        record["psf_centre"] = about
        record["psf_centre_was_at_row"], record["psf_centre_was_at_column"] = found_at
    if normalise:
        total = float(stamp.sum())
        if not (np.isfinite(total) and total > 0):
            raise ObservationError(f"psf: got the sum {total}, allowed is a positive one")
        record["psf_divided_by"] = total
        stamp = stamp / total
    return stamp, said
