"""The noise as a banded Cholesky factor.

Pixels of the mask are in raster order and drizzling correlates near neighbours only, so that the covariance is a narrow
band: its factor takes M x bandwidth numbers where C^-1 would take M^2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.linalg import lapack

from engine.conventions import FloatArray
from engine.errors import InversionError


@dataclass(frozen=True)
class NoiseFactor:
    """The lower Cholesky factor R of C = R R^T.

    ``bands`` is (bandwidth + 1, M): row i holds the i-th diagonal below the main one. Independent noise has one row,
    the standard deviations.
    """

    bands: FloatArray

    @property
    def ln_determinant(self) -> float:
        """ln|C|."""
        return 2.0 * float(np.log(self.bands[0]).sum())

    def whiten(self, values: FloatArray) -> FloatArray:
        """R^-1 values, for values (M,) or (M, k)."""
        return self._solve(values, transposed=False)

    def whiten_transposed(self, values: FloatArray) -> FloatArray:
        """R^-T values, for values (M,) or (M, k)."""
        return self._solve(values, transposed=True)

    def variances(self) -> FloatArray:
        """The diagonal (M,) of C."""
        out = np.zeros(self.bands.shape[1])
        for offset, band in enumerate(self.bands):
            out[offset:] += band[: out.size - offset] ** 2
        return out

    def rows(self) -> FloatArray:
        """R by its rows (M, bandwidth + 1): the last one is the diagonal, zeros stand before the first column."""
        width, m = self.bands.shape
        out = np.zeros((m, width))
        for offset, band in enumerate(self.bands):
            out[offset:, width - 1 - offset] = band[: m - offset]
        return out

    def _solve(self, values: FloatArray, *, transposed: bool) -> FloatArray:
        if self.bands.shape[0] == 1:
            deviations = self.bands[0]
            return np.asarray(values / (deviations if values.ndim == 1 else deviations[:, None]))
        if values.size == 0:
            return values.copy()
        columns = values.reshape(values.shape[0], -1)
        solution, _ = lapack.dtbtrs(self.bands, columns, uplo="L", trans="T" if transposed else "N")
        return np.asarray(solution).reshape(values.shape)


def factorise_noise(covariance: FloatArray | sparse.spmatrix) -> NoiseFactor:
    """Factorise the covariance of M pixels: variances (M,), or a matrix (M, M), dense or sparse.

    Raises
    ------
    InversionError
        A variance is not positive, or the matrix is not positive definite.
    """
    if not sparse.issparse(covariance) and np.ndim(covariance) == 1:
        variances = np.asarray(covariance, dtype=np.float64)
        if not (variances > 0).all():
            raise InversionError("noise: it has a pixel without positive variance on the mask")
        return NoiseFactor(np.sqrt(variances)[None, :])
    lower = sparse.tril(covariance, format="coo")
    lower.sum_duplicates()
    offsets = lower.row - lower.col
    bands = np.zeros((int(offsets.max(initial=0)) + 1, lower.shape[0]), order="F")
    bands[offsets, lower.col] = lower.data
    factor, info = lapack.dpbtrf(bands, lower=1, overwrite_ab=1)
    if info != 0:
        raise InversionError(f"covariance of the noise on the mask: not positive definite at pixel {info}")
    return NoiseFactor(np.asarray(factor))
