"""Images of extended light as an observation shows them, exactly: the yardstick for quicker ways.

Where the exposures are known, the light goes through the same dithers and drizzle; otherwise through the PSF stamp,
interpolated between its pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft

from engine.conventions import FloatArray, pixel_centres
from engine.imaging.blurring import convolve
from engine.imaging.cusps import place_cusps
from engine.imaging.observation import Observation
from engine.lensing.lens_equation import solve_lens_equation
from engine.lensing.power_law import PowerLawLens
from engine.light.rendering import render_sersic
from engine.light.sersic import SersicProfile

_OVERSAMPLING = 5
"""Sub-pixels along a pixel of an image whose exposures are not known; odd, so that pixel centres are among them."""
_MARGIN = 12
"""Pixels beyond such an image whose light is carried into it."""


@dataclass(frozen=True)
class _SubpixelGrid:
    """Sub-pixels of an image (ny, nx) and of a margin round it."""

    shape: tuple[int, int]
    pixel_scale: float

    @property
    def subpixel_scale(self) -> float:
        return self.pixel_scale / _OVERSAMPLING

    def high_resolution_axes(self) -> tuple[FloatArray, FloatArray]:
        ny, nx = ((n + 2 * _MARGIN) * _OVERSAMPLING for n in self.shape)
        return pixel_centres(nx, self.subpixel_scale), pixel_centres(ny, self.subpixel_scale)


def _interpolated_psf(psf: FloatArray) -> FloatArray:
    """The PSF at sub-pixel offsets, less the smoothing by a sub-pixel that the light has been through already."""
    guard = 4
    padded = np.pad(psf, guard)
    n = padded.shape[0]
    size = n * _OVERSAMPLING
    frequencies = fft.fftfreq(n) / _OVERSAMPLING
    spectrum = fft.fft2(padded) / np.outer(np.sinc(frequencies), np.sinc(frequencies))
    fine = np.zeros((size, size), dtype=np.complex128)
    half = n // 2
    place = np.r_[0 : half + 1, size - half : size]
    fine[np.ix_(place, place)] = spectrum
    values = np.real(fft.ifft2(fine)) * _OVERSAMPLING**2
    last = (n - 1) * _OVERSAMPLING + 1
    return np.asarray(values[:last, :last])


def lensed_sersic_image(
    observation: Observation, profile: SersicProfile, lens: PowerLawLens | None = None
) -> FloatArray:
    """Image (ny, nx) [e-/s per pixel] of a Sersic profile, behind a lens or not, in an observation."""
    response = observation.response
    geometry = _SubpixelGrid(observation.shape, observation.pixel_scale) if response is None else response.geometry
    x, y = geometry.high_resolution_axes()
    light = render_sersic(profile, x, y, geometry.subpixel_scale, lens)
    if lens is None:
        cusps = [(profile.x, profile.y)]
    else:
        cusps = [(image.x, image.y) for image in solve_lens_equation(lens, profile.x, profile.y)]
    light = place_cusps(light, profile, cusps, geometry, lens)
    if response is not None:
        return response.extended_image(light)
    blurred = convolve(light, _interpolated_psf(observation.psf))
    first = _MARGIN * _OVERSAMPLING + _OVERSAMPLING // 2
    ny, nx = observation.shape
    return np.asarray(
        blurred[first : first + ny * _OVERSAMPLING : _OVERSAMPLING, first : first + nx * _OVERSAMPLING : _OVERSAMPLING]
    )
