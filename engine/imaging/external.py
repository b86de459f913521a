"""Observations that somebody else made: arrays of any origin become an Observation like our own.

Pixels that cannot be used become invalid and are counted; the PSF is moved or scaled on request alone; a noise map
that is missing can be made from the image. What was done stands in the provenance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from astropy.stats import sigma_clip
from numpy.typing import ArrayLike, NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass as validated_dataclass
from scipy import fft, ndimage

from engine.conventions import FloatArray
from engine.errors import ObservationError
from engine.imaging.observation import Observation, Provenance, image_array

PsfCentre = Literal["pixel", "peak", "centroid"]
_CLIP_SIGMA = 3.0
_SKY_WINDOW = 11
_FAINTEST_PERCENT = 25.0
_SMALLEST_SKY = 400
_PEAK_TOLERANCE = 1e-9
_CENTROID_WIDTHS = 2.0
_MOVE_STEPS = 100


@validated_dataclass(frozen=True, config=ConfigDict(extra="forbid", allow_inf_nan=False))
class NoiseFromImage:
    """How to make a noise map for an image that comes without one.

    variance = sky_rms^2 + max(image - sky, 0) / (gain exposure_s) for an image in counts per second, sky and sky_rms
    measured where the image is faintest.

    Attributes
    ----------
    exposure_s
        Total exposure time behind a pixel [s].
    gain
        Electrons per count of the image.
    saturation
        Count rate [image units] from which on a pixel is saturated; such pixels and their eight neighbours become
        invalid. None where nothing is.
    sky_rms
        Noise of the empty sky [image units], where it is known better than the image tells.
    """

    exposure_s: Annotated[float, Field(gt=0.0)]
    gain: Annotated[float, Field(gt=0.0)] = 1.0
    saturation: float | None = None
    sky_rms: Annotated[float, Field(gt=0.0)] | None = None


@dataclass(frozen=True, eq=False)
class NoiseEstimate:
    """A noise map made from the image: 1 sigma, the sky's level and rms [image units], saturated pixels."""

    sigma: FloatArray
    sky: float
    sky_rms: float
    saturated: NDArray[np.bool_]


def observation_from_arrays(
    image: ArrayLike,
    noise: ArrayLike | NoiseFromImage,
    psf: ArrayLike,
    pixel_scale: float,
    zero_point: float,
    *,
    recentre_psf: PsfCentre | None = None,
    normalise_psf: bool = False,
    valid: NDArray[np.bool_] | None = None,
    provenance: Provenance | None = None,
    centre: tuple[float, float] | None = None,
) -> Observation:
    """Make an Observation from arrays that somebody else made.

    Pixels whose noise is zero, negative, NaN or infinite, whose image is not finite, or that are saturated, become
    invalid (and hold 0 in the image and infinity in the noise map); the provenance counts each kind and says what was
    done to the PSF.

    Parameters
    ----------
    image
        (ny, nx) [e-/s per pixel], North up, East left.
    noise
        1 sigma, same shape; or how to make it from the image.
    psf
        PSF on the image's pixels, any shape where it is recentred, else an odd square.
    recentre_psf
        ``pixel``: the brightest pixel goes to the middle, nothing is interpolated. ``peak``: the brightest point of
        the band-limited interpolation does. ``centroid``: the centre of light of the core does. In each case the
        stamp is padded with zeros to the odd square that loses nothing; even sides need one of them.
    normalise_psf
        Divide the PSF by its sum.
    valid
        Pixels that may be used, in addition to the rule above.

    Raises
    ------
    ObservationError
        For shapes that do not fit, a PSF that is not an odd square, and all that Observation refuses.
    """
    pixels, stamp = (np.array(image_array(name, values)) for name, values in (("image", image), ("psf", psf)))
    record: dict[str, str | float | int] = dict(provenance or {})
    saturated = np.zeros(pixels.shape, dtype=bool)
    if isinstance(noise, NoiseFromImage):
        estimate = noise_from_image(pixels, noise)
        sigma, saturated = np.array(estimate.sigma), estimate.saturated
        record |= {"noise_sky": estimate.sky, "noise_sky_rms": estimate.sky_rms}
        record |= {"noise_exposure_s": noise.exposure_s, "noise_gain": noise.gain}
    else:
        sigma = np.array(image_array("noise", noise))
    if sigma.shape != pixels.shape:
        raise ObservationError(f"noise: got shape {sigma.shape}, allowed is the image's {pixels.shape}")
    if valid is not None and np.shape(valid) != pixels.shape:
        raise ObservationError(f"valid: got shape {np.shape(valid)}, allowed is the image's {pixels.shape}")
    reasons = {
        "image_not_finite": ~np.isfinite(pixels),
        "noise_not_finite": ~np.isfinite(sigma),
        "noise_not_positive": np.isfinite(sigma) & (sigma <= 0),
        "saturated": saturated,
    }
    unusable = np.logical_or.reduce(list(reasons.values()))
    record |= {f"{name}_pixels": int(found.sum()) for name, found in reasons.items() if found.any()}
    if unusable.any():
        record["unusable_pixels"] = int(unusable.sum())
    pixels[unusable], sigma[unusable] = 0.0, np.inf
    if recentre_psf is not None:
        stamp, found_at = recentred_psf(stamp, recentre_psf)
        record["psf_centre"] = recentre_psf
        record["psf_centre_was_at_row"], record["psf_centre_was_at_column"] = found_at
    if normalise_psf:
        total = float(stamp.sum())
        if not (np.isfinite(total) and total > 0):
            raise ObservationError(f"psf: got the sum {total}, allowed is a positive one")
        record["psf_divided_by"] = total
        stamp = stamp / total
    allowed = ~unusable if valid is None else ~unusable & np.asarray(valid, dtype=bool)
    return Observation(pixels, sigma, stamp, pixel_scale, zero_point, valid=allowed, provenance=record, centre=centre)


