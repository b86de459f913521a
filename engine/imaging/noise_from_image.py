"""A noise map from the image itself: what its empty sky scatters by, the Poisson noise above it, and its weights."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from astropy.stats import sigma_clip
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass as validated_dataclass
from scipy import ndimage

from engine.conventions import FloatArray
from engine.errors import ObservationError

_CLIP_SIGMA = 3.0
_SKY_WINDOW = 11
_FAINTEST_PERCENT = 25.0
_SMALLEST_SKY = 400
_LIKE_AN_EXPOSURE = (0.05, 1.2)
"""Median weight over the exposure time between which a weight is taken for an exposure time [s]."""


@validated_dataclass(frozen=True, config=ConfigDict(extra="forbid", allow_inf_nan=False))
class NoiseFromImage:
    """How to make a noise map for an image that comes without one.

    variance = (correlation sky_rms)^2 / w + max(image - sky, 0) / (gain exposure_s w) for an image in counts per
    second, sky and sky_rms measured where the image is faintest, w the relative weight of a pixel, one without weights.

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
    correlation
        By how much the scatter of single pixels understates the noise of many, which drizzle has made to share it
        (:func:`drizzle_correlation`).
    """

    exposure_s: Annotated[float, Field(gt=0.0)]
    gain: Annotated[float, Field(gt=0.0)] = 1.0
    saturation: float | None = None
    sky_rms: Annotated[float, Field(gt=0.0)] | None = None
    correlation: Annotated[float, Field(ge=1.0)] = 1.0


@dataclass(frozen=True, eq=False)
class NoiseEstimate:
    """A noise map made from the image: 1 sigma, the sky's level and rms [image units], saturated pixels."""

    sigma: FloatArray
    sky: float
    sky_rms: float
    saturated: NDArray[np.bool_]


def drizzle_correlation(pixfrac: float, scale_ratio: float) -> float:
    """Noise of many drizzled pixels over what the scatter of single ones says: Fruchter and Hook (2002), eqs. 9 and 10.

    ``scale_ratio`` is the side of an output pixel in native ones. r = pixfrac / scale_ratio; R = r / (1 - 1 / (3 r))
    for r above one, else 1 / (1 - r / 3).
    """
    for name, value in (("pixfrac", pixfrac), ("scale_ratio", scale_ratio)):
        if not (math.isfinite(value) and value > 0):
            raise ObservationError(f"{name}: got {value}, allowed is a positive number")
    r = pixfrac / scale_ratio
    return r / (1.0 - 1.0 / (3.0 * r)) if r > 1.0 else 1.0 / (1.0 - r / 3.0)


def saturated_pixels(image: FloatArray, level: float | None) -> NDArray[np.bool_]:
    """Pixels (ny, nx) at ``level`` or above, and their eight neighbours; none where it is None."""
    bright = np.zeros(image.shape, dtype=bool) if level is None else np.isfinite(image) & (image >= level)
    return np.asarray(ndimage.binary_dilation(bright, np.ones((3, 3), dtype=bool)) if bright.any() else bright)


def noise_from_image(image: FloatArray, how: NoiseFromImage, weight: FloatArray | None = None) -> NoiseEstimate:
    """A noise map from the image itself: noise of the sky, and the Poisson noise of what stands above it.

    A cutout of a lens has no empty sky: clipping alone takes the wings of the deflector for noise, three to eight
    times too much. So what varies smoothly, the median over 11 x 11 pixels, is taken off first; the rest is measured
    in the quarter of the image where that median is faintest, clipped at 3 sigma. Neighbouring pixels of a drizzled
    image share noise, which is what a single pixel's variance is, and stays.

    Pixels that are exactly zero or not finite hold no data (drizzle leaves zeros where nothing was exposed) and are
    not part of the sky; nor are saturated ones.

    ``weight`` (ny, nx) is proportional to a pixel's exposure, or to the inverse variance of its sky. Where it looks
    like an exposure time itself, it is the exposure; elsewhere ``how.exposure_s`` is that of the largest weight. Sigma
    is infinite where it is not positive.
    """
    finite = np.isfinite(image)
    if weight is not None:
        finite &= np.isfinite(weight) & (weight > 0)
    saturated = saturated_pixels(image, how.saturation)
    usable = finite & (image != 0) & ~saturated
    if np.count_nonzero(usable) < _SMALLEST_SKY:
        raise ObservationError(f"image: got {np.count_nonzero(usable)} pixels with data, its sky needs {_SMALLEST_SKY}")
    smooth = ndimage.median_filter(np.where(finite, image, 0.0), _SKY_WINDOW)
    faint = usable & (smooth <= np.percentile(smooth[usable], _FAINTEST_PERCENT))
    sky = float(np.median(smooth[faint]))
    relative, exposure = _exposures(image.shape, weight, usable, how.exposure_s)
    rms = how.sky_rms or _clipped_rms(((image - smooth) * np.sqrt(relative))[faint])
    signal = np.maximum(np.where(finite, image, 0.0) - sky, 0.0)
    variance = np.full(image.shape, np.inf)
    known = finite if weight is not None else np.ones(image.shape, dtype=bool)
    background = (how.correlation * rms) ** 2 / relative
    variance[known] = (background + signal / (how.gain * exposure))[known]
    return NoiseEstimate(np.sqrt(variance), sky, rms, saturated)


def _exposures(
    shape: tuple[int, ...], weight: FloatArray | None, usable: NDArray[np.bool_], exposure_s: float
) -> tuple[FloatArray, FloatArray]:
    """Weights (ny, nx) relative to their median, and exposure times [s]; ones where there is no weight."""
    if weight is None:
        return np.ones(shape), np.full(shape, exposure_s)
    known = np.where(np.isfinite(weight) & (weight > 0), weight, np.nan)
    middle = float(np.median(weight[usable]))
    low, high = _LIKE_AN_EXPOSURE
    scale = 1.0 if low < middle / exposure_s < high else exposure_s / float(np.nanmax(known))
    ones = np.isfinite(known)
    return np.where(ones, known / middle, 1.0), np.where(ones, scale * known, exposure_s)


def _clipped_rms(values: FloatArray) -> float:
    """Standard deviation after clipping at 3 sigma about the median until nothing more goes."""
    rms = float(sigma_clip(values, sigma=_CLIP_SIGMA, maxiters=None, masked=False).std())
    if not rms > 0:
        raise ObservationError(f"image: its sky has the rms {rms}, allowed is a positive one")
    return rms
