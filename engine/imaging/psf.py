"""The point-spread function: polychromatic diffraction through the pupil, and the detector on top of it.

Two arrays are told apart. The *optical* PSF is point-sampled: the irradiance at the centre of each sub-pixel
times the sub-pixel's area. It is band-limited and sampled above its Nyquist rate. Convolving it with an image
that is already integrated over the sub-pixels gives the blurred image integrated over the sub-pixels, without
another box blur, as long as the image is smooth on the scale of a sub-pixel. A point source is not; it is
integrated over the sub-pixels where it is placed (:func:`engine.imaging.convolution.point_source_image`). The
*effective* PSF is what a native pixel measures: the optical one integrated over the pixel and spread by the
detector kernel, sampled at the sub-pixels.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from scipy import fft
from threadpoolctl import threadpool_limits

from engine.conventions import FloatArray
from engine.errors import SpecError
from engine.imaging.pupil import pupil_transmission, pupil_wavefront
from engine.spec.instrument import Camera

PUPIL_PIXELS = 512
STAMP_SIDE = 10.4
"""Of the PSF [arcsec]."""


def telescope_psf(
    camera: Camera,
    *,
    oversampling: int | None = None,
    field_of_view: float = STAMP_SIDE,
    defocus_nm: float = 0.0,
    jitter: float = 0.0,
    pupil_pixels: int = PUPIL_PIXELS,
) -> FloatArray:
    """Optical PSF of a camera over its band, sampled at pixel_scale / oversampling.

    Fraunhofer diffraction by poppy's matrix Fourier transform (Soummer et al. 2007), wavelength by
    wavelength, weighted by throughput x wavelength interval (photons of a source of equal photon rate per
    nm).

    Parameters
    ----------
    camera
        Pupil, band pass and pixel scale.
    oversampling
        Sub-pixels along a native pixel; the camera's own where None.
    field_of_view
        Side of the stamp [arcsec]; rounded to the nearest odd number of sub-pixels.
    defocus_nm, jitter
        Focus error [nm rms of wavefront] and Gaussian pointing jitter [arcsec rms per axis].
    pupil_pixels
        Grid across the primary mirror; a knob of accuracy against time.

    Returns
    -------
    Read-only odd square array, irradiance x sub-pixel area (not integrated over the sub-pixel), centred
    exactly on its middle element. Its sum is the fraction of the light through the pupil that falls inside
    the stamp: nothing is renormalised. Computed on one thread, kept in memory per set of arguments.

    Raises
    ------
    SpecError
        Where the sub-pixels do not sample the shortest wavelength (they must be below lambda / 2D).
    """
    factor = camera.oversampling if oversampling is None else oversampling
    scale = camera.pixel_scale / factor
    size = 2 * round((field_of_view / scale - 1) / 2) + 1
    nyquist = coarsest_subpixel(camera)
    if scale > nyquist or size < 3:
        allowed = f"sub-pixels below {nyquist:.4f} arcsec and a stamp of at least 3"
        raise SpecError("oversampling", factor, allowed)
    # The cache sees the arguments made definite, so that a default and the same value given are one entry.
    return _telescope_psf(
        camera,
        scale=scale,
        size=size,
        defocus_nm=float(defocus_nm),
        jitter=float(jitter),
        pupil_pixels=pupil_pixels,
    )


def coarsest_subpixel(camera: Camera) -> float:
    """Side [arcsec] beyond which sub-pixels do not sample the shortest wavelength: lambda / 2D."""
    return min(camera.wavelength_nm) * _nm_to_lambda_over_d(camera) / 2


def _nm_to_lambda_over_d(camera: Camera) -> float:
    """Lambda / D [arcsec] of a wavelength of 1 nm."""
    return math.degrees(1e-9 / camera.pupil.primary_diameter_m) * 3600.0


@lru_cache(maxsize=32)
def _telescope_psf(
    camera: Camera, *, scale: float, size: int, defocus_nm: float, jitter: float, pupil_pixels: int
) -> FloatArray:
    amplitude = pupil_transmission(camera.pupil, pupil_pixels)
    wavefront = pupil_wavefront(camera.pupil, pupil_pixels, defocus_nm=defocus_nm)
    # The open area, not the sum of squares, is the power: a pupil pixel that is half open lets half the light
    # pass. So normalised, the peak converges much faster with the number of pupil pixels.
    amplitude /= math.sqrt(np.sum(amplitude))
    weights = np.asarray(camera.throughput) * np.gradient(np.asarray(camera.wavelength_nm))
    psf = np.zeros((size, size))
    # One thread: more of them may add up in another order, and the same run must give the same bits anywhere.
    with threadpool_limits(limits=1):
        for wavelength, weight in zip(camera.wavelength_nm, weights / weights.sum(), strict=True):
            extent = size * scale / (wavelength * _nm_to_lambda_over_d(camera))
            psf += weight * _monochromatic(amplitude, wavefront, wavelength, size, extent)
    if jitter:
        psf = _jittered(psf, jitter / scale)
    psf.setflags(write=False)
    return psf


def _monochromatic(
    amplitude: FloatArray, wavefront: FloatArray, wavelength: float, size: int, extent: float
) -> FloatArray:
    """PSF at one wavelength; ``extent`` is the stamp's side in lambda / D, ``amplitude`` has unit power."""
    # poppy takes seconds to import and brings matplotlib along: only who makes a PSF pays. Its plain numpy
    # transform is used: the numexpr one starts threads of its own.
    from poppy.matrixDFT import SYMMETRIC, matrix_dft  # noqa: PLC0415

    field = amplitude.astype(np.complex128)
    if np.any(wavefront):
        field *= np.exp(2j * np.pi / wavelength * wavefront)
    image = matrix_dft(field, extent, size, centering=SYMMETRIC)
    return np.asarray(image.real**2 + image.imag**2, dtype=np.float64)


def _jittered(psf: FloatArray, sigma: float) -> FloatArray:
    """Convolve the stamp with a Gaussian of ``sigma`` sub-pixels; what leaves the stamp is lost."""
    n = psf.shape[0]
    padded = fft.next_fast_len(n + 2 * math.ceil(6 * sigma), real=True)
    gaussian = np.exp(-2 * (np.pi * sigma * fft.fftfreq(padded)) ** 2)
    spectrum = fft.rfft2(psf, (padded, padded)) * gaussian[:, None] * gaussian[None, : padded // 2 + 1]
    return np.asarray(fft.irfft2(spectrum, (padded, padded))[:n, :n])


def detector_kernel(camera: Camera) -> FloatArray:
    """Return the camera's 3 x 3 kernel (capacitance or charge diffusion) on native pixels, of sum 1."""
    kernel = np.asarray(camera.detector_kernel, dtype=np.float64)
    return np.asarray(kernel / kernel.sum())
