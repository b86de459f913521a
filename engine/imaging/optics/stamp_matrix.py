"""The PSF as a linear operator on the pixels of the drizzled image.

An observation's PSF is the response, at the centres of pixels, to a point source. A model that hands over fluxes of
whole pixels (averages over sub-rays, or integrals over the pixel) has already smoothed the light by the pixel: blurring
it with the PSF would count that smoothing twice, 4 % of the width of an F160W star. The kernels here are the PSF
divided, in Fourier space, by the transfer function of that average.
"""

from __future__ import annotations

import numpy as np
from scipy import fft, sparse

from engine.conventions import FloatArray
from engine.errors import ObservationError
from engine.imaging.optics.interface import Pixels

_NO_LIGHT = 1e-6


def _average_transfer(frequencies: FloatArray, subrays: int | None) -> FloatArray:
    """Transfer function of the mean over ``subrays`` points of a pixel (None: over the whole pixel)."""
    if subrays is None:
        return np.sinc(frequencies)
    # The Dirichlet kernel sin(pi f) / (n sin(pi f / n)).
    return np.asarray(np.sinc(frequencies) / np.sinc(frequencies / subrays))


def pixel_kernel(psf: FloatArray, subrays: int | None) -> FloatArray:
    """The PSF for fluxes that are means over ``subrays`` x ``subrays`` points of a pixel, or integrals (None).

    Same shape as ``psf`` (odd by odd). The result has the PSF's sum; a correction of a PSF makes no light, and has none
    to keep.
    """
    ny, nx = psf.shape
    if ny % 2 == 0 or nx % 2 == 0:
        raise ObservationError(f"psf: got shape {psf.shape}, allowed is odd by odd")
    if subrays == 1:
        return psf.copy()
    pad = max(8, min(ny, nx) // 2)
    padded = np.pad(psf, pad)
    transfer = np.outer(
        _average_transfer(fft.fftfreq(padded.shape[0]), subrays),
        _average_transfer(fft.rfftfreq(padded.shape[1]), subrays),
    )
    kernel = fft.irfft2(fft.rfft2(padded) / transfer, s=padded.shape)[pad:-pad, pad:-pad]
    if abs(psf.sum()) < _NO_LIGHT * np.abs(psf).sum():
        return np.asarray(kernel)
    return np.asarray(kernel * (psf.sum() / kernel.sum()))


def central_stamp(psf: FloatArray, radius: int) -> FloatArray:
    """The central (2 radius + 1)^2 pixels of an odd stamp, the whole of it where it is smaller."""
    cy, cx = psf.shape[0] // 2, psf.shape[1] // 2
    ry, rx = min(radius, cy), min(radius, cx)
    return psf[cy - ry : cy + ry + 1, cx - rx : cx + rx + 1].copy()


def blurring_matrix(kernel: FloatArray, to: Pixels, of: Pixels) -> sparse.csr_matrix:
    """Sparse B of shape (len(to), len(of)): what pixel ``to`` (rows, columns) receives of the light of pixel ``of``."""
    cy, cx = kernel.shape[0] // 2, kernel.shape[1] // 2
    # Where each pixel of ``of`` stands in an image that is padded by the kernel, minus one elsewhere.
    top, left = min(to[0].min(), of[0].min()) - cy, min(to[1].min(), of[1].min()) - cx
    bottom, right = max(to[0].max(), of[0].max()) + cy, max(to[1].max(), of[1].max()) + cx
    place = np.full((bottom - top + 1, right - left + 1), -1, dtype=np.int32)
    place[of[0] - top, of[1] - left] = np.arange(of[0].size)
    rows, columns, values = [], [], []
    for (y, x), value in np.ndenumerate(kernel):
        found = place[to[0] - top + cy - y, to[1] - left + cx - x]
        row = np.flatnonzero(found >= 0).astype(np.int32)
        rows.append(row)
        columns.append(found[row])
        values.append(np.full(row.size, value))
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return sparse.csr_matrix(entries, shape=(to[0].size, of[0].size))
