"""Errors of the model that pixels share, with strengths that the residuals choose.

Each kind of error is a Gaussian process: modes that put columns U (pixels, m) on the image, with independent normal
amplitudes. A fit with the covariance I + U U^T of whitened pixels has these amplitudes marginalised (Rasmussen &
Williams 2006, section 2.7 and algorithm 2.1): its parameters no longer bend to explain what the modes explain better,
and their errors hold what that leaves open.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import linalg

from engine.conventions import FloatArray

_SHOWS = 0.05
"""Error that a direction puts on the image, in that of the noise, from which on it counts."""
STRENGTHS = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6)
"""Strengths of an error that are tried, as parts of the light that is wrong."""
_SWEEPS = 2


@dataclass(frozen=True, eq=False)
class SharedError:
    """Columns (pixels, m) of errors whose amplitudes are normal with deviation one.

    ``mean`` (m,) are amplitudes that the model has already, as those that corrected its stamp. The first ``of_host``
    columns are light of the host, the others errors of other light. A model of the image has them in units of its
    noise.
    """

    columns: FloatArray
    mean: FloatArray
    of_host: int

    def beside(self, other: SharedError) -> SharedError:
        """These errors and another one's, which are none of the host."""
        return SharedError(
            np.concatenate([self.columns, other.columns], axis=1), np.concatenate([self.mean, other.mean]), self.of_host
        )

    @cached_property
    def _directions(self) -> tuple[FloatArray, FloatArray]:
        """Orthonormal basis (pixels, k) of the columns that show, and the size (k,) of what they put on each."""
        square, vectors = linalg.eigh(self.columns.T @ self.columns)
        shows = square > _SHOWS**2
        size = np.sqrt(square[shows])
        return self.columns @ (vectors[:, shows] / size), size

    @property
    def offset(self) -> FloatArray:
        """What the amplitudes that the model has put on the pixels (pixels,)."""
        return np.asarray(self.columns @ self.mean)

    @property
    def effective_parameters(self) -> float:
        """How many amplitudes whitened pixels determine."""
        _, size = self._directions
        return float(np.sum(size**2 / (1.0 + size**2)))

    def whitened(self, weight: FloatArray) -> SharedError:
        """The same on pixels that are multiplied by ``weight`` (pixels,)."""
        return SharedError(self.columns * weight[:, None], self.mean, self.of_host)

    def decorrelated(self, values: FloatArray) -> FloatArray:
        """(I + U U^T)^(-1/2) of whitened values (pixels, ...)."""
        basis, size = self._directions
        shrunk = (1.0 - 1.0 / np.sqrt(1.0 + size**2)) * (basis.T @ values).T
        return np.asarray(values - basis @ shrunk.T)

    def amplitudes(self, residual: FloatArray) -> FloatArray:
        """The likeliest amplitudes (m,) of whitened residuals (pixels,) of a model without these errors."""
        normal = np.eye(self.mean.size) + self.columns.T @ self.columns
        return np.asarray(linalg.solve(normal, self.columns.T @ residual, assume_a="pos"))


@dataclass(frozen=True, eq=False)
class ModelError:
    """What is known of the errors of a model: their strengths, as parts of the light that is wrong.

    ``correction`` (n, n) is added to the stamp that was given; ``gain`` is ln of the evidence for all of it;
    ``flux_without`` [e-/s] is the host's where the model is taken for exact.
    """

    psf: float
    host: float
    gain: float
    correction: FloatArray
    flux_without: float


@dataclass(frozen=True, eq=False)
class Likeliest:
    """Strengths of the kinds of error that residuals are likeliest with, and the amplitudes (m,) of all modes.

    ``left`` is the likeliest error of moved stamps beside them; ``gain`` is ln of the evidence over that without errors
    that are shared.
    """

    strengths: tuple[float, ...]
    left: float
    amplitudes: FloatArray
    gain: float


def likeliest_errors(
    kinds: Sequence[FloatArray], residual: FloatArray, sigmas: Sequence[tuple[float, FloatArray]]
) -> Likeliest:
    """The strengths that residuals are likeliest with, one after the other, twice.

    Parameters
    ----------
    kinds : sequence of arrays (pixels, m)
        Columns [e-/s] of each kind of error, of strength one.
    residual : array (pixels,)
        [e-/s], of a model without them.
    sigmas : sequence of (number, array (pixels,))
        Deviations [e-/s] of the pixels for each error of moved stamps that is tried.
    """
    columns = np.concatenate(list(kinds), axis=1)
    which = np.repeat(np.arange(len(kinds)), [kind.shape[1] for kind in kinds])
    seen = [_Seen(columns, residual, sigma) for _, sigma in sigmas]
    strengths, noise = np.zeros(len(kinds)), int(np.argmax([one.exact for one in seen]))
    without = seen[noise].exact
    for _ in range(_SWEEPS):
        for kind in range(len(kinds)):
            tried = [np.where(np.arange(len(kinds)) == kind, strength, strengths) for strength in STRENGTHS]
            strengths = max(tried, key=lambda some: seen[noise].evidence(some[which]))
        noise = max(range(len(seen)), key=lambda k: seen[k].evidence(strengths[which]))
    scale = strengths[which]
    return Likeliest(
        strengths=tuple(strengths.tolist()),
        left=sigmas[noise][0],
        amplitudes=seen[noise].amplitudes(scale),
        gain=seen[noise].evidence(scale) - without,
    )


class _Seen:
    """What residuals (pixels,) with deviations ``sigma`` say of columns (pixels, m)."""

    def __init__(self, columns: FloatArray, residual: FloatArray, sigma: FloatArray) -> None:
        whitened = columns / sigma[:, None]
        self._square, self._along = whitened.T @ whitened, whitened.T @ (residual / sigma)
        self.exact = -0.5 * float(np.sum((residual / sigma) ** 2)) - float(np.sum(np.log(sigma)))

    def _solved(self, scale: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Amplitudes of the columns times ``scale``, and the diagonal of the Cholesky factor of I + U^T U."""
        normal = np.eye(scale.size) + scale[:, None] * self._square * scale
        factor = linalg.cho_factor(normal, lower=True)
        return linalg.cho_solve(factor, scale * self._along), np.diag(factor[0])

    def amplitudes(self, scale: FloatArray) -> FloatArray:
        return self._solved(scale)[0]

    def evidence(self, scale: FloatArray) -> float:
        """Ln of the evidence of columns times ``scale`` (m,), less what does not depend on it."""
        used = scale > 0
        if not used.any():
            return self.exact
        amplitudes, diagonal = self._solved(scale)
        return self.exact + 0.5 * float(amplitudes @ (scale * self._along)) - float(np.sum(np.log(diagonal)))
