"""Images of extended light as an observation shows them, exactly: the yardstick for quicker ways.

Where the exposures are known, the light goes through the same dithers and drizzle; otherwise through the PSF stamp,
interpolated by a cubic B-spline, and light is laid on the pixels by the weights of the same spline.
"""

from __future__ import annotations

import numpy as np
from scipy import fft, sparse

from engine.conventions import FloatArray, pixel_centres
from engine.imaging.cusps import place_cusps
from engine.imaging.observation import Observation
from engine.imaging.optics.spline import spline_coefficients, spline_weights
from engine.lensing.lens_equation import solve_lens_equation
from engine.lensing.power_law import PowerLawLens
from engine.light.rendering import render_sersic
from engine.light.sersic import SersicProfile

_OVERSAMPLING = 5
"""Sub-pixels along a pixel of an image whose exposures are not known."""
_OUTSIDE = 12
"""Pixels beyond such an image whose light is carried into it."""


def deposit_matrix(pixels: int, subrays: int) -> sparse.csr_matrix:
    """Matrix (pixels, pixels * subrays) that lays rays on pixels by cubic B-spline weights."""
    rows, columns, values = [], [], []
    for sub in range(subrays):
        first, weights = spline_weights((sub + 0.5) / subrays - 0.5)
        for k, weight in enumerate(weights):
            to = np.arange(pixels) + first + k
            inside = (to >= 0) & (to < pixels)
            rows.append(to[inside])
            columns.append((np.arange(pixels) * subrays + sub)[inside])
            values.append(np.full(inside.sum(), weight))
    where = (np.concatenate(rows), np.concatenate(columns))
    return sparse.csr_matrix((np.concatenate(values), where), shape=(pixels, pixels * subrays))


class StampBlur:
    """Light on sub-pixels through the PSF, on a window of the image and ``outside`` pixels round it.

    ``x`` and ``y`` are the centres of the sub-pixels, ``side`` [arcsec] apart. Light that was integrated over the
    sub-pixels has been smoothed by them, beside what the PSF does: the PSF is divided by their transfer function.
    """

    def __init__(
        self, spline: FloatArray, x: FloatArray, y: FloatArray, scale: float, subrays: int, outside: int
    ) -> None:
        self.side = scale / subrays
        self._outside, self._shape = outside, (y.size, x.size)
        beyond = scale * np.arange(1, outside + 1)
        offsets = ((np.arange(subrays) + 0.5) / subrays - 0.5) * scale
        wide = [np.concatenate([axis[0] - beyond[::-1], axis, axis[-1] + beyond]) for axis in (x, y)]
        self.x, self.y = (np.add.outer(axis, offsets).ravel() for axis in wide)
        self._deposit_x, self._deposit_y = (deposit_matrix(axis.size, subrays) for axis in wide)
        middle = spline.shape[0] // 2
        columns, rows = (axis.size for axis in wide)
        high, across = min(middle, rows - 1), min(middle, columns - 1)
        self._fft_shape = (fft.next_fast_len(rows + high, real=True), fft.next_fast_len(columns + across, real=True))
        kernel = np.zeros(self._fft_shape)
        kernel[: 2 * high + 1, : 2 * across + 1] = spline[
            middle - high : middle + high + 1, middle - across : middle + across + 1
        ]
        self._kernel = fft.rfft2(np.roll(kernel, (-high, -across), axis=(0, 1)))
        height, width = self._fft_shape
        smoothed = np.outer(np.sinc(fft.fftfreq(height) / subrays), np.sinc(fft.rfftfreq(width) / subrays))
        self._sharper = self._kernel / smoothed

    def __call__(self, fine: FloatArray, *, integrated: bool) -> FloatArray:
        """Image (ny, nx) of the window from the flux of each sub-pixel, integrated over it or sampled in its middle."""
        laid = (self._deposit_x @ (self._deposit_y @ fine).T).T
        kernel = self._sharper if integrated else self._kernel
        blurred = fft.irfft2(fft.rfft2(laid, self._fft_shape) * kernel, self._fft_shape)
        k, (ny, nx) = self._outside, self._shape
        return np.asarray(blurred[k : k + ny, k : k + nx])


def lensed_sersic_image(
    observation: Observation, profile: SersicProfile, lens: PowerLawLens | None = None
) -> FloatArray:
    """Image (ny, nx) [e-/s per pixel] of a Sersic profile, behind a lens or not, in an observation."""
    if observation.response is None:
        ny, nx = observation.shape
        scale = observation.pixel_scale
        axes = pixel_centres(nx, scale), pixel_centres(ny, scale)
        blur = StampBlur(spline_coefficients(observation.psf), *axes, scale, _OVERSAMPLING, _OUTSIDE)
        return blur(render_sersic(profile, blur.x, blur.y, blur.side, lens), integrated=True)
    geometry = observation.response.geometry
    light = render_sersic(profile, *geometry.high_resolution_axes(), geometry.subpixel_scale, lens)
    if lens is None:
        cusps = [(profile.x, profile.y)]
    else:
        cusps = [(image.x, image.y) for image in solve_lens_equation(lens, profile.x, profile.y)]
    return observation.response.extended_image(place_cusps(light, profile, cusps, geometry, lens))
