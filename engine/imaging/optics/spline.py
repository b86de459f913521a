"""A PSF stamp moved to any place by a cubic B-spline."""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage

from engine.conventions import FloatArray
from engine.imaging.convolution import add_stamp

_STAMP_GUARD = 1
"""Pixels of nothing round a stamp that is moved, so that its spline ends at nothing."""


def place_stamp(psf: FloatArray, shape: tuple[int, int], column: float, row: float) -> FloatArray:
    """Image (ny, nx) of a point source of unit flux at pixel (column, row): the stamp moved there by a cubic spline.

    For images whose exposures are not known; parts of the stamp that leave the image are lost. Pixels of HST sample
    its PSF below the Nyquist rate: a phase in Fourier space then leaves stripes of alternating sign across the whole
    image, 10 sigma and more beside a bright AGN. The spline confines the error to the core.
    """
    return place_spline(spline_coefficients(psf), shape, column, row)


def spline_coefficients(psf: FloatArray) -> FloatArray:
    """Cubic B-spline coefficients of a stamp with one pixel of nothing round it, (n + 2) squared."""
    return np.asarray(ndimage.spline_filter(np.pad(psf, _STAMP_GUARD), order=3, mode="mirror"))


def spline_weights(offset: float, derivative: bool = False) -> tuple[int, FloatArray]:
    """First neighbour and the four weights of the cubic B-spline at ``offset`` [pixels] from a pixel's centre.

    With ``derivative`` the derivatives of the weights by the offset.
    """
    first = math.floor(offset)
    t = offset - first
    if derivative:
        weights = [-3 * (1 - t) ** 2, 9 * t**2 - 12 * t, -9 * t**2 + 6 * t + 3, 3 * t**2]
    else:
        weights = [(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3]
    return first - 1, np.array(weights) / 6.0


def place_spline(
    coefficients: FloatArray, shape: tuple[int, int], column: float, row: float, *, along: str | None = None
) -> FloatArray:
    """A stamp of :func:`spline_coefficients` at pixel (column, row) of an image (ny, nx), or its derivative.

    ``along`` is ``column`` or ``row`` for the derivative by that coordinate.
    """
    first_row, down = spline_weights(row, along == "row")
    first_column, across = spline_weights(column, along == "column")
    n = coefficients.shape[0]
    rows = np.zeros((n + 3, n))
    for k, weight in enumerate(down):
        rows[k : k + n] += weight * coefficients
    moved = np.zeros((n + 3, n + 3))
    for k, weight in enumerate(across):
        moved[:, k : k + n] += weight * rows
    image = np.zeros(shape)
    add_stamp(image, moved, first_row - n // 2, first_column - n // 2)
    return image
