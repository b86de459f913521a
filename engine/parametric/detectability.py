"""Whether an image shows anything that could be a lens, told in seconds before a fit that takes minutes.

Noise alone, one star, or one galaxy that a Sersic profile describes are no lens. Each is subtracted, and what is left
is looked at on the scale of the PSF and on larger ones. In doubt the image may be a lens: the fit will tell.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize

from engine.conventions import FloatArray, pixel_centres
from engine.imaging.observation import Observation
from engine.imaging.optics.stamp import StampOptics
from engine.imaging.psf_stamp import width
from engine.light.sersic import profile_of

_SCALES = (1.0, 2.0, 4.0)
"""Of what is looked for, in Gaussian widths of the PSF."""
_STANDS_OUT, _OF_MAP, _FAR_OUT_OF_MAP = 6.0, 3.0, 15.0
"""Sigma by the scatter of the image, which arcs that fill it raise, and by its noise map, which may be wrong."""
_STAR_ERROR, _MIRROR_ERROR, _GALAXY_ERROR = 0.05, 0.1, 0.005
"""Fractions of the light by which a moved star, a mirrored galaxy and a Sersic profile may be off."""
_WINDOW = 40
"""Pixels on either side of the peak within which a star or a galaxy is fitted."""
_EVALUATIONS = 15
_FEWEST_TELLING = 400
_TO_SIGMA = 1.4826
_LOW, _HIGH = np.array([math.log(0.02), 0.4, -0.7, -0.7]), np.array([math.log(20.0), 8.0, 0.7, 0.7])


@dataclass(frozen=True, eq=False)
class _Seen:
    """Pixels less the sky, their variance, which of them count, and what light becomes on them."""

    image: FloatArray
    variance: FloatArray
    valid: NDArray[np.bool_]
    optics: StampOptics


def why_no_lens(observation: Observation) -> str | None:
    """What the image shows instead of a lens; None where it may be one."""
    valid = observation.valid
    sky = float(np.median(observation.image[valid]))
    image = np.where(valid, observation.image - sky, 0.0)
    optics = StampOptics(observation.psf, observation.shape, observation.pixel_scale)
    whole = _Seen(image, np.where(valid, observation.noise, 1.0) ** 2, valid, optics)
    sigma = max(1.0, width(observation.psf) / 2.3548)
    if not _stands_out(image, whole, 0.0, sigma):
        return "nothing stands out of its noise"
    part, offset = _window(whole)
    star, rest = _scaled(whole, optics.point_source(*(_star(part) + offset)))
    if not _stands_out(rest, whole, (_STAR_ERROR * star) ** 2, sigma):
        return "one point source is all that stands out of its noise"
    mirrored = _mirrored(part.image)
    off = np.abs(part.image) + np.abs(mirrored)
    # A galaxy is fitted only where what is seen has its symmetry: fits take seconds.
    difference = replace(part, variance=2.0 * part.variance)
    if not _stands_out(part.image - mirrored, difference, (_MIRROR_ERROR * off) ** 2, sigma):
        shape = _galaxy(part) + np.concatenate([np.zeros(4), offset])
        galaxy, rest = _scaled(whole, optics.sersic_image(profile_of(shape)))
        if not _stands_out(rest, whole, (_GALAXY_ERROR * galaxy) ** 2, sigma):
            return "one galaxy is all that stands out of its noise, and a Sersic profile describes it: there is no arc"
    return None


def _stands_out(residual: FloatArray, seen: _Seen, error: FloatArray | float, sigma: float) -> bool:
    """Whether some light (ny, nx) exceeds its noise, and the variance ``error`` of what was taken off, on any scale."""
    valid = seen.valid
    z = residual / np.sqrt(seen.variance + error)
    z = np.where(valid, z - np.median(z[valid]), 0.0)
    # Where the error of what was taken off is most of the variance, the scatter is less than it.
    noisy = valid & (error < seen.variance)
    telling = noisy if np.count_nonzero(noisy) > _FEWEST_TELLING else valid
    for scale in _SCALES:
        smooth = ndimage.gaussian_filter(z, scale * sigma, mode="constant")
        level = float(np.median(smooth[telling]))
        highest = float(smooth[valid].max()) - level
        by_scatter = highest / max(_TO_SIGMA * float(np.median(np.abs(smooth[telling] - level))), 1e-300)
        by_map = highest * 2.0 * math.sqrt(math.pi) * scale * sigma
        if (by_scatter > _STANDS_OUT and by_map > _OF_MAP) or by_map > _FAR_OUT_OF_MAP:
            return True
    return False


def _window(whole: _Seen) -> tuple[_Seen, FloatArray]:
    """What is seen round the brightest peak, and where its middle is in the whole [arcsec]."""
    row, column = _brightest(whole.image)
    rows, columns = (slice(max(0, k - _WINDOW), k + _WINDOW + 1) for k in (row, column))
    image, (ny, nx) = whole.image[rows, columns], whole.image.shape
    optics = StampOptics(whole.optics.psf, (image.shape[0], image.shape[1]), whole.optics.pixel_scale)
    middle = np.array(
        [columns.start + (image.shape[1] - 1) / 2 - (nx - 1) / 2, rows.start + (image.shape[0] - 1) / 2 - (ny - 1) / 2]
    )
    part = _Seen(image, whole.variance[rows, columns], whole.valid[rows, columns], optics)
    return part, middle * whole.optics.pixel_scale


def _brightest(image: FloatArray) -> tuple[int, int]:
    """Row and column of the brightest pixel of the image smoothed by a pixel."""
    smooth = ndimage.gaussian_filter(image, 1.0, mode="constant")
    row, column = np.unravel_index(int(np.argmax(smooth)), image.shape)
    return int(row), int(column)


def _peak(seen: _Seen) -> tuple[float, float]:
    """(x, y) [arcsec] of the brightest peak: the centroid of the smoothed 3 x 3 pixels round it."""
    smooth = ndimage.gaussian_filter(seen.image, 1.0, mode="constant")
    row, column = _brightest(seen.image)
    ny, nx = smooth.shape
    rows, columns = slice(max(0, row - 2), row + 3), slice(max(0, column - 2), column + 3)
    core = np.maximum(smooth[rows, columns] - smooth[rows, columns].min(), 0.0)
    y, x = np.mgrid[rows, columns][:, : core.shape[0], : core.shape[1]]
    scale, total = seen.optics.pixel_scale, float(core.sum()) or 1.0
    return (float((core * x).sum()) / total - (nx - 1) / 2.0) * scale, (
        float((core * y).sum()) / total - (ny - 1) / 2.0
    ) * scale


def _scaled(seen: _Seen, shape: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The light of a shape that comes closest to the image beside a constant, and what both leave."""
    weight = np.where(seen.valid, 1.0 / seen.variance, 0.0)
    one, both, square = float(weight.sum()), float((weight * shape).sum()), float((weight * shape**2).sum())
    data, along = float((weight * seen.image).sum()), float((weight * shape * seen.image).sum())
    determinant = one * square - both**2
    light = np.zeros(shape.shape) if not determinant > 0 else (one * along - both * data) / determinant * shape
    return light, seen.image - light - (data - float((weight * light).sum())) / one


