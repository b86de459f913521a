"""What the analysis may ask of an observation's optics, whatever is known of them."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from engine.conventions import FloatArray
from engine.lensing.power_law import PowerLawLens
from engine.light.rendering import DEFAULT_TOLERANCE
from engine.light.sersic import SersicProfile

Pixels = tuple[NDArray[np.intp], ...]
"""Rows and columns of some pixels of the image."""


class ImageOptics(Protocol):
    """How light becomes an image (ny, nx), and how far from the truth that may be.

    Attributes
    ----------
    correction_rounds : int
        How often a fit of the moved stamp and quick columns is to be corrected by :meth:`point_source` and
        :meth:`sersic_image`; none where these are no better.
    error_range : (float, float)
        Least and most that residuals at AGN images may change the error of their light by; (1, 1) where it is known.
    error_correlation : float
        Pixels over which the error of an AGN image's light stays the same, as the standard deviation of a Gaussian;
        zero where pixels err on their own.
    misfit_is_noise : bool
        Whether the inversion takes what the parametric fit misses for noise (:meth:`data_variance`).
    star_radius : float
        Distance [arcsec] from a point source up to which its light is known.
    """

    @property
    def correction_rounds(self) -> int: ...  # noqa: D102 - above
    @property
    def error_range(self) -> tuple[float, float]: ...  # noqa: D102
    @property
    def error_correlation(self) -> float: ...  # noqa: D102
    @property
    def misfit_is_noise(self) -> bool: ...  # noqa: D102
    @property
    def star_radius(self) -> float: ...  # noqa: D102

    def point_source(self, x: float, y: float) -> FloatArray:
        """Image of a point source of unit flux at (x, y) [arcsec, image frame]."""
        ...

    def point_sources(self, places: FloatArray, fluxes: FloatArray) -> FloatArray:
        """Image of several: places (k, 2) [arcsec, image frame] and fluxes (k,) [e-/s]."""
        ...

    def sersic_image(
        self, profile: SersicProfile, lens: PowerLawLens | None = None, tolerance: float = DEFAULT_TOLERANCE
    ) -> FloatArray:
        """Image [e-/s per pixel] of a Sersic profile, behind a lens or not: the yardstick for quicker ways.

        Its light is integrated to ``tolerance`` (:func:`~engine.light.rendering.render_sersic`).
        """
        ...

    def blurring_matrix(self, to: Pixels, of: Pixels, subrays: int | None, radius: int) -> sparse.csr_matrix:
        """B of shape (len(to), len(of)): what pixel ``to`` receives of the light of pixel ``of``.

        Parameters
        ----------
        to, of : (rows, columns)
            Pixels of the image.
        subrays : int or None
            The light of a pixel is the mean over subrays x subrays points of it, or its integral.
        radius : int
            Pixels farther apart than this along either axis do not see each other.
        """
        ...

    def agn_variance(self, light: FloatArray) -> FloatArray:
        """Variance [(e-/s)^2] of what AGN images of this ``light`` [e-/s] put on the pixels but no model predicts."""
        ...

    def extended_variance(self, light: FloatArray) -> FloatArray:
        """The same for extended light."""
        ...

    def data_variance(self, noise: FloatArray, fit: FloatArray, misfit: float) -> FloatArray:
        """Variances (M,) of pixels in the inversion.

        Parameters
        ----------
        noise, fit : arrays (M,)
            Variances of their noise, and of the parametric fit, errors of the PSF included; infinite where not fitted.
        misfit : float
            chi^2 per degree of freedom of that fit, one at least.
        """
        ...
