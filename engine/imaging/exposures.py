"""From light on the high-resolution grid to noiseless dithered exposures of the detector."""

from __future__ import annotations

import numpy as np

from engine.conventions import FloatArray
from engine.errors import ObservationError
from engine.imaging.geometry import Geometry


def expose(image: FloatArray, geometry: Geometry, detector_kernel: FloatArray) -> FloatArray:
    """Noiseless native exposures of a blurred high-resolution image, one for each dither position.

    Each native pixel is the exact sum of its sub-pixels; the detector kernel then spreads it over its
    neighbours.

    Parameters
    ----------
    image
        geometry.high_resolution_shape, flux per sub-pixel.
    detector_kernel
        3 x 3, sum 1 (:func:`engine.imaging.psf.detector_kernel`), [row offset + 1, column offset + 1].

    Returns
    -------
    (n_dither, ny, nx), flux per native pixel.
    """
    if image.shape != geometry.high_resolution_shape:
        raise ObservationError(
            f"high-resolution image: got shape {image.shape}, allowed is {geometry.high_resolution_shape}"
        )
    if detector_kernel.shape != (3, 3):
        raise ObservationError(f"detector kernel: got shape {detector_kernel.shape}, allowed is (3, 3)")
    factor, (ny, nx) = geometry.oversampling, geometry.native_shape
    exposures = np.zeros((geometry.n_dither, ny, nx))
    for index, (shift_x, shift_y) in enumerate(geometry.subpixel_shifts):
        # One native pixel more on each side: its charge or signal leaks in, and the margin has room for it.
        row, column = geometry.margin + shift_y - factor, geometry.margin + shift_x - factor
        window = image[row : row + (ny + 2) * factor, column : column + (nx + 2) * factor]
        # Added up slice by slice: sums over axes as short as these take numpy three times as long.
        rows = np.sum([window[k::factor] for k in range(factor)], axis=0)
        binned = np.sum([rows[:, k::factor] for k in range(factor)], axis=0)
        for (j, i), weight in np.ndenumerate(detector_kernel):
            if weight != 0:
                # A kernel element at offset (+1, +1) brings light from the pixel at (-1, -1).
                exposures[index] += weight * binned[2 - j : 2 - j + ny, 2 - i : 2 - i + nx]
    return exposures
