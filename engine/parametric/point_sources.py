"""Find the images of the AGN: peaks of the matched-filtered image, subtracted one after the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from engine.conventions import FloatArray, pixel_centres
from engine.imaging.convolution import convolve
from engine.imaging.optics.spline import place_stamp
from engine.imaging.optics.stamp_matrix import central_stamp

_FILTER_RADIUS = 3
_CENTRE_RADIUS = 0.25
"""Peaks this near [arcsec] to the deflector are taken for its cusp."""


@dataclass(frozen=True)
class Detection:
    """A detected point source: position [arcsec, image frame], flux [e-/s] and signal-to-noise of its peak."""

    x: float
    y: float
    flux: float
    significance: float


def remove_deflector(image: FloatArray, pixel_scale: float, centre: tuple[float, float] = (0.0, 0.0)) -> FloatArray:
    """The image less the median over circles round ``centre``: point sources and arcs stay, the deflector goes."""
    y, x = np.meshgrid(*(pixel_centres(n, pixel_scale) for n in image.shape), indexing="ij")
    radius = np.hypot(x - centre[0], y - centre[1])
    _, ring = np.unique(np.rint(radius / pixel_scale), return_inverse=True)
    medians = ndimage.median(image, labels=ring, index=np.arange(ring.max() + 1))
    return np.asarray(image - np.asarray(medians)[ring])


def _subpixel_peak(values: FloatArray, row: int, column: int) -> tuple[float, float]:
    """Row and column of the maximum of the parabola through a peak and its neighbours."""
    out = []
    for here, before, after in (
        (row, values[row - 1, column], values[row + 1, column]),
        (column, values[row, column - 1], values[row, column + 1]),
    ):
        bend = before - 2.0 * values[row, column] + after
        shift = 0.5 * (before - after) / bend if bend < 0 else 0.0
        out.append(here + float(np.clip(shift, -0.5, 0.5)))
    return out[0], out[1]


def find_point_sources(
    image: FloatArray,
    noise: FloatArray,
    psf: FloatArray,
    pixel_scale: float,
    most: int,
    centre: tuple[float, float] = (0.0, 0.0),
) -> tuple[Detection, ...]:
    """The most significant point sources, brightest first: peaks of five sigma or more.

    Parameters
    ----------
    image, noise : arrays (ny, nx)
        e-/s per pixel and its standard deviation.
    psf : array, odd by odd
        The drizzled PSF.
    pixel_scale : float
        arcsec.
    most : int
        How many to find at most.
    centre : pair of float
        Of the deflector [arcsec].
    """
    rest = remove_deflector(image, pixel_scale, centre)
    core = central_stamp(psf, _FILTER_RADIUS)
    # With locally constant noise the matched filter's peak is flux * sum(core^2) and its noise sigma * |core|.
    template = core[::-1, ::-1] - core.mean()
    energy = float((core * template[::-1, ::-1]).sum())
    y, x = np.meshgrid(*(pixel_centres(n, pixel_scale) for n in image.shape), indexing="ij")
    allowed = np.hypot(x - centre[0], y - centre[1]) > _CENTRE_RADIUS
    border = _FILTER_RADIUS + 1
    allowed[:border] = allowed[-border:] = False
    allowed[:, :border] = allowed[:, -border:] = False
    level = float(np.median(noise)) * float(np.sqrt((template**2).sum()))
    found: list[Detection] = []
    for _ in range(most):
        filtered = convolve(rest, template)
        peaks = allowed & (filtered == ndimage.maximum_filter(filtered, size=3)) & (filtered > 5.0 * level)
        if not peaks.any():
            break
        row, column = np.unravel_index(int(np.argmax(np.where(peaks, filtered, -np.inf))), image.shape)
        peak_row, peak_column = _subpixel_peak(filtered, int(row), int(column))
        flux = float(filtered[row, column]) / energy
        rest = rest - flux * place_stamp(psf, image.shape, peak_column, peak_row)
        allowed &= np.hypot(x - x[row, column], y - y[row, column]) > 2.0 * pixel_scale
        found.append(
            Detection(
                x=(peak_column - (image.shape[1] - 1) / 2.0) * pixel_scale,
                y=(peak_row - (image.shape[0] - 1) / 2.0) * pixel_scale,
                flux=flux,
                significance=float(filtered[row, column]) / level,
            )
        )
    return tuple(sorted(found, key=lambda detection: -detection.flux))
