"""Optics of an image whose exposures are known: light goes through the same dithers and the same drizzle.

Drizzling is not a convolution. Beside a bright AGN the difference between its true image and a shifted PSF stamp is
many times the noise, so an observation whose dithers and optical PSF are known carries them along.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from scipy import sparse

from engine.conventions import FloatArray
from engine.imaging.convolution import convolve, point_source_image
from engine.imaging.cusps import cusp_positions, place_cusps
from engine.imaging.drizzled_psf import drizzled_psf
from engine.imaging.drizzling import drizzle_weights
from engine.imaging.exposures import expose
from engine.imaging.geometry import Geometry
from engine.imaging.optics.exposed_matrix import exposed_blurring_matrix
from engine.imaging.optics.interface import Pixels
from engine.imaging.optics.stamp import StampOptics
from engine.imaging.telescope import NOMINAL_STATE, TelescopeState, state_psf
from engine.lensing.power_law import PowerLawLens
from engine.light.rendering import DEFAULT_TOLERANCE, render_sersic
from engine.light.sersic import SersicProfile
from engine.spec.instrument import Camera

_AGN_ERROR = 0.002
"""Error of an AGN's light as a fraction of it: what errors of position leave."""


@dataclass(frozen=True, eq=False)
class ExposedOptics:
    """The exposures behind a drizzled image; an :class:`~engine.imaging.optics.interface.ImageOptics`.

    ``psf`` is the optical PSF on the sub-pixels of ``geometry`` (odd square), ``detector_kernel`` (3, 3). Where the
    ``camera`` is known, ``state`` is that of the telescope which the PSF is taken for. ``correction`` (odd square) is
    added to the PSF of the drizzled image, as the AGN images ask for it.
    """

    psf: FloatArray
    geometry: Geometry
    detector_kernel: FloatArray
    camera: Camera | None = None
    state: TelescopeState = NOMINAL_STATE
    correction: FloatArray | None = None

    correction_rounds: ClassVar[int] = 2
    error_range: ClassVar[tuple[float, float]] = (1.0, 1.0)
    error_correlation: ClassVar[float] = 0.0
    misfit_is_noise: ClassVar[bool] = False
    star_radius: ClassVar[float] = math.inf

    def point_source(self, x: float, y: float) -> FloatArray:
        """Drizzled image (ny, nx) of a point source of unit flux at (x, y) [arcsec, image frame]."""
        return self.point_sources(np.array([[x, y]]), np.ones(1))

    def point_sources(self, places: FloatArray, fluxes: FloatArray) -> FloatArray:
        """Drizzled image (ny, nx) [e-/s] of point sources: places (k, 2) [arcsec, image frame], fluxes (k,)."""
        stars = point_source_image(places, fluxes, self.psf, self.geometry)
        image = self._drizzled(stars)
        return image if self._corrected is None else image + self._corrected.point_sources(places, fluxes)

    def sersic_image(
        self, profile: SersicProfile, lens: PowerLawLens | None = None, tolerance: float = DEFAULT_TOLERANCE
    ) -> FloatArray:
        """Drizzled image (ny, nx) [e-/s per pixel] of a Sersic profile, behind a lens or not."""
        geometry = self.geometry
        light = render_sersic(profile, *geometry.high_resolution_axes(), geometry.subpixel_scale, lens, tolerance)
        cusps = cusp_positions(profile, lens, geometry)
        blurred = convolve(place_cusps(light, profile, cusps, geometry, lens), self.psf)
        image = self._drizzled(blurred)
        return image if self._corrected is None else image + self._corrected.sersic_image(profile, lens, tolerance)

    @property
    def _corrected(self) -> StampOptics | None:
        """What the correction alone makes of light: it is so small that a drizzled image may be taken for one blur."""
        if self.correction is None:
            return None
        return StampOptics(self.correction, self.geometry.drizzled_shape, self.geometry.drizzled_scale)

    def in_state(self, state: TelescopeState) -> ExposedOptics:
        """The same with the telescope in another state; a ValueError where the camera is not known."""
        if self.camera is None:
            raise ValueError("response: its camera is not known, nor then what another state makes of its PSF")
        new, old = (state_psf(self.camera, self.geometry.oversampling, one) for one in (state, self.state))
        return replace(self, psf=self.psf + (new - old), state=state)

    def stamp_change(self, other: ExposedOptics, radius: int) -> FloatArray:
        """What the PSF of the drizzled image gains (2 radius + 1, squared) where the optical PSF becomes another's."""
        return drizzled_psf(other.psf - self.psf, self.geometry, self.detector_kernel, radius)

    def _drizzled(self, blurred: FloatArray) -> FloatArray:
        """Drizzled exposures of a blurred high-resolution image: by the weights, a fiftieth of the package's time."""
        exposures = expose(blurred, self.geometry, self.detector_kernel)
        flat = drizzle_weights(self.geometry) @ exposures.ravel()
        return np.asarray(flat.reshape(self.geometry.drizzled_shape))

    def blurring_matrix(self, to: Pixels, of: Pixels, subrays: int | None, radius: int) -> sparse.csr_matrix:
        """B (len(to), len(of)): each pixel's own PSF, dithers, drizzle and all."""
        matrix = exposed_blurring_matrix(self.psf, self.geometry, self.detector_kernel, to, of, subrays, radius)
        return matrix if self._corrected is None else matrix + self._corrected.blurring_matrix(to, of, subrays, radius)

    def agn_variance(self, light: FloatArray) -> FloatArray:
        """Variance (ny, nx) that errors of the AGN's positions leave."""
        return np.asarray((_AGN_ERROR * light) ** 2)

    def extended_variance(self, light: FloatArray) -> FloatArray:
        """Nothing: through its exposures extended light is exact."""
        return np.zeros(light.shape)

    def data_variance(self, noise: FloatArray, fit: FloatArray, misfit: float) -> FloatArray:  # noqa: ARG002
        """The variances (M,) of the noise alone."""
        return noise
