"""How an image answers to a point source: exactly where its exposures are known, by its PSF stamp where not.

Drizzling is not a convolution. Beside a bright AGN the difference between its true image and a shifted PSF stamp is
many times the noise, so an observation whose dithers and optical PSF are known carries them along.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from engine.conventions import FloatArray
from engine.imaging.convolution import convolve, point_source_image
from engine.imaging.drizzling import drizzle
from engine.imaging.exposures import expose
from engine.imaging.geometry import Geometry


@dataclass(frozen=True, eq=False)
class PointResponse:
    """The exposures behind a drizzled image: optical PSF on sub-pixels, sampling, 3 x 3 detector kernel."""

    psf: FloatArray
    geometry: Geometry
    detector_kernel: FloatArray

    def image(self, x: float, y: float) -> FloatArray:
        """Drizzled image (ny, nx) of a point source of unit flux at (x, y) [arcsec, image frame]."""
        star = point_source_image(np.array([[x, y]]), np.ones(1), self.psf, self.geometry)
        return drizzle(expose(star, self.geometry, self.detector_kernel), self.geometry)

    def extended_image(self, light: FloatArray) -> FloatArray:
        """Drizzled image (ny, nx) of light on the high-resolution grid, integrated over its sub-pixels."""
        return drizzle(expose(convolve(light, self.psf), self.geometry, self.detector_kernel), self.geometry)
