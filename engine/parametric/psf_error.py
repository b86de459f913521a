"""What the stamp of a PSF may be wrong by, and what that looks like at the AGN images.

No stamp of a real PSF is exact: the telescope breathes, and the star had another colour and stood elsewhere. Its error
is taken for a Gaussian process in proportion to the stamp's own light, smooth over a pixel or so, that moves light and
makes none. Laid where the AGN images stand, its modes are errors that pixels share (:mod:`.shared_error`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import linalg, ndimage

from engine.conventions import FloatArray
from engine.imaging.optics.spline import place_spline, spline_coefficients

_CORRELATION = 1.2
"""Pixels over which an error stays the same, as the standard deviation of a Gaussian."""
_SMOOTH = 1.0
"""Pixels by which the stamp is smoothed before it says how large its error may be: its dark rings are not exact."""
_REACH = 12
"""Pixels from the middle up to which a stamp may be wrong."""
_WEAKEST_MODE = 3e-3
"""Size of a mode, in that of the largest, below which it is left out."""


def stamp_modes(psf: FloatArray) -> FloatArray:
    """Modes (m, n, n) of the error of a stamp (n, n) that is wrong by all of its light, the largest first."""
    middle = psf.shape[0] // 2
    reach = min(_REACH, middle)
    inner = slice(middle - reach, middle + reach + 1)
    row, column = np.indices((2 * reach + 1, 2 * reach + 1)) - reach
    chosen = np.hypot(row, column) <= reach + 0.5
    bright = np.abs(ndimage.gaussian_filter(psf, _SMOOTH))[inner, inner][chosen]
    y, x = row[chosen], column[chosen]
    distance = (y[:, None] - y) ** 2 + (x[:, None] - x) ** 2
    prior = np.outer(bright, bright) * np.exp(-0.5 * distance / _CORRELATION**2)
    # The flux of an AGN image is free, so that an error that makes light would be taken for the host's.
    prior -= prior.mean(axis=0)
    prior -= prior.mean(axis=1)[:, None]
    variance, vectors = linalg.eigh(prior)
    kept = np.flatnonzero(variance > _WEAKEST_MODE**2 * variance[-1])[::-1]
    modes = np.zeros((kept.size, *psf.shape))
    rows, columns = np.nonzero(chosen)
    modes[:, rows + inner.start, columns + inner.start] = (np.sqrt(variance[kept]) * vectors[:, kept]).T
    return modes


def laid_modes(modes: FloatArray, places: Sequence[tuple[float, float, float]], shape: tuple[int, int]) -> FloatArray:
    """Images (m, ny, nx) [e-/s] of what each mode puts on the pixels; ``places`` are (column, row, flux [e-/s])."""
    out = np.zeros((len(modes), *shape))
    for k, mode in enumerate(modes):
        spline = spline_coefficients(mode)
        for column, row, flux in places:
            out[k] += flux * place_spline(spline, shape, column, row)
    return out