def _in_sigma(seen: _Seen, rest: FloatArray) -> FloatArray:
    return np.asarray((rest / np.sqrt(seen.variance))[seen.valid])


def _star(seen: _Seen) -> FloatArray:
    """Where the point source is (x, y) [arcsec] that comes closest to the image."""

    def light(position: FloatArray) -> tuple[FloatArray, FloatArray]:
        return _scaled(seen, seen.optics.point_source(float(position[0]), float(position[1])))

    start, reach = np.array(_peak(seen)), 2.0 * seen.optics.pixel_scale
    found = optimize.least_squares(
        lambda position: _in_sigma(seen, light(position)[1]), start, bounds=(start - reach, start + reach),
        max_nfev=_EVALUATIONS, x_scale=seen.optics.pixel_scale,
    )  # fmt: skip
    return np.asarray(found.x)


def _mirrored(image: FloatArray) -> FloatArray:
    """The image turned by 180 degrees about its brightest peak; itself where its mirror image is off the window."""
    smooth = ndimage.gaussian_filter(image, 1.0, mode="constant")
    row, column = _brightest(image)
    if not (0 < row < image.shape[0] - 1 and 0 < column < image.shape[1] - 1):
        return image
    shifts = []
    for at, before, here, after in (
        (row, smooth[row - 1, column], smooth[row, column], smooth[row + 1, column]),
        (column, smooth[row, column - 1], smooth[row, column], smooth[row, column + 1]),
    ):
        bend = float(before - 2.0 * here + after)
        shifts.append(at + (0.5 * float(before - after) / bend if bend < 0 else 0.0))
    ny, nx = image.shape
    turned = ndimage.shift(
        image[::-1, ::-1], (2.0 * shifts[0] - (ny - 1), 2.0 * shifts[1] - (nx - 1)), order=3, cval=np.nan
    )
    return np.where(np.isfinite(turned), turned, image)


def _galaxy(seen: _Seen) -> FloatArray:
    """The shape (6,) of the Sersic profile that comes closest to the image."""

    def light(shape: FloatArray) -> tuple[FloatArray, FloatArray]:
        return _scaled(seen, seen.optics.sersic_image(profile_of(shape)))

    x, y = _peak(seen)
    reach = 2.0 * seen.optics.pixel_scale
    low, high = np.concatenate([_LOW, [x - reach, y - reach]]), np.concatenate([_HIGH, [x + reach, y + reach]])
    start = np.array([math.log(_half_light_radius(seen, x, y)), 2.0, 0.0, 0.0, x, y])
    found = optimize.least_squares(
        lambda shape: _in_sigma(seen, light(shape)[1]), np.clip(start, low + 1e-6, high - 1e-6), bounds=(low, high),
        max_nfev=_EVALUATIONS, x_scale=np.array([0.3, 0.5, 0.1, 0.1, 0.02, 0.02]),
    )  # fmt: skip
    return np.asarray(found.x)


def _half_light_radius(seen: _Seen, x: float, y: float) -> float:
    """Radius [arcsec] within which half of the positive light is."""
    ny, nx = seen.image.shape
    scale = seen.optics.pixel_scale
    r = np.hypot(pixel_centres(nx, scale)[None, :] - x, pixel_centres(ny, scale)[:, None] - y).ravel()
    order = np.argsort(r)
    grown = np.cumsum(np.maximum(seen.image.ravel()[order] - np.sqrt(seen.variance.ravel()[order]), 0.0))
    return max(float(r[order][np.searchsorted(grown, 0.5 * grown[-1])]), scale)
