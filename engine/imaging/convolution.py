"""Light on the high-resolution grid: extended images blurred by the PSF, and point sources in place."""

from __future__ import annotations

import numpy as np
from scipy import fft

from engine.conventions import FloatArray
from engine.errors import ObservationError
from engine.imaging.geometry import Geometry


def _check_psf(psf: FloatArray) -> None:
    if psf.ndim != 2 or psf.shape[0] != psf.shape[1] or psf.shape[0] % 2 == 0:
        raise ObservationError(f"psf: got shape {psf.shape}, allowed is an odd square")


def convolve(image: FloatArray, psf: FloatArray) -> FloatArray:
    """Blur an image with a PSF of the same sampling.

    Parameters
    ----------
    image
        (ny, nx) flux per sub-pixel, integrated over the sub-pixels. Outside of it there is no light.
    psf
        Odd square optical PSF (:func:`engine.imaging.psf.telescope_psf`).

    Returns
    -------
    Array of the image's shape. Zero-padded FFT: nothing wraps around; light scattered off the image is lost.
    """
    _check_psf(psf)
    ny, nx = image.shape
    half = psf.shape[0] // 2
    # Pixels of the stamp that no pair of image pixels can be apart by do not matter.
    keep_y, keep_x = min(half, ny - 1), min(half, nx - 1)
    stamp = psf[half - keep_y : half + keep_y + 1, half - keep_x : half + keep_x + 1]
    # Only the part that stays on the image has to be free of wrap-around.
    shape = tuple(fft.next_fast_len(n + keep, real=True) for n, keep in ((ny, keep_y), (nx, keep_x)))
    kernel = np.zeros(shape)
    kernel[: 2 * keep_y + 1, : 2 * keep_x + 1] = stamp[: shape[0], : shape[1]]
    kernel = np.roll(kernel, (-keep_y, -keep_x), axis=(0, 1))
    blurred = fft.irfft2(fft.rfft2(image, shape) * fft.rfft2(kernel), shape)
    return np.asarray(blurred[:ny, :nx])


def point_source_image(
    positions: FloatArray, fluxes: FloatArray, psf: FloatArray, geometry: Geometry, *, guard: int = 16
) -> FloatArray:
    """Point sources on the high-resolution grid, each at its exact position.

    The stamp is moved by its sub-pixel offset and integrated over the sub-pixels in Fourier space (a phase
    and a sinc: exact for a band-limited PSF), then added at its whole-pixel position. The zero frequency is
    untouched, so a stamp that falls on the grid entirely has the flux of the source times the sum of ``psf``
    to rounding, less the ringing of the cut stamp beyond ``guard``.

    Parameters
    ----------
    positions
        (n, 2) image-frame x, y [arcsec].
    fluxes
        (n,) total fluxes; the image has the same unit per sub-pixel.
    psf
        Odd square optical PSF sampled at geometry.subpixel_scale.
    guard
        Sub-pixels added round the stamp; it keeps the two ends of the stamp from wrapping onto each other.

    Returns
    -------
    Array of geometry.high_resolution_shape. Parts of stamps that leave the grid are lost.
    """
    _check_psf(psf)
    positions = np.asarray(positions, dtype=np.float64).reshape(-1, 2)
    fluxes = np.asarray(fluxes, dtype=np.float64).reshape(-1)
    if len(positions) != len(fluxes) or not (np.isfinite(positions).all() and np.isfinite(fluxes).all()):
        raise ObservationError("point sources: as many finite fluxes as finite positions are needed")
    image = np.zeros(geometry.high_resolution_shape)
    if not len(positions):
        return image
    centre = (np.array(image.shape[::-1]) - 1) / 2
    pixels = positions / geometry.subpixel_scale + centre
    # What cannot reach the grid from any of the sources need not be moved there.
    farthest = np.maximum(np.abs(pixels), np.abs(pixels - 2 * centre)).max()
    spare = max(0, psf.shape[0] // 2 - guard - int(min(farthest + 1, psf.shape[0])))
    stamp = psf[spare : psf.shape[0] - spare, spare : psf.shape[1] - spare]
    size = fft.next_fast_len(stamp.shape[0] + 2 * guard, real=True)
    half = stamp.shape[0] // 2 + guard
    padded = np.zeros((size, size))
    padded[guard : guard + stamp.shape[0], guard : guard + stamp.shape[1]] = stamp
    fy, fx = fft.fftfreq(size), fft.rfftfreq(size)
    spectrum = fft.rfft2(padded) * np.sinc(fy)[:, None] * np.sinc(fx)[None, :]
    for pixel, flux in zip(pixels, fluxes, strict=True):
        whole = np.rint(pixel).astype(int)
        dx, dy = pixel - whole
        phase = np.exp(-2j * np.pi * fy * dy)[:, None] * np.exp(-2j * np.pi * fx * dx)[None, :]
        add_stamp(image, flux * fft.irfft2(spectrum * phase, (size, size)), whole[1] - half, whole[0] - half)
    return image


def add_stamp(image: FloatArray, stamp: FloatArray, row: int, column: int) -> None:
    """Add ``stamp`` to ``image`` in place with its first pixel at (row, column), which may lie outside."""
    ny, nx = image.shape
    rows = slice(max(row, 0), min(row + stamp.shape[0], ny))
    columns = slice(max(column, 0), min(column + stamp.shape[1], nx))
    if rows.start < rows.stop and columns.start < columns.stop:
        image[rows, columns] += stamp[
            rows.start - row : rows.stop - row, columns.start - column : columns.stop - column
        ]
