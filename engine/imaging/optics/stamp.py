"""Optics of an image of which a PSF stamp is all that is known: light is convolved, point sources are moved stamps.

The stamp is interpolated by a cubic B-spline, and light is laid on the pixels by the weights of the same spline. A
drizzled image is no convolution: a star differs from a stamp moved to it by many times the noise of its core.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy import sparse

from engine.conventions import FloatArray, pixel_centres
from engine.imaging.optics.interface import Pixels
from engine.imaging.optics.spline import place_stamp, spline_coefficients
from engine.imaging.optics.stamp_blur import StampBlur
from engine.imaging.optics.stamp_matrix import blurring_matrix, central_stamp, pixel_kernel
from engine.lensing.power_law import PowerLawLens
from engine.light.rendering import DEFAULT_TOLERANCE, render_sersic
from engine.light.sersic import SersicProfile

_OVERSAMPLING = 5
"""Sub-pixels along a pixel."""
_OUTSIDE = 12
"""Pixels beyond the image whose light is carried into it."""
_AGN_SHIFT = 0.003
"""Error of a moved PSF stamp, as a shift [arcsec]: a drizzled pixel does not see its light where its centre is."""
_AGN_ERROR = 0.005
"""And as a fraction of the AGN's light."""
_EXTENDED_SHIFT, _EXTENDED_ERROR = 0.001, 0.001
"""The same for light that is spread over many pixels: what noise-free drizzled arcs differ by from the best fit."""


@dataclass(frozen=True, eq=False)
class StampOptics:
    """A PSF stamp (odd square) on the pixels of an image; an :class:`~engine.imaging.optics.interface.ImageOptics`.

    ``shape`` (ny, nx) is that of the image, ``pixel_scale`` in arcsec.
    """

    psf: FloatArray
    shape: tuple[int, int]
    pixel_scale: float

    correction_rounds: ClassVar[int] = 0
    error_range: ClassVar[tuple[float, float]] = (0.5, 5.0)
    error_correlation: ClassVar[float] = 2.0
    misfit_is_noise: ClassVar[bool] = True

    @property
    def star_radius(self) -> float:
        """Distance [arcsec] from the middle of the stamp to the nearest side of what is not padding."""
        rows, columns = (np.flatnonzero(np.any(self.psf != 0, axis=axis)) for axis in (1, 0))
        middle = self.psf.shape[0] // 2
        pixels = int(min(middle - rows[0], rows[-1] - middle, middle - columns[0], columns[-1] - middle))
        return pixels * self.pixel_scale

    def point_source(self, x: float, y: float) -> FloatArray:
        """The stamp moved to (x, y) [arcsec, image frame]: shape (ny, nx), unit flux."""
        ny, nx = self.shape
        column, row = x / self.pixel_scale + (nx - 1) / 2.0, y / self.pixel_scale + (ny - 1) / 2.0
        return place_stamp(self.psf, self.shape, column, row)

    def point_sources(self, places: FloatArray, fluxes: FloatArray) -> FloatArray:
        """The stamp moved to places (k, 2) [arcsec, image frame], times fluxes (k,): shape (ny, nx)."""
        image = np.zeros(self.shape)
        for (x, y), flux in zip(places, fluxes, strict=True):
            image += flux * self.point_source(float(x), float(y))
        return image

    def sersic_image(
        self, profile: SersicProfile, lens: PowerLawLens | None = None, tolerance: float = DEFAULT_TOLERANCE
    ) -> FloatArray:
        """Image (ny, nx) [e-/s per pixel] of a Sersic profile, behind a lens or not, through the stamp."""
        ny, nx = self.shape
        axes = pixel_centres(nx, self.pixel_scale), pixel_centres(ny, self.pixel_scale)
        blur = StampBlur(spline_coefficients(self.psf), *axes, self.pixel_scale, _OVERSAMPLING, _OUTSIDE)
        return blur(render_sersic(profile, blur.x, blur.y, blur.side, lens, tolerance), integrated=True)

    def blurring_matrix(self, to: Pixels, of: Pixels, subrays: int | None, radius: int) -> sparse.csr_matrix:
        """B (len(to), len(of)): the same stamp for all pixels."""
        # Divided by the average over the rays before it is cut, not after.
        return blurring_matrix(central_stamp(pixel_kernel(self.psf, subrays), radius), to, of)

    def agn_variance(self, light: FloatArray) -> FloatArray:
        """Variance (ny, nx) of moved stamps."""
        return self._shift_variance(light, _AGN_SHIFT, _AGN_ERROR)

    def extended_variance(self, light: FloatArray) -> FloatArray:
        """Variance (ny, nx) of extended light."""
        return self._shift_variance(light, _EXTENDED_SHIFT, _EXTENDED_ERROR)

    def data_variance(self, noise: FloatArray, fit: FloatArray, misfit: float) -> FloatArray:
        """Variances (M,) with the error of the stamps, which the fit knows.

        What the model misses counts as noise, as in the errors of the fit: in an image that no model describes a chain
        would stay in the first false maximum.
        """
        return np.where(np.isfinite(fit), np.maximum(noise, fit), noise) * misfit

    def _shift_variance(self, light: FloatArray, shift: float, fraction: float) -> FloatArray:
        """Variance (ny, nx) of light that may be off by a shift [arcsec] and by a fraction of itself."""
        steep = sum(np.asarray(slope) ** 2 for slope in np.gradient(light, self.pixel_scale))
        return np.asarray((fraction * light) ** 2 + shift**2 * steep)