def noise_from_image(image: FloatArray, how: NoiseFromImage) -> NoiseEstimate:
    """A noise map from the image itself: noise of the sky, and the Poisson noise of what stands above it.

    A cutout of a lens has no empty sky: clipping alone takes the wings of the deflector for noise, three to eight
    times too much. So what varies smoothly, the median over 11 x 11 pixels, is taken off first; the rest is measured
    in the quarter of the image where that median is faintest, clipped at 3 sigma. Neighbouring pixels of a drizzled
    image share noise, which is what a single pixel's variance is, and stays.

    Pixels that are exactly zero or not finite hold no data (drizzle leaves zeros where nothing was exposed) and are
    not part of the sky; nor are saturated ones.
    """
    finite = np.isfinite(image)
    saturated = np.zeros(image.shape, dtype=bool)
    if how.saturation is not None:
        bright = finite & (np.where(finite, image, 0.0) >= how.saturation)
        saturated = ndimage.binary_dilation(bright, np.ones((3, 3), dtype=bool)) if bright.any() else bright
    usable = finite & (image != 0) & ~saturated
    if np.count_nonzero(usable) < _SMALLEST_SKY:
        raise ObservationError(f"image: got {np.count_nonzero(usable)} pixels with data, its sky needs {_SMALLEST_SKY}")
    smooth = ndimage.median_filter(np.where(finite, image, 0.0), _SKY_WINDOW)
    faint = usable & (smooth <= np.percentile(smooth[usable], _FAINTEST_PERCENT))
    sky = float(np.median(smooth[faint]))
    rms = how.sky_rms or _clipped_rms((image - smooth)[faint])
    signal = np.maximum(np.where(finite, image, 0.0) - sky, 0.0)
    return NoiseEstimate(np.sqrt(rms**2 + signal / (how.gain * how.exposure_s)), sky, rms, saturated)


def _clipped_rms(values: FloatArray) -> float:
    """Standard deviation after clipping at 3 sigma about the median until nothing more goes."""
    rms = float(sigma_clip(values, sigma=_CLIP_SIGMA, maxiters=None, masked=False).std())
    if not rms > 0:
        raise ObservationError(f"image: its sky has the rms {rms}, allowed is a positive one")
    return rms


def recentred_psf(psf: FloatArray, about: PsfCentre) -> tuple[FloatArray, tuple[float, float]]:
    """The PSF on the smallest odd square about its centre that loses nothing, and where the centre was (row, column).

    Whole pixels are moved by padding, the rest by a phase in Fourier space: exact for a band-limited PSF, and the sum
    stays. A stamp that is cut off rings at its edge by what the cut leaves there.
    """
    if not np.isfinite(psf).all():
        raise ObservationError("psf: not finite everywhere, so it has no centre")
    peak = np.unravel_index(int(np.argmax(psf)), psf.shape)
    row, column = int(peak[0]), int(peak[1])
    centred = _padded_about(psf, row, column)
    if about == "pixel":
        return centred, (row, column)
    dy, dx = _peak_offset(centred) if about == "peak" else _centroid_offset(centred)
    # A centre beyond half a pixel (the centroid of a lopsided core) is met by whole pixels first.
    whole_y, whole_x = round(dy), round(dx)
    if whole_y or whole_x:
        centred = _padded_about(psf, row + whole_y, column + whole_x)
    return _shifted(centred, whole_y - dy, whole_x - dx), (row + dy, column + dx)


