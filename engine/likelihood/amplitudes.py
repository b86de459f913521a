"""What an observation contributes to the evidence, computed once: B^T C^-1 B in blocks, B^T P d and the constants.

P = C^-1 - C^-1 U (U^T C^-1 U + L)^-1 U^T C^-1 marginalises the amplitudes, L the precision of their prior. B^T C^-1 B
is sparse, since pixels far apart do not share light, but B^T P B is not: the amplitudes are kept as a border T (P, k)
with B^T P B = B^T C^-1 B - T T^T. Neither C^-1 nor any other matrix of M x M, M x P or P x P is ever formed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import linalg, sparse

from engine.conventions import FloatArray
from engine.errors import InversionError
from engine.likelihood.noise import NoiseFactor, factorise_noise
from engine.likelihood.w_tilde import WTilde, compute_w_tilde
from engine.source.lensing_matrix import RayBundle
from engine.work import count


@dataclass(frozen=True)
class LinearData:
    """Data on the mask: d (M,), amplitude columns U (M, k), and the noise.

    The ``covariance`` is variances (M,) or a matrix (M, M), which is best sparse: drizzling correlates neighbours only.
    ``precisions`` (k,) are those of the Gaussian priors round zero of the amplitudes, zero where the prior is flat, as
    all are where None.
    """

    data: FloatArray
    covariance: FloatArray | sparse.spmatrix
    columns: FloatArray
    precisions: FloatArray | None = None

    def prior_rows(self) -> FloatArray:
        """Amplitudes in units of their priors' deviations, a row (k,) for each that has one: data that are zero."""
        k = self.columns.shape[1]
        precisions = np.zeros(k) if self.precisions is None else self.precisions
        return np.diag(np.sqrt(precisions))[precisions > 0.0]


@dataclass(frozen=True)
class WhitenedData:
    """d (M,) and U (M, k) divided by the Cholesky factor of C, that factor, and the rows (r, k) of the priors."""

    data: FloatArray
    columns: FloatArray
    noise: NoiseFactor
    priors: FloatArray

    @property
    def covariance(self) -> FloatArray:
        """The factor written out: standard deviations (M,), or a lower triangle (M, M)."""
        bands = self.noise.bands
        if bands.shape[0] == 1:
            return np.asarray(bands[0])
        m = bands.shape[1]
        factor = sparse.diags([band[: m - i] for i, band in enumerate(bands)], -np.arange(bands.shape[0]))
        return np.asarray(factor.toarray())


@dataclass(frozen=True)
class MarginalLikelihood:
    """The precomputed part of the evidence.

    Attributes
    ----------
    rays : RayBundle
        The image pixels whose light counts.
    w_tilde : WTilde
        B^T C^-1 B.
    border : array (P, k)
        T: B^T P B = B^T C^-1 B - T T^T.
    wd : array (P,)
        B^T P d.
    dd : float
        d^T P d.
    ln_constant : float
        -1/2 ln|C| - 1/2 ln|U^T C^-1 U + L| + 1/2 ln|L| - (M - k + r)/2 ln 2 pi, L the precisions of the priors of r
        amplitudes (ln|L| over these).
    data_points, amplitudes : int
        M and k.
    blurring : sparse array (M, P)
        B, for model images.
    whitened : WhitenedData
        For amplitudes and chi^2.
    """

    rays: RayBundle
    w_tilde: WTilde
    border: FloatArray
    wd: FloatArray
    dd: float
    ln_constant: float
    data_points: int
    amplitudes: int
    blurring: sparse.csr_matrix
    whitened: WhitenedData

    def fit_amplitudes(self, arc: FloatArray) -> FloatArray:
        """Best amplitudes (k,) for a given model of the lensed host on the mask (M,)."""
        rest = self.whitened.data - self.whitened.noise.whiten(arc)
        priors = self.whitened.priors
        columns = np.vstack([self.whitened.columns, priors])
        solution, *_ = linalg.lstsq(columns, np.concatenate([rest, np.zeros(len(priors))]))
        return np.asarray(solution)

    def chi2(self, arc: FloatArray, amplitudes: FloatArray) -> float:
        """Chi^2 of a model: lensed host on the mask (M,) plus amplitudes (k,) times their columns."""
        rest = self.whitened.data - self.whitened.noise.whiten(arc) - self.whitened.columns @ amplitudes
        return float(rest @ rest)


def marginalise_amplitudes(
    linear: LinearData, blurring: sparse.spmatrix | FloatArray, rays: RayBundle
) -> MarginalLikelihood:
    """Marginalise the amplitudes and precompute all that no lens changes.

    Parameters
    ----------
    linear : LinearData
        Data, covariance and amplitude columns on the M pixels of the mask.
    blurring : sparse or dense array (M, P)
        B: what each pixel of the mask receives of the light of each pixel with rays, of any values. Columns beyond
        those pixels may follow.
    rays : RayBundle
        Rays of the pixels whose light counts.

    Raises
    ------
    InversionError
        Data, noise or columns are not finite, the covariance is not positive definite, or the amplitude columns are
        not independent on the mask.
    """
    m = linear.data.size
    covariance = linear.covariance.data if sparse.issparse(linear.covariance) else linear.covariance
    priors = linear.prior_rows()
    for name, values in (("data", linear.data), ("noise", covariance), ("amplitudes", linear.columns)):
        if not np.isfinite(values).all():
            raise InversionError(f"{name}: not finite in some pixels of the mask; leave them out of it")
    blurring = sparse.csr_matrix(blurring)
    noise = factorise_noise(linear.covariance)
    white_d = noise.whiten(linear.data)
    k = linear.columns.shape[1]
    count("columns_solved", k)
    white_u = noise.whiten(linear.columns)
    ln_u, ln_l = 0.0, 2.0 * float(np.log(priors.max(axis=1, initial=0.0)).sum())
    projected_d = white_d
    border = np.zeros((blurring.shape[1], 0))
    if k:
        # An amplitude's prior is one datum more, which knows nothing else: only its part in the others is kept of q.
        q, r = np.linalg.qr(np.vstack([white_u, priors]))
        q = q[:m]
        pivots = np.abs(np.diag(r))
        if not pivots.min() > 1e-10 * pivots.max():
            raise InversionError("amplitudes: their columns are not independent on the mask; leave one out")
        projected_d = white_d - q @ (q.T @ white_d)
        ln_u = 2.0 * float(np.log(pivots).sum())
        border = np.ascontiguousarray(blurring.T @ noise.whiten_transposed(q))
    return MarginalLikelihood(
        rays=rays,
        w_tilde=compute_w_tilde(blurring, noise, rays),
        border=border,
        wd=np.asarray(blurring.T @ noise.whiten_transposed(projected_d)),
        dd=float(white_d @ projected_d),
        ln_constant=-0.5 * (noise.ln_determinant + ln_u - ln_l + (m - k + len(priors)) * math.log(2.0 * math.pi)),
        data_points=m,
        amplitudes=k,
        blurring=blurring,
        whitened=WhitenedData(white_d, white_u, noise, priors),
    )
