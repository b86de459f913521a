"""Where the centre of a PSF's stamp is, and the stamp about it."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from scipy import fft

from engine.conventions import FloatArray
from engine.errors import ObservationError

PsfCentre = Literal["pixel", "peak", "centroid"]
_PEAK_TOLERANCE = 1e-9
_CENTROID_WIDTHS = 2.0
_MOVE_STEPS = 100


def recentred_psf(psf: FloatArray, about: PsfCentre) -> tuple[FloatArray, tuple[float, float]]:
    """The PSF on the smallest odd square about its centre that loses nothing, and where the centre was (row, column).

    Whole pixels are moved by padding, the rest by a phase in Fourier space: exact for a band-limited PSF, and the sum
    stays. A stamp that is cut off rings at its edge by what the cut leaves there.
    """
    if not np.isfinite(psf).all():
        raise ObservationError("psf: not finite everywhere, so it has no centre")
    peak = np.unravel_index(int(np.argmax(psf)), psf.shape)
    row, column = int(peak[0]), int(peak[1])
    centred = _padded_about(psf, row, column)
    if about == "pixel":
        return centred, (row, column)
    dy, dx = _peak_offset(centred) if about == "peak" else _centroid_offset(centred)
    # A centre beyond half a pixel (the centroid of a lopsided core) is met by whole pixels first.
    whole_y, whole_x = round(dy), round(dx)
    if whole_y or whole_x:
        centred = _padded_about(psf, row + whole_y, column + whole_x)
    return _shifted(centred, whole_y - dy, whole_x - dx), (row + dy, column + dx)


def _padded_about(psf: FloatArray, row: int, column: int) -> FloatArray:
    ny, nx = psf.shape
    half = max(row, ny - 1 - row, column, nx - 1 - column)
    centred = np.zeros((2 * half + 1, 2 * half + 1))
    centred[half - row : half - row + ny, half - column : half - column + nx] = psf
    return centred


def _shifted(stamp: FloatArray, dy: float, dx: float) -> FloatArray:
    """Move an odd square by a sub-pixel shift; odd sides have no Nyquist term, so that no light is lost."""
    n = stamp.shape[0]
    phase = np.exp(-2j * np.pi * fft.fftfreq(n) * dy)[:, None] * np.exp(-2j * np.pi * fft.rfftfreq(n) * dx)
    return np.asarray(fft.irfft2(fft.rfft2(stamp) * phase, (n, n)))


def _peak_offset(stamp: FloatArray) -> tuple[float, float]:
    """Offset (y, x) of the maximum of the band-limited interpolation from the middle pixel, by Newton's method."""
    n = stamp.shape[0]
    frequency = 2j * np.pi * fft.fftfreq(n)
    spectrum = fft.fft2(fft.ifftshift(stamp))
    y = x = 0.0
    for _ in range(_MOVE_STEPS):
        along_y, along_x = np.exp(frequency * y), np.exp(frequency * x)
        derivative = [
            [float(np.real((frequency**i * along_y) @ spectrum @ (frequency**j * along_x))) for j in range(3)]
            for i in range(3)
        ]
        gradient = np.array([derivative[1][0], derivative[0][1]])
        hessian = np.array([[derivative[2][0], derivative[1][1]], [derivative[1][1], derivative[0][2]]])
        if not np.all(np.linalg.eigvalsh(hessian) < 0):
            raise ObservationError("psf: its brightest pixel is no smooth maximum; recentre it by pixel or centroid")
        step = np.linalg.solve(hessian, gradient)
        y, x = y - float(step[0]), x - float(step[1])
        if max(abs(y), abs(x)) > 1.0:
            raise ObservationError("psf: no maximum within a pixel of its brightest one; recentre it by pixel")
        if np.abs(step).max() < _PEAK_TOLERANCE:
            return y, x
    raise ObservationError("psf: its maximum was not found; recentre it by pixel or centroid")


def _centroid_offset(stamp: FloatArray) -> tuple[float, float]:
    """Offset (y, x) of the core's centre of light from the middle pixel.

    The core is weighted by a Gaussian that follows the centre, so that neither the cut of the stamp nor its noise far
    out counts, as in the adaptive moments of weak lensing; for a symmetric PSF the weight does not move the centre.
    The weight is twice as wide as a Gaussian of the stamp's noise-equivalent area (sum P)^2 / sum P^2 = 4 pi sigma^2,
    which a shift does not change.
    """
    half = stamp.shape[0] // 2
    axis = np.arange(-half, half + 1, dtype=np.float64)
    power = float(np.sum(stamp**2))
    if not (power > 0 and stamp.sum() > 0):
        raise ObservationError(f"psf: got the sum {stamp.sum()}, allowed is a positive one")
    width = _CENTROID_WIDTHS * float(stamp.sum()) / math.sqrt(4.0 * math.pi * power)
    y = x = 0.0
    for _ in range(_MOVE_STEPS):
        weight = stamp * np.exp(-0.5 * np.add.outer((axis - y) ** 2, (axis - x) ** 2) / width**2)
        total = float(weight.sum())
        if not total > 0:
            raise ObservationError(f"psf: its core has the sum {total}, allowed is a positive one")
        step_y = float(weight.sum(axis=1) @ axis) / total - y
        step_x = float(weight.sum(axis=0) @ axis) / total - x
        y, x = y + step_y, x + step_x
        if max(abs(step_y), abs(step_x)) < _PEAK_TOLERANCE:
            return y, x
    raise ObservationError("psf: its centre of light was not found; recentre it by pixel")
