"""Whether residuals are those of noise, where neighbouring pixels share it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from engine.conventions import FloatArray
from engine.imaging.observation import Observation

_SMOOTHED = 1.0
"""Pixels over which residuals are smoothed, as the standard deviation of a Gaussian: a model errs over a PSF."""
_REACH = 3
"""Pixels up to which drizzled pixels share noise."""
_FEWEST = 30


def shared_noise(observation: Observation) -> FloatArray:
    """Correlation (7, 7) of a pixel's noise with that of its neighbours, on average over the image."""
    out = np.zeros((2 * _REACH + 1, 2 * _REACH + 1))
    out[_REACH, _REACH] = 1.0
    if observation.covariance is None:
        return out
    nx = observation.shape[1]
    noise = np.where(observation.valid, observation.noise, np.inf).ravel()
    elements = observation.covariance.tocoo()
    down, across = elements.row // nx - elements.col // nx, elements.row % nx - elements.col % nx
    near = (abs(down) <= _REACH) & (abs(across) <= _REACH)
    share = elements.data[near] / (noise[elements.row[near]] * noise[elements.col[near]])
    np.add.at(out, (down[near] + _REACH, across[near] + _REACH), share)
    out[_REACH, _REACH] -= 1.0
    return out / int(observation.valid.sum())


def misfit_significance(residual: FloatArray, lit: NDArray[np.bool_], correlation: FloatArray) -> float:
    """Deviations by which smoothed residuals are larger than those of noise.

    Parameters
    ----------
    residual : array (ny, nx)
        In units of its noise.
    lit : array (ny, nx)
        Where to look.
    correlation : array (7, 7)
        Of :func:`shared_noise`.
    """
    if int(lit.sum()) < _FEWEST:
        return 0.0
    smooth = ndimage.gaussian_filter(residual, _SMOOTHED)[lit]
    down, across = np.indices(correlation.shape) - _REACH
    # The Gaussian convolved with itself.
    twice = np.exp(-(down**2 + across**2) / (4.0 * _SMOOTHED**2)) / (4.0 * math.pi * _SMOOTHED**2)
    expected = float(np.sum(twice * correlation))
    # Noise that neighbours share broadens the correlation of what is smoothed: its variance adds up.
    width = _SMOOTHED**2 + 0.5 * float(np.sum(correlation * down**2) / np.sum(correlation))
    deviation = math.sqrt(4.0 * math.pi * width / lit.sum())
    return (float(np.mean(smooth**2)) / expected - 1.0) / deviation
