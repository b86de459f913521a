"""The evidence of lens parameters and regularisation strength: the hot path of every run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from engine.conventions import FloatArray
from engine.errors import InversionError
from engine.lensing.power_law import PowerLawLens
from engine.likelihood.amplitudes import MarginalLikelihood
from engine.likelihood.curvature import curvature_matrices, curvature_matrix, together, workspace
from engine.source.grid import SourceGrid
from engine.source.lensing_matrix import LensingMatrix, map_rays
from engine.source.regularisation import SourceModel, add_regularisation, ln_determinant
from engine.work import count

MAX_CONDITION = 1e14
"""Beyond this the solution has lost all but two digits."""

MAX_LN_LAMBDA = 700.0
"""Beyond it lambda or its inverse is no number of float64."""


@dataclass(frozen=True)
class Inversion:
    """A solved inversion.

    ``source`` is (ny, nx), e-/s per arcsec^2; ``factor`` the upper Cholesky factor of A
    (its lower triangle is not used); ``curvature`` F and
    ``data_vector`` D of the source alone, amplitudes marginalised.
    """

    ln_evidence: float
    grid: SourceGrid
    lensing: LensingMatrix
    source: FloatArray
    factor: FloatArray
    curvature: FloatArray
    data_vector: FloatArray
    condition_number: float

    def draw_source(self, rng: np.random.Generator) -> FloatArray:
        """A draw (ny, nx) from the posterior of the source given lens and lambda: mean plus A^(-1/2) noise."""
        noise, _ = lapack.dtrtrs(self.factor, rng.standard_normal(self.source.size), lower=0)
        return np.asarray(self.source + noise.reshape(self.grid.shape))

    def source_covariance(self) -> FloatArray:
        """Posterior covariance (ny nx, ny nx) of the source pixels: A^-1."""
        inverse, _ = lapack.dpotri(self.factor, lower=0)
        return np.asarray(np.triu(inverse) + np.triu(inverse, 1).T)

    def source_variance(self) -> FloatArray:
        """Posterior variance (ny, nx) of the source pixels."""
        return np.asarray(np.diag(self.source_covariance()).reshape(self.grid.shape))

    def effective_parameters(self) -> float:
        """Number of source parameters that the data determine: tr(A^-1 F) (MacKay 1992)."""
        return float((self.source_covariance() * self.curvature).sum())


def least_condition(factor: FloatArray) -> float:
    """A lower bound of A's condition number from the diagonal of its Cholesky factor, at no cost."""
    diagonal = np.diag(factor)
    return float((diagonal.max() / diagonal.min()) ** 2)


def _untrusted(condition: float, ln_lambda: float) -> InversionError:
    return InversionError(
        f"A = F + lambda H: condition number {condition:.1e}, allowed is {MAX_CONDITION:.0e} (ln lambda "
        f"{ln_lambda:.3g}); a larger lambda, fewer source pixels or a wider mask are needed"
    )


def _strength(ln_lambda: float) -> float:
    """Lambda of its logarithm; an InversionError where that is no number of float64."""
    if not abs(ln_lambda) < MAX_LN_LAMBDA:
        raise InversionError(f"ln lambda: got {ln_lambda}, allowed is -{MAX_LN_LAMBDA:g} to {MAX_LN_LAMBDA:g}")
    return math.exp(ln_lambda)


@dataclass(frozen=True)
class _Solved:
    """An inversion up to its solution: ``factor`` is the lower Cholesky factor of A in Fortran order."""

    lensing: LensingMatrix
    data_vector: FloatArray
    factor: FloatArray
    solution: FloatArray


def _solve(
    likelihood: MarginalLikelihood, lensing: LensingMatrix, f: FloatArray, ln_lambda: float, model: SourceModel
) -> _Solved:
    """Factorise A = F + lambda H and solve; ``f`` (Fortran order, valid in its lower triangle) is overwritten."""
    d = lensing.transpose(likelihood.wd)
    count("columns_solved", d.size)
    add_regularisation(f, model, _strength(ln_lambda))
    factor, info = lapack.dpotrf(f, lower=1, clean=0, overwrite_a=1)
    if info != 0:
        raise InversionError(
            f"A = F + lambda H: not positive definite at pivot {info} of {d.size} (ln lambda {ln_lambda:.3g}); "
            "a larger lambda or fewer source pixels are needed"
        )
    least = least_condition(factor)
    if least > MAX_CONDITION:
        raise _untrusted(least, ln_lambda)
    solution, _ = lapack.dpotrs(factor, d, lower=1)
    return _Solved(lensing, d, factor, solution)


def _map_and_curve(
    likelihood: MarginalLikelihood, lens: PowerLawLens, model: SourceModel
) -> tuple[LensingMatrix, FloatArray]:
    """L and F."""
    lensing = map_rays(likelihood.rays, lens, model.shape)
    return lensing, curvature_matrix(likelihood.w_tilde, likelihood.border, lensing)


