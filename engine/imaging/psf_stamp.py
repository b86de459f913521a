"""What is wrong with a PSF's stamp, and what can be mended: a pedestal, and pixels that are hot."""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage

from engine.conventions import FloatArray
from engine.errors import ObservationError

_HOT, _HOT_LEAST = 4.0, 0.01
"""Times by which a hot pixel exceeds all its neighbours, and how much of the stamp's second brightest light it has."""
_NO_PEAK = 0.5
_PEDESTAL, _FLAT = 0.02, 0.8
"""Share of the light that a pedestal has to hold, and of the level further in that an edge has to have, to be one."""
_WIDE_ENOUGH = 4.0
"""Widths of the PSF that the edge has to be away to be free of its wings."""
_NEIGHBOURS = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], dtype=bool)
_SMALLEST = 5
_SIGMAS = 2.3548
_FINEST = 16
_SAME = 1e-3


def width(psf: FloatArray) -> float:
    """Full width at half maximum [pixels] of the Gaussian with the stamp's noise-equivalent area 4 pi sigma^2."""
    total, power = float(psf.sum()), float((psf**2).sum())
    if not (total > 0 and power > 0):
        raise ObservationError(f"psf: got the sum {total:g}, allowed is a positive one")
    return _SIGMAS * total / math.sqrt(4.0 * math.pi * power)


def mended(psf: FloatArray) -> tuple[FloatArray, tuple[str, ...]]:
    """The stamp without hot pixels and pedestal; what was wrong with it and, behind a semicolon, what was done.

    A hot pixel exceeds all eight neighbours by a factor that no image of a star reaches; it becomes their median. A
    pedestal is an edge as bright as what is further in; wings are not, and a stamp too small to tell is left alone.

    Raises
    ------
    ObservationError
        It is not finite, has no light, or all of it in a single pixel.
    """
    if not np.isfinite(psf).all():
        raise ObservationError("psf: not finite everywhere")
    if min(psf.shape) < _SMALLEST:
        return psf, ()
    notes = []
    neighbours = ndimage.maximum_filter(psf, footprint=_NEIGHBOURS, mode="constant", cval=-np.inf)
    core = float(np.max(np.minimum(psf, neighbours)))
    hot = (psf > _HOT * np.maximum(neighbours, 0.0)) & (psf > max(_HOT_LEAST * core, _noise(psf)))
    # A narrow peak has the brightest neighbours of all.
    hot &= neighbours < _NO_PEAK * core
    if not core > 0:
        raise ObservationError("psf: all its light is in a single pixel")
    if hot.any():
        smooth = ndimage.generic_filter(psf, np.median, footprint=_NEIGHBOURS, mode="reflect")
        first = np.argwhere(hot)[0]
        psf = np.where(hot, smooth, psf)
        notes.append(
            f"psf: {np.count_nonzero(hot)} hot pixels, as that in row {first[0]}, column {first[1]}; "
            "replaced by the median of their neighbours"
        )
    level = _pedestal(psf)
    if level is not None:
        share = level * psf.size / float(psf.sum())
        psf = psf - level
        notes.append(f"psf: a pedestal of {level:.3g} with {share:.0%} of its light; subtracted")
    return psf, tuple(notes)


def _noise(psf: FloatArray) -> float:
    """Six times the scatter of the stamp's edge."""
    edge = _edge(psf)
    return 6.0 * 1.4826 * float(np.median(np.abs(edge - np.median(edge))))


def _edge(psf: FloatArray) -> FloatArray:
    return np.concatenate([psf[0], psf[-1], psf[1:-1, 0], psf[1:-1, -1]])


def _pedestal(psf: FloatArray) -> float | None:
    """The level of the stamp's edge, where it is one on which the PSF stands; None elsewhere."""
    level = float(np.median(_edge(psf)))
    rest = psf - level
    if not rest.sum() > 0:
        raise ObservationError("psf: its edge is as bright as its middle")
    peak_row, peak_column = np.unravel_index(int(np.argmax(psf)), psf.shape)
    ny, nx = psf.shape
    away = min(peak_row, ny - 1 - peak_row, peak_column, nx - 1 - peak_column)
    if away < _WIDE_ENOUGH * width(np.maximum(rest, 0.0)):
        return None
    if abs(level) * psf.size < _PEDESTAL * float(psf.sum()):
        return None
    y, x = np.indices(psf.shape)
    radius = np.hypot(y - peak_row, x - peak_column)
    further_in = float(np.median(psf[(radius > 0.6 * away) & (radius < 0.75 * away)]))
    return level if level < 0 or level > _FLAT * further_in else None


def binned(psf: FloatArray, factor: int) -> FloatArray:
    """A PSF that is sampled ``factor`` times as finely as the image, on the image's pixels.

    Its brightest pixel, which becomes the middle of an odd square, stands in the middle of a pixel of the image. Light
    is summed over pixels; an even number of fine ones has half of its outermost on either side.
    """
    if not 1 <= factor <= _FINEST:
        raise ObservationError(f"psf_oversampling: got {factor}, allowed is a whole number from 1 to {_FINEST}")
    if factor == 1:
        return psf
    row, column = np.unravel_index(int(np.argmax(psf)), psf.shape)
    ny, nx = psf.shape
    half = factor * -(-max(row, ny - 1 - row, column, nx - 1 - column) // factor)
    centred = np.zeros((2 * half + 1, 2 * half + 1))
    centred[half - row : half - row + ny, half - column : half - column + nx] = psf
    box = np.ones(factor) if factor % 2 else np.concatenate([[0.5], np.ones(factor - 1), [0.5]])
    for axis in (0, 1):
        centred = ndimage.convolve1d(centred, box, axis=axis, mode="constant")
    return np.ascontiguousarray(centred[::factor, ::factor])


def same_picture(one: FloatArray, other: FloatArray) -> bool:
    """Whether two arrays show the same but for a factor and a constant, wherever both are finite."""
    if one.shape != other.shape:
        return False
    both = np.isfinite(one) & np.isfinite(other)
    if not both.any():
        return False
    a, b = one[both] - np.median(one[both]), other[both] - np.median(other[both])
    power = float(a @ a)
    if not power > 0:
        return False
    factor = float(a @ b) / power
    return bool(factor != 0 and np.abs(b - factor * a).max() <= _SAME * np.abs(b).max())
