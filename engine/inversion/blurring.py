"""The PSF as a linear operator on the pixels of the drizzled image.

An observation's PSF is the response, at the centres of pixels, to a point source. A model that hands over fluxes of
whole pixels (averages over sub-rays, or integrals over the pixel) has already smoothed the light by the pixel: blurring
it with the PSF would count that smoothing twice, 4 % of the width of an F160W star. The kernels here are the PSF
divided, in Fourier space, by the transfer function of that average.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from engine.conventions import FloatArray
from engine.errors import ObservationError


def _average_transfer(frequencies: FloatArray, subrays: int | None) -> FloatArray:
    """Transfer function of the mean over ``subrays`` points of a pixel (None: over the whole pixel)."""
    if subrays is None:
        return np.sinc(frequencies)
    # The Dirichlet kernel sin(pi f) / (n sin(pi f / n)).
    return np.asarray(np.sinc(frequencies) / np.sinc(frequencies / subrays))


def pixel_kernel(psf: FloatArray, subrays: int | None) -> FloatArray:
    """The PSF for fluxes that are means over ``subrays`` x ``subrays`` points of a pixel, or integrals (None).

    Same shape as ``psf`` (odd by odd). The result has the PSF's sum.
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
    return np.asarray(kernel * (psf.sum() / kernel.sum()))


def central_stamp(psf: FloatArray, radius: int) -> FloatArray:
    """The central (2 radius + 1)^2 pixels of an odd stamp, the whole of it where it is smaller."""
    cy, cx = psf.shape[0] // 2, psf.shape[1] // 2
    ry, rx = min(radius, cy), min(radius, cx)
    return psf[cy - ry : cy + ry + 1, cx - rx : cx + rx + 1].copy()


def blurring_matrix(
    kernel: FloatArray, to: tuple[NDArray[np.intp], NDArray[np.intp]], of: tuple[NDArray[np.intp], NDArray[np.intp]]
) -> FloatArray:
    """Dense B of shape (len(to), len(of)): what pixel ``to`` (rows, columns) receives of the light of pixel ``of``."""
    cy, cx = kernel.shape[0] // 2, kernel.shape[1] // 2
    dy = to[0][:, None] - of[0][None, :] + cy
    dx = to[1][:, None] - of[1][None, :] + cx
    seen = (dy >= 0) & (dy < kernel.shape[0]) & (dx >= 0) & (dx < kernel.shape[1])
    out = np.zeros(dy.shape)
    out[seen] = kernel[dy[seen], dx[seen]]
    return out
