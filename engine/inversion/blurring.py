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


def blur(image: FloatArray, kernel: FloatArray) -> FloatArray:
    """Convolution of an image with an odd kernel, same shape, no light wrapping round."""
    shape = tuple(fft.next_fast_len(n + k, real=True) for n, k in zip(image.shape, kernel.shape, strict=True))
    product = fft.irfft2(fft.rfft2(image, s=shape) * fft.rfft2(kernel, s=shape), s=shape)
    cy, cx = kernel.shape[0] // 2, kernel.shape[1] // 2
    return np.asarray(product[cy : cy + image.shape[0], cx : cx + image.shape[1]])


def point_source_column(psf: FloatArray, shape: tuple[int, int], column: float, row: float) -> FloatArray:
    """Image of shape (ny, nx) of a point source of unit flux at pixel (column, row), moved there band-limited."""
    ny, nx = shape
    ky, kx = psf.shape
    py, px = fft.next_fast_len(ny + 2 * ky, real=True), fft.next_fast_len(nx + 2 * kx, real=True)
    base_row, base_column = int(np.rint(row)), int(np.rint(column))
    if not (-ky < base_row < ny + ky and -kx < base_column < nx + kx):
        raise ObservationError(f"point source at pixel ({column}, {row}): outside the image of shape {shape}")
    phase = np.exp(-2j * np.pi * (row - base_row) * fft.fftfreq(py))[:, None]
    phase = phase * np.exp(-2j * np.pi * (column - base_column) * fft.rfftfreq(px))[None, :]
    canvas = np.zeros((py, px))
    canvas[:ky, :kx] = psf
    # Put the stamp's centre on the nearest pixel; the padding of one stamp on each side takes what falls outside.
    canvas = np.roll(canvas, (base_row - ky // 2 + ky, base_column - kx // 2 + kx), axis=(0, 1))
    moved = fft.irfft2(fft.rfft2(canvas) * phase, s=(py, px))
    return np.asarray(moved[ky : ky + ny, kx : kx + nx])
