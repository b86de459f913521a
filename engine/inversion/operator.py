"""What an observation contributes to the evidence, computed once: B^T P B, B^T P d and the constants.

Whitening with the Cholesky factor of C and projecting out the amplitude columns by a QR decomposition gives P without
ever forming C^-1. Afterwards a non-diagonal covariance and any number of amplitudes cost nothing in an evaluation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from engine.conventions import FloatArray
from engine.errors import InversionError
from engine.inversion.blurring import blurring_matrix
from engine.inversion.mapping import RayBundle

BLOCK = 32
"""Columns that the curvature kernel works on at once: a block of T then fits the second-level cache."""


@dataclass(frozen=True)
class LinearData:
    """Data on the mask: d (M,), its covariance (M,) variances or (M, M), amplitude columns U (M, k)."""

    data: FloatArray
    covariance: FloatArray
    columns: FloatArray


@dataclass(frozen=True)
class Operator:
    """The precomputed part of the evidence.

    Attributes
    ----------
    rays : RayBundle
        The P image pixels whose light counts.
    half_w : array (P, P rounded up to BLOCK)
        The upper triangle of B^T P B with half its diagonal: V in B^T P B = V + V^T; columns beyond P are zero.
    wd : array (P,)
        B^T P d.
    dd : float
        d^T P d.
    ln_constant : float
        -1/2 ln|C| - 1/2 ln|U^T C^-1 U| - (M - k)/2 ln 2 pi.
    data_points, amplitudes : int
        M and k.
    blurring : array (M, P)
        B, for model images.
    whitened : LinearData
        d and U divided by the Cholesky factor of C, for amplitudes (``covariance`` holds the factor).
    """

    rays: RayBundle
    half_w: FloatArray
    wd: FloatArray
    dd: float
    ln_constant: float
    data_points: int
    amplitudes: int
    blurring: FloatArray
    whitened: LinearData

    def fit_amplitudes(self, arc: FloatArray) -> FloatArray:
        """Best amplitudes (k,) for a given model of the lensed host on the mask (M,)."""
        rest = self.whitened.data - _whiten(self.whitened.covariance, arc)
        solution, *_ = linalg.lstsq(self.whitened.columns, rest)
        return np.asarray(solution)

    def chi2(self, arc: FloatArray, amplitudes: FloatArray) -> float:
        """Chi^2 of a model: lensed host on the mask (M,) plus amplitudes (k,) times their columns."""
        rest = self.whitened.data - _whiten(self.whitened.covariance, arc) - self.whitened.columns @ amplitudes
        return float(rest @ rest)


def _whiten(factor: FloatArray, values: FloatArray) -> FloatArray:
    """C^(-1/2) values, with ``factor`` the standard deviations (M,) or the lower Cholesky factor (M, M)."""
    if factor.ndim == 1:
        return np.asarray(values / (factor if values.ndim == 1 else factor[:, None]))
    return np.asarray(linalg.solve_triangular(factor, values, lower=True, check_finite=False))


def build_operator(
    linear: LinearData,
    kernel: FloatArray,
    rays: RayBundle,
    mask_pixels: tuple[NDArray[np.intp], NDArray[np.intp]],
    ray_pixels: tuple[NDArray[np.intp], NDArray[np.intp]],
) -> Operator:
    """Precompute an observation's operator.

    Parameters
    ----------
    linear : LinearData
        Data, covariance and amplitude columns on the M pixels of the mask.
    kernel : array
        PSF kernel for fluxes of whole pixels (see :func:`engine.inversion.blurring.pixel_kernel`).
    rays : RayBundle
        Rays of the P pixels whose light counts.
    mask_pixels, ray_pixels : (rows, columns)
        Where those M and P pixels lie in the image.

    Raises
    ------
    InversionError
        Data, noise or columns are not finite, the covariance is not positive definite, or the amplitude columns are
        not independent on the mask.
    """
    m = linear.data.size
    for name, values in (("data", linear.data), ("noise", linear.covariance), ("amplitudes", linear.columns)):
        if not np.isfinite(values).all():
            raise InversionError(f"{name}: not finite in some pixels of the mask; leave them out of it")
    if linear.covariance.ndim == 1:
        if not (linear.covariance > 0).all():
            raise InversionError("noise: it has a pixel without positive variance on the mask")
        factor = np.sqrt(linear.covariance)
        ln_c = float(np.log(linear.covariance).sum())
    else:
        try:
            factor = linalg.cholesky(linear.covariance, lower=True, check_finite=False)
        except linalg.LinAlgError as error:
            raise InversionError(f"covariance of the noise on the mask: not positive definite ({error})") from error
        ln_c = 2.0 * float(np.log(np.diag(factor)).sum())
    blurring = blurring_matrix(kernel, mask_pixels, ray_pixels)
    white_b = _whiten(factor, blurring)
    white_d = _whiten(factor, linear.data)
    k = linear.columns.shape[1]
    white_u = _whiten(factor, linear.columns)
    ln_u = 0.0
    projected_d = white_d
    if k:
        q, r = np.linalg.qr(white_u)
        pivots = np.abs(np.diag(r))
        if not pivots.min() > 1e-10 * pivots.max():
            raise InversionError("amplitudes: their columns are not independent on the mask; leave one out")
        white_b = white_b - q @ (q.T @ white_b)
        projected_d = white_d - q @ (q.T @ white_d)
        ln_u = 2.0 * float(np.log(pivots).sum())
    p = rays.pixels
    half_w = np.zeros((p, -(-p // BLOCK) * BLOCK))
    half_w[:, :p] = np.triu(white_b.T @ white_b)
    half_w[np.arange(p), np.arange(p)] *= 0.5
    return Operator(
        rays=rays,
        half_w=half_w,
        wd=white_b.T @ projected_d,
        dd=float(projected_d @ projected_d),
        ln_constant=-0.5 * (ln_c + ln_u + (m - k) * math.log(2.0 * math.pi)),
        data_points=m,
        amplitudes=k,
        blurring=blurring,
        whitened=LinearData(white_d, factor, white_u),
    )
