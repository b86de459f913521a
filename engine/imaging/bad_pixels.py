"""Pixels that no light made: cosmic rays and hot pixels, sharper than the PSF lets anything be."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from engine.imaging.observation import Observation

_SIGNIFICANT = 10.0
"""Height above the neighbourhood, in the noise, from which on a pixel is looked at."""
_ALONE = 0.25
"""Height of the highest of its eight neighbours, in its own, below which a pixel stands alone."""
_PSF_SPREADS = 0.35
"""The same of a PSF which makes no such pixel; one that is narrower hides what is bad."""
_RING = np.ones((5, 5), dtype=bool)
_RING[1:4, 1:4] = False
_EIGHT = np.ones((3, 3), dtype=bool)
_EIGHT[1, 1] = False


def lone_pixels(observation: Observation) -> NDArray[np.bool_]:
    """Valid pixels (ny, nx) that stand alone where a star would reach its neighbours, by 10 sigma or more."""
    psf, valid = observation.psf, observation.valid
    row, column = np.unravel_index(int(np.argmax(psf)), psf.shape)
    inner = psf[max(0, row - 1) : row + 2, max(0, column - 1) : column + 2]
    if inner.size < _EIGHT.size or np.sort(inner.ravel())[-2] < _PSF_SPREADS * psf[row, column]:
        return np.zeros(observation.shape, dtype=bool)
    image = np.where(valid, observation.image, float(np.median(observation.image[valid])))
    around = ndimage.median_filter(image, footprint=_RING)
    above = image - around
    # Above the surroundings of the pixel in question, not above their own, which it shines into.
    neighbours = ndimage.maximum_filter(image, footprint=_EIGHT) - around
    noise = np.where(valid, observation.noise, np.inf)
    return np.asarray(valid & (above > _SIGNIFICANT * noise) & (neighbours < _ALONE * above))