def normal_equations(
    likelihood: MarginalLikelihood, lens: PowerLawLens, model: SourceModel
) -> tuple[FloatArray, FloatArray]:
    """F (n, n), of which the lower triangle is valid, and D (n,) of a lens: all that the data say of its source."""
    lensing, f = _map_and_curve(likelihood, lens, model)
    return f, lensing.transpose(likelihood.wd)


def _ln_evidence(likelihood: MarginalLikelihood, model: SourceModel, ln_lambda: float, solved: _Solved) -> float:
    n = solved.solution.size
    quadratic = float(solved.data_vector @ solved.solution)
    ln_a = 2.0 * float(np.log(np.diag(solved.factor)).sum())
    return (
        -0.5 * (likelihood.dd - quadratic)
        - 0.5 * ln_a
        + 0.5 * ln_determinant(model)
        + 0.5 * n * ln_lambda
        + likelihood.ln_constant
    )


def ln_evidences(
    likelihood: MarginalLikelihood, lenses: Sequence[PowerLawLens], ln_lambdas: Sequence[float], model: SourceModel
) -> list[float | InversionError]:
    """Ln Z of the data given each lens and its ln lambda; where it cannot be had the error that says why.

    As many as fit the cache share what it costs to fetch W from memory (:func:`~.curvature.together`).
    """
    count("evidence_evaluations", len(lenses))
    n = model.shape[0] * model.shape[1]
    found: list[float | InversionError] = []
    size = together(n)
    for begin in range(0, len(lenses), size):
        mapped = [_mapped(likelihood, lens, model) for lens in lenses[begin : begin + size]]
        lensings = [each for each in mapped if isinstance(each, LensingMatrix)]
        memory = [workspace.array(f"A{k}", (n, n)) for k in range(len(lensings))]
        curved = iter(curvature_matrices(likelihood.w_tilde, likelihood.border, lensings, memory))
        for each, ln_lambda in zip(mapped, ln_lambdas[begin : begin + size], strict=True):
            if isinstance(each, InversionError):
                found.append(each)
                continue
            try:
                solved = _solve(likelihood, each, next(curved), ln_lambda, model)
                found.append(_ln_evidence(likelihood, model, ln_lambda, solved))
            except InversionError as error:
                found.append(error)
    return found


def _mapped(likelihood: MarginalLikelihood, lens: PowerLawLens, model: SourceModel) -> LensingMatrix | InversionError:
    """L of a lens, or why there is none."""
    try:
        return map_rays(likelihood.rays, lens, model.shape)
    except InversionError as error:
        return error


def ln_evidence(likelihood: MarginalLikelihood, lens: PowerLawLens, ln_lambda: float, model: SourceModel) -> float:
    """Ln Z of the data given lens and ln lambda.

    An InversionError says what to change where A is not positive definite.
    """
    found = ln_evidences(likelihood, [lens], [ln_lambda], model)[0]
    if isinstance(found, InversionError):
        raise found
    return found


def invert(likelihood: MarginalLikelihood, lens: PowerLawLens, ln_lambda: float, model: SourceModel) -> Inversion:
    """Solve the inversion and keep all of it; an InversionError tells where it cannot be trusted."""
    lensing, f = _map_and_curve(likelihood, lens, model)
    curvature = np.tril(f) + np.tril(f, -1).T
    a = np.tril(f)
    add_regularisation(a, model, _strength(ln_lambda))
    norm = float(np.abs(a + np.tril(a, -1).T).sum(axis=0).max())
    solved = _solve(likelihood, lensing, f, ln_lambda, model)
    reciprocal, _ = lapack.dpocon(solved.factor, norm, uplo="L")
    condition = math.inf if reciprocal == 0.0 else 1.0 / float(reciprocal)
    if condition > MAX_CONDITION:
        raise _untrusted(condition, ln_lambda)
    ln_z = _ln_evidence(likelihood, model, ln_lambda, solved)
    if lensing.envelope is None:
        to_brightness = np.ones(solved.solution.size)
    else:
        to_brightness = lensing.envelope.on_cells(lensing.grid)
    # From here on everything is in terms of the brightness of the nodes, not of its ratio to the envelope.
    return Inversion(
        ln_evidence=ln_z,
        grid=lensing.grid,
        lensing=lensing.of_brightness(to_brightness),
        source=(solved.solution * to_brightness).reshape(model.shape),
        # The other triangle is whatever lay in memory.
        factor=np.triu(solved.factor.T) / to_brightness[None, :],
        curvature=curvature / np.outer(to_brightness, to_brightness),
        data_vector=solved.data_vector / to_brightness,
        condition_number=condition,
    )
