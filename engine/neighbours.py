"""What shines in an image besides the lens, found in what a fit leaves: subtracted if it is a star, masked if not."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from engine.conventions import FloatArray, pixel_centres
from engine.imaging.bad_pixels import lone_pixels
from engine.imaging.observation import Observation
from engine.parametric.fit import ParametricFit

_OUTSIDE = 1.7
"""Einstein radii from the lens from which on what stands out of a fit is no arc."""
_AGN_RADIUS = 5.0
"""Pixels round AGN images in which residuals are their stamps'."""
_STANDS_OUT, _SMOOTH = 8.0, 1.0
_MOST = 8
_STAR_CHI2 = 0.15
"""Part of the chi^2 of a blob that a star may leave of it."""
_GROWN = 3
_CORE = 4.0
_FIT_RADIUS = 6
_TRIALS = 5


def without_lone_pixels(observation: Observation) -> tuple[Observation, list[str]]:
    """The observation without pixels that no light made, and what is said of them."""
    bad = lone_pixels(observation)
    if not bad.any():
        return observation, []
    rows, columns = np.nonzero(bad)
    places = ", ".join(f"{column},{row}" for row, column in list(zip(rows, columns, strict=True))[:_MOST])
    count = int(bad.sum())
    return (
        replace(observation, valid=observation.valid & ~bad),
        [f"image: {count} lone pixel{'s' if count > 1 else ''} masked, sharper than any star (x,y from 0: {places})"],
    )


def without_neighbours(observation: Observation, fit: ParametricFit) -> tuple[Observation, list[str]]:
    """The observation less the stars and without the galaxies that a fit leaves outside the lens, and what is said.

    A star is subtracted and the error of its stamp becomes noise, its core apart, which is masked; of anything else all
    pixels that stand out are masked. Nothing is done where nothing stands out.
    """
    scale, (ny, nx) = observation.pixel_scale, observation.shape
    x, y = pixel_centres(nx, scale), pixel_centres(ny, scale)
    from_lens = np.hypot(y[:, None] - fit.lens.y, x[None, :] - fit.lens.x)
    looked_at = observation.valid & (from_lens > _OUTSIDE * fit.lens.theta_E)
    for found in fit.agn:
        looked_at &= np.hypot(y[:, None] - found.y, x[None, :] - found.x) > _AGN_RADIUS * scale
    image, noise, valid = observation.image.copy(), observation.noise.copy(), observation.valid.copy()
    rest = np.where(valid, image - fit.model, 0.0)
    told: list[str] = []
    for _ in range(_MOST):
        peak, blob = _brightest(rest, noise, looked_at & valid)
        if peak is None:
            break
        at = tuple(round(float(axis[k]), 2) for axis, k in zip((x, y), reversed(peak), strict=True))
        star = _star(observation, rest, noise, peak)
        if star is not None:
            image, rest = image - star, rest - star
            noise = np.sqrt(noise**2 + observation.optics.agn_variance(star))
            near = np.hypot(y[:, None] - y[peak[0]], x[None, :] - x[peak[1]]) < _CORE * scale
            valid &= ~near
            told.append(f"image: a star at {at[0]:g},{at[1]:g} arcsec was subtracted")
        else:
            valid &= ~blob
            told.append(f"image: {int(blob.sum())} pixels of a neighbour at {at[0]:g},{at[1]:g} arcsec were masked")
    if not told:
        return observation, []
    return replace(observation, image=image, noise=noise, valid=valid), told


def _brightest(
    rest: FloatArray, noise: FloatArray, chosen: NDArray[np.bool_]
) -> tuple[tuple[int, int] | None, NDArray[np.bool_]]:
    """Row and column of what stands out most among the chosen pixels, and all pixels that stand out with it, grown."""
    smooth = ndimage.gaussian_filter(np.where(chosen, rest / noise, 0.0), _SMOOTH)
    level = 1.4826 * float(np.median(np.abs(smooth[chosen]))) if chosen.any() else 0.0
    # The map's own significance as well: in a good fit of little noise everything stands out.
    limit = max(_STANDS_OUT * level, _STANDS_OUT / math.sqrt(4.0 * math.pi) / _SMOOTH)
    if not (chosen & (smooth > limit)).any():
        return None, np.zeros(rest.shape, dtype=bool)
    row, column = (int(k) for k in np.unravel_index(int(np.argmax(np.where(chosen, smooth, -np.inf))), rest.shape))
    labels, _ = ndimage.label(smooth > 0.3 * limit)
    blob = ndimage.binary_dilation(labels == labels[row, column], iterations=_GROWN)
    return (row, column), np.asarray(blob)


def _star(observation: Observation, rest: FloatArray, noise: FloatArray, peak: tuple[int, int]) -> FloatArray | None:
    """Light (ny, nx) of the star that a blob is; None where it is none."""
    scale, (ny, nx) = observation.pixel_scale, observation.shape
    rows, columns = (slice(max(0, k - _FIT_RADIUS), k + _FIT_RADIUS + 1) for k in peak)
    weight = np.where(observation.valid, 1.0 / noise, 0.0)[rows, columns]
    data = rest[rows, columns] * weight
    middle = np.array([(peak[1] - (nx - 1) / 2) * scale, (peak[0] - (ny - 1) / 2) * scale])
    best, least, reach = None, math.inf, scale
    for _ in range(_TRIALS):
        for dx in (-0.5, 0.0, 0.5):
            for dy in (-0.5, 0.0, 0.5):
                place = middle + reach * np.array([dx, dy])
                light = observation.point_source(float(place[0]), float(place[1]))
                column = light[rows, columns] * weight
                size = float((column**2).sum())
                flux = float((column * data).sum()) / size if size > 0 else 0.0
                left = float(((data - flux * column) ** 2).sum())
                if flux > 0 and left < least:
                    best, least, centre = flux * light, left, place
        if best is None:
            return None
        middle, reach = centre, 0.5 * reach
    return best if least < _STAR_CHI2 * float((data**2).sum()) + 2.0 * data.size else None
