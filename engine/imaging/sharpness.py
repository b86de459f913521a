"""How sharp the point sources of an image are, and what that says of the sampling of a PSF."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from engine.conventions import FloatArray
from engine.errors import ObservationError
from engine.imaging.observation import Observation
from engine.imaging.optics.spline import place_stamp
from engine.imaging.psf_stamp import binned

_SIGNIFICANCE, _HOT_PIXEL, _MOST_PEAKS, _PHASES = 60.0, 0.25, 6, 9
_TOO_BROAD = 2.0
"""Sharpness of an image's peaks over the PSF's that no place, colour or focus of a star explains."""
_AGREES = 1.1
_FINEST = 8
_FEWEST = 2


def sharpness_of_peaks(observation: Observation) -> FloatArray:
    """Sharpness (k,) of the brightest peaks, the sharpest first.

    The sharpness of a pixel is what its four neighbours fall short of it, over its height above the sky. Whatever else
    shines there makes it less, and so does a place between the pixels. A hot pixel is no peak.
    """
    valid, sky = observation.valid, float(np.median(observation.image[observation.valid]))
    image = np.where(valid, observation.image - sky, 0.0)
    significant = image > _SIGNIFICANCE * np.where(valid, observation.noise, np.inf)
    whole = ndimage.binary_erosion(valid, np.ones((3, 3), dtype=bool))
    rows, columns = np.nonzero((image == ndimage.maximum_filter(image, 3)) & significant & whole)
    sharp = []
    for k in np.argsort(-image[rows, columns])[:_MOST_PEAKS]:
        core = image[rows[k] - 1 : rows[k] + 2, columns[k] - 1 : columns[k] + 2]
        if np.sort(core.ravel())[-2] > _HOT_PIXEL * core[1, 1]:
            sharp.append(_sharpness(core))
    return np.sort(np.array(sharp))[::-1]


def sharpness_of_stamp(psf: FloatArray) -> float:
    """The largest sharpness of a PSF over where it may stand in its pixel."""
    places = np.linspace(-0.5, 0.5, _PHASES)
    moved = [place_stamp(psf, (3, 3), 1.0 + dx, 1.0 + dy) for dx in places for dy in places]
    return max(_sharpness(core) for core in moved if core[1, 1] == core.max())


def sampled_more_finely(observation: Observation, stamp: FloatArray) -> int | None:
    """How many times as finely as the image ``stamp`` (n, m) is sampled, if that alone explains its sharp peaks.

    None where fewer than two of them are twice as sharp as the PSF can be. No source is sharper than the PSF: it is the
    coarsest sampling with which that holds.
    """
    peaks = sharpness_of_peaks(observation)
    if np.count_nonzero(peaks > _TOO_BROAD * sharpness_of_stamp(observation.psf)) < _FEWEST:
        return None
    for factor in range(2, _FINEST + 1):
        try:
            if peaks[0] <= _AGREES * sharpness_of_stamp(binned(stamp, factor)):
                return factor
        except (ObservationError, ValueError):
            return None
    return None


def _sharpness(core: FloatArray) -> float:
    around = float(core[0, 1] + core[2, 1] + core[1, 0] + core[1, 2])
    return 4.0 - around / float(core[1, 1])
