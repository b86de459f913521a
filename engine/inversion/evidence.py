"""The evidence of lens parameters and regularisation strength: the hot path of every run."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from engine.compiled import kernel
from engine.conventions import FloatArray
from engine.errors import InversionError
from engine.inversion.mapping import Mapping, SourceGrid, map_rays
from engine.inversion.operator import BLOCK, Operator
from engine.inversion.regularisation import add_regularisation, ln_determinant
from engine.lensing.power_law import PowerLawLens, kernel_arguments
from engine.spec import RegularisationName

MAX_CONDITION = 1e14
"""Beyond this the solution has lost all but two digits."""


@dataclass(frozen=True)
class SourceModel:
    """How the source is described: (ny, nx) nodes, the regularisation, and the crowding of the nodes (None: even)."""

    shape: tuple[int, int] = (30, 30)
    regularisation: RegularisationName = "curvature"
    softening: float | None = None


@dataclass(frozen=True)
class Inversion:
    """A solved inversion.

    ``source`` is (ny, nx), e-/s per arcsec^2; ``factor`` the lower Cholesky factor of A; ``curvature`` F and
    ``data_vector`` D of the source alone, amplitudes marginalised.
    """

    ln_evidence: float
    grid: SourceGrid
    mapping: Mapping
    source: FloatArray
    factor: FloatArray
    curvature: FloatArray
    data_vector: FloatArray
    condition_number: float

    def draw_source(self, rng: np.random.Generator) -> FloatArray:
        """A draw (ny, nx) from the posterior of the source given lens and lambda: mean plus A^(-1/2) noise."""
        noise, _ = lapack.dtrtrs(self.factor, rng.standard_normal(self.source.size), lower=1, trans=1)
        return np.asarray(self.source + noise.reshape(self.grid.shape))

    def source_variance(self) -> FloatArray:
        """Posterior variance (ny, nx) of the source pixels: the diagonal of A^-1."""
        inverse, _ = lapack.dpotri(self.factor, lower=1)
        return np.asarray(np.diag(inverse).reshape(self.grid.shape))


@kernel
def _curvature(
    half_w: FloatArray, columns: NDArray[np.int32], weights: FloatArray, entries: NDArray[np.int32], n: int
) -> FloatArray:
    """F = L^T W L (n, n), valid in the lower triangle; ``half_w`` as in :class:`~.operator.Operator`.

    With W = V + V^T and V upper triangular, F = G + G^T for G = L^T V L. For a block of columns, T = L^T V[:, block] is
    gathered from the rows that V has there; then L^T T^T is added to G. Blocks fit the caches, their width is a
    constant, and the innermost loops are contiguous, so that they compile to vector instructions.
    """
    pixels = entries.size
    g = np.zeros((n, n))
    t = np.empty((n, BLOCK))
    transposed = np.empty((BLOCK, n))
    for start in range(0, pixels, BLOCK):
        t[:, :] = 0.0
        for p in range(min(start + BLOCK, pixels)):
            for e in range(entries[p]):
                weight = weights[p, e]
                column = columns[p, e]
                for k in range(BLOCK):
                    t[column, k] += weight * half_w[p, start + k]
        for i in range(n):
            for k in range(BLOCK):
                transposed[k, i] = t[i, k]
        for k in range(min(BLOCK, pixels - start)):
            for e in range(entries[start + k]):
                weight = weights[start + k, e]
                column = columns[start + k, e]
                for i in range(n):
                    g[column, i] += weight * transposed[k, i]
    for i in range(n):
        for j in range(i + 1):
            g[i, j] += g[j, i]
    return g


def _factorise(
    operator: Operator, lens: PowerLawLens, ln_lambda: float, model: SourceModel
) -> tuple[Mapping, FloatArray, FloatArray, FloatArray, FloatArray]:
    mapping = map_rays(operator.rays, kernel_arguments(lens), model.shape, model.softening)
    n = model.shape[0] * model.shape[1]
    f = _curvature(operator.half_w, mapping.columns, mapping.weights, mapping.entries, n)
    d = mapping.transpose(operator.wd)
    a = np.asfortranarray(f)
    add_regularisation(a, model.regularisation, model.shape, math.exp(ln_lambda))
    factor, info = lapack.dpotrf(a, lower=1, clean=1, overwrite_a=1)
    if info != 0:
        raise InversionError(
            f"A = F + lambda H: not positive definite at pivot {info} of {n} (ln lambda {ln_lambda:.3g}); "
            "a larger lambda or fewer source pixels are needed"
        )
    solution, _ = lapack.dpotrs(factor, d, lower=1)
    return mapping, f, d, factor, solution


def _ln_evidence(
    operator: Operator, model: SourceModel, ln_lambda: float, factor: FloatArray, quadratic: float
) -> float:
    n = model.shape[0] * model.shape[1]
    ln_a = 2.0 * float(np.log(np.diag(factor)).sum())
    ln_h = ln_determinant(model.regularisation, model.shape)
    return -0.5 * (operator.dd - quadratic) - 0.5 * ln_a + 0.5 * ln_h + 0.5 * n * ln_lambda + operator.ln_constant


def ln_evidence(
    operator: Operator,
    lens: PowerLawLens,
    ln_lambda: float,
    model: SourceModel,
) -> float:
    """Ln Z of the data given lens and ln lambda.

    An InversionError says what to change where A is not positive definite.
    """
    _, _, d, factor, solution = _factorise(operator, lens, ln_lambda, model)
    return _ln_evidence(operator, model, ln_lambda, factor, float(d @ solution))


def invert(
    operator: Operator,
    lens: PowerLawLens,
    ln_lambda: float,
    model: SourceModel,
) -> Inversion:
    """Solve the inversion and keep all of it; an InversionError tells where it cannot be trusted."""
    mapping, f, d, factor, solution = _factorise(operator, lens, ln_lambda, model)
    f = np.tril(f) + np.tril(f, -1).T
    full = f.copy()
    add_regularisation(full, model.regularisation, model.shape, math.exp(ln_lambda))
    norm = float(np.abs(np.tril(full) + np.tril(full, -1).T).sum(axis=0).max())
    reciprocal, _ = lapack.dpocon(factor, norm, uplo="L")
    condition = math.inf if reciprocal == 0.0 else 1.0 / float(reciprocal)
    if condition > MAX_CONDITION:
        raise InversionError(
            f"A = F + lambda H: condition number {condition:.1e}, allowed is {MAX_CONDITION:.0e}; "
            "a larger lambda, fewer source pixels or a wider mask are needed"
        )
    return Inversion(
        ln_evidence=_ln_evidence(operator, model, ln_lambda, factor, float(d @ solution)),
        grid=mapping.grid,
        mapping=mapping,
        source=solution.reshape(model.shape),
        factor=factor,
        curvature=f,
        data_vector=d,
        condition_number=condition,
    )