def _padded_about(psf: FloatArray, row: int, column: int) -> FloatArray:
    ny, nx = psf.shape
    half = max(row, ny - 1 - row, column, nx - 1 - column)
    centred = np.zeros((2 * half + 1, 2 * half + 1))
    centred[half - row : half - row + ny, half - column : half - column + nx] = psf
    return centred


def _shifted(stamp: FloatArray, dy: float, dx: float) -> FloatArray:
    """Move an odd square by a sub-pixel shift; odd sides have no Nyquist term, so that no light is lost."""
    n = stamp.shape[0]
    phase = np.exp(-2j * np.pi * fft.fftfreq(n) * dy)[:, None] * np.exp(-2j * np.pi * fft.rfftfreq(n) * dx)
    return np.asarray(fft.irfft2(fft.rfft2(stamp) * phase, (n, n)))


def _peak_offset(stamp: FloatArray) -> tuple[float, float]:
    """Offset (y, x) of the maximum of the band-limited interpolation from the middle pixel, by Newton's method."""
    n = stamp.shape[0]
    frequency = 2j * np.pi * fft.fftfreq(n)
    spectrum = fft.fft2(fft.ifftshift(stamp))
    y = x = 0.0
    for _ in range(_MOVE_STEPS):
        along_y, along_x = np.exp(frequency * y), np.exp(frequency * x)
        derivative = [
            [float(np.real((frequency**i * along_y) @ spectrum @ (frequency**j * along_x))) for j in range(3)]
            for i in range(3)
        ]
        gradient = np.array([derivative[1][0], derivative[0][1]])
        hessian = np.array([[derivative[2][0], derivative[1][1]], [derivative[1][1], derivative[0][2]]])
        if not np.all(np.linalg.eigvalsh(hessian) < 0):
            raise ObservationError("psf: its brightest pixel is no smooth maximum; recentre it by pixel or centroid")
        step = np.linalg.solve(hessian, gradient)
        y, x = y - float(step[0]), x - float(step[1])
        if max(abs(y), abs(x)) > 1.0:
            raise ObservationError("psf: no maximum within a pixel of its brightest one; recentre it by pixel")
        if np.abs(step).max() < _PEAK_TOLERANCE:
            return y, x
    raise ObservationError("psf: its maximum was not found; recentre it by pixel or centroid")


def _centroid_offset(stamp: FloatArray) -> tuple[float, float]:
    """Offset (y, x) of the core's centre of light from the middle pixel.

    The core is weighted by a Gaussian that follows the centre, so that neither the cut of the stamp nor its noise far
    out counts, as in the adaptive moments of weak lensing; for a symmetric PSF the weight does not move the centre.
    The weight is twice as wide as a Gaussian of the stamp's noise-equivalent area (sum P)^2 / sum P^2 = 4 pi sigma^2,
    which a shift does not change.
    """
    half = stamp.shape[0] // 2
    axis = np.arange(-half, half + 1, dtype=np.float64)
    power = float(np.sum(stamp**2))
    if not (power > 0 and stamp.sum() > 0):
        raise ObservationError(f"psf: got the sum {stamp.sum()}, allowed is a positive one")
    width = _CENTROID_WIDTHS * float(stamp.sum()) / math.sqrt(4.0 * math.pi * power)
    y = x = 0.0
    for _ in range(_MOVE_STEPS):
        weight = stamp * np.exp(-0.5 * np.add.outer((axis - y) ** 2, (axis - x) ** 2) / width**2)
        total = float(weight.sum())
        if not total > 0:
            raise ObservationError(f"psf: its core has the sum {total}, allowed is a positive one")
        step_y = float(weight.sum(axis=1) @ axis) / total - y
        step_x = float(weight.sum(axis=0) @ axis) / total - x
        y, x = y + step_y, x + step_x
        if max(abs(step_y), abs(step_x)) < _PEAK_TOLERANCE:
            return y, x
    raise ObservationError("psf: its centre of light was not found; recentre it by pixel")
