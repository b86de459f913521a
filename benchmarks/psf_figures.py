"""Figures of a PSF as the instrument handbooks have them: encircled energy, full width at half maximum."""

import math

import numpy as np
from scipy import fft

from engine.conventions import FloatArray


def effective_psf(psf: FloatArray, oversampling: int, kernel: FloatArray) -> FloatArray:
    """Find what a native pixel measures of a star, as a function of the star's offset from the pixel.

    Parameters
    ----------
    psf
        Optical PSF, odd square, ``oversampling`` sub-pixels to the native pixel.
    kernel
        3 x 3 detector kernel of sum 1.

    Returns
    -------
    Array larger than ``psf`` by 2 native pixels on each side, in the same sub-pixels, centred likewise. Flux
    per *sub-pixel* area, so that its sum is that of ``psf``; times oversampling^2 it is the flux in a native
    pixel.
    """
    border = 2 * oversampling
    n = psf.shape[0] + 2 * border
    size = fft.next_fast_len(n + 2 * border, real=True)
    fy, fx = fft.fftfreq(size)[:, None], fft.rfftfreq(size)[None, :]
    # The box of a native pixel and the kernel's nine impulses are exact in Fourier space for a band-limited
    # PSF.
    response = np.sinc(fy * oversampling) * np.sinc(fx * oversampling)
    spread = np.zeros((size, size // 2 + 1), dtype=np.complex128)
    for j, i in np.ndindex(3, 3):
        spread += kernel[j, i] * np.exp(-2j * np.pi * oversampling * (fy * (j - 1) + fx * (i - 1)))
    padded = np.zeros((size, size))
    padded[border : border + psf.shape[0], border : border + psf.shape[1]] = psf
    return np.asarray(fft.irfft2(fft.rfft2(padded) * response * spread, (size, size))[:n, :n])


def encircled_energy(psf: FloatArray, pixel_scale: float, radii: FloatArray) -> FloatArray:
    """Flux of a PSF inside circles about its central pixel.

    Parameters
    ----------
    psf
        Odd square array of flux per pixel.
    pixel_scale
        Side of its pixels [arcsec].
    radii
        Radii [arcsec], any shape.

    Returns
    -------
    Flux inside each radius, in the unit of ``psf`` (no normalisation). A pixel that a circle cuts counts by
    the fraction of its area inside, found on 16 x 16 points.
    """
    n, fine = psf.shape[0], 16
    axis = (np.arange(n) - n // 2) * pixel_scale
    r = np.hypot(axis[:, None], axis[None, :])
    offsets = ((np.arange(fine) + 0.5) / fine - 0.5) * pixel_scale
    oy, ox = (grid.ravel() for grid in np.meshgrid(offsets, offsets, indexing="ij"))
    result = np.empty(np.shape(radii))
    for index, radius in np.ndenumerate(radii):
        half_diagonal = pixel_scale / math.sqrt(2)
        rows, columns = np.nonzero(np.abs(r - radius) <= half_diagonal)
        inside = np.hypot(axis[rows, None] + oy, axis[columns, None] + ox) <= radius
        result[index] = psf[r < radius - half_diagonal].sum() + psf[rows, columns] @ inside.mean(axis=1)
    return result


def full_width_half_maximum(psf: FloatArray, pixel_scale: float) -> float:
    """Full width at half maximum [arcsec]: 2 sqrt(A / pi) with A the area above half of the central value.

    The half-maximum contour is found on a six times finer grid by Fourier interpolation of the core.
    """
    centre = psf.shape[0] // 2
    half = min(centre, 32)
    core = psf[centre - half : centre + half + 1, centre - half : centre + half + 1]
    n, zoom = core.shape[0], 6
    spectrum = np.zeros((n * zoom, n * zoom), dtype=np.complex128)
    start = (n * zoom) // 2 - n // 2
    spectrum[start : start + n, start : start + n] = fft.fftshift(fft.fft2(core))
    fine = fft.ifft2(fft.ifftshift(spectrum)).real * zoom**2
    area = np.count_nonzero(fine >= 0.5 * psf[centre, centre]) * (pixel_scale / zoom) ** 2
    return 2.0 * math.sqrt(area / math.pi)
