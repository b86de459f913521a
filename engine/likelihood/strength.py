"""The regularisation strength: the lambda that maximises the evidence.

With gamma = tr(A^-1 F) the number of parameters that the data determine and E = lambda s^T H s the penalty of the
solution, d ln Z / d ln lambda = (gamma - E) / 2 (Gull 1989; MacKay 1992, section 4.4). Its zero is
what is looked for.

:func:`find_strength` factorises A at a few values of lambda and takes Newton steps on phi = ln gamma - ln E, which
is far straighter in ln lambda than the derivative itself: gamma and E both fall and rise as powers of lambda. Its
slope follows from the same factorisation,

    d gamma / d ln lambda = -lambda tr(X - lambda X^2),      X = H A^-1,
    d E / d ln lambda     = E - 2 lambda^2 s^T X H s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from engine.compiled import kernel
from engine.conventions import FloatArray
from engine.errors import InversionError, SpecError
from engine.lensing.power_law import PowerLawLens
from engine.likelihood.amplitudes import MarginalLikelihood
from engine.likelihood.evidence import MAX_CONDITION, least_condition, normal_equations
from engine.source.regularisation import SourceModel, add_regularisation, sparse_regularisation

LOWEST, HIGHEST = -80.0, 80.0
"""Interval of ln lambda that is searched where none is given."""

_TOLERANCE = 1e-3
_LAST_STEP = 0.03
"""A Newton step this short leaves an error of about its square, below the tolerance: it is taken without a check."""
_LONGEST_STEP = 8.0
_MAX_FACTORISATIONS = 60
_DECIDED = 1e-6
"""Where gamma is below this share of n, every mode falls as 1 / lambda, and n - lambda tr(X) is rounding."""


@dataclass(frozen=True)
class Strength:
    """Where the evidence of a lens has its maximum in ln lambda.

    ``curvature`` is the second derivative of ln Z there (negative); ``effective_parameters`` is gamma;
    ``factorisations`` counts the Cholesky factorisations of A that were tried.
    """

    ln_lambda: float
    curvature: float
    effective_parameters: float
    factorisations: int


@dataclass(frozen=True)
class _Slope:
    """phi = ln gamma - ln E at one ln lambda, its derivative, and gamma."""

    phi: float
    derivative: float
    gamma: float


@kernel
def _mirror(matrix: FloatArray) -> None:
    """Copy the upper triangle of a Fortran-ordered matrix into its lower one, by blocks that fit the cache."""
    n, block = matrix.shape[0], 32
    for first in range(0, n, block):
        for second in range(first, n, block):
            for j in range(second, min(second + block, n)):
                for i in range(first, min(first + block, j)):
                    matrix[j, i] = matrix[i, j]


@kernel
def _trace_of_square(matrix: FloatArray) -> float:
    """tr(X X), by blocks that fit the cache."""
    n, block, total = matrix.shape[0], 32, 0.0
    for first in range(0, n, block):
        for second in range(0, n, block):
            for i in range(first, min(first + block, n)):
                for j in range(second, min(second + block, n)):
                    total += matrix[i, j] * matrix[j, i]
    return total


def _slope(f: FloatArray, d: FloatArray, ln_lambda: float, model: SourceModel) -> _Slope | None:
    """Phi at one ln lambda; None where A cannot be trusted in float64. ``f`` is lower triangular F."""
    strength = math.exp(ln_lambda)
    a = f.copy()
    add_regularisation(a, model, strength)
    factor, info = lapack.dpotrf(a.T, lower=0, clean=0, overwrite_a=1)
    if info != 0 or least_condition(factor) > MAX_CONDITION:
        return None
    h = sparse_regularisation(model)
    solution, _ = lapack.dpotrs(factor, d, lower=0)
    inverse, _ = lapack.dpotri(factor, lower=0, overwrite_c=1)
    _mirror(inverse)
    rows, columns = h.nonzero()
    trace = float(h.data @ inverse[rows, columns])
    gamma = d.size - strength * trace
    if gamma > _DECIDED * d.size:
        x = np.asarray(h @ inverse.T)
        falls = strength * trace - strength**2 * float(_trace_of_square(x))
    else:
        gamma = falls = float(2.0 * (np.tril(f, -1) * inverse).sum() + np.diag(f) @ np.diag(inverse))
    hs = h @ solution
    penalty = strength * float(solution @ hs)
    if not (gamma > 0.0 and penalty > 0.0):
        return None
    rises = penalty - 2.0 * strength**2 * float(hs @ inverse @ hs)
    return _Slope(math.log(gamma / penalty), -falls / gamma - rises / penalty, gamma)


def find_strength(
    likelihood: MarginalLikelihood,
    lens: PowerLawLens,
    model: SourceModel,
    *,
    low: float = LOWEST,
    high: float = HIGHEST,
    start: float | None = None,
) -> Strength:
    """Find the maximum of the evidence in ln lambda to 1e-3, by Newton steps kept between ``low`` and ``high``.

    The search begins at ``start``, or where lambda H is a hundredth of F in the trace; it climbs, so that of several
    maxima it finds one near there.

    Raises
    ------
    InversionError
        The evidence still rises at an end of the interval (at the upper one the data hold no source that stands out
        of the noise), or A cannot be factorised anywhere in it.
    """
    f, d = normal_equations(likelihood, lens, model)
    if start is None:
        trace, scale = float(np.trace(f)), float(sparse_regularisation(model).diagonal().sum())
        start = math.log(0.01 * trace / scale) if trace > 0.0 else 0.5 * (low + high)
    at, search = min(max(start, low), high), _Bracket(low, high)
    for tried in range(1, _MAX_FACTORISATIONS + 1):
        slope = _slope(f, d, at, model)
        search.learn(at, rising=slope is None or slope.phi > 0.0)
        if slope is not None and slope.derivative < 0.0:
            step = -slope.phi / slope.derivative
            if abs(step) < _LAST_STEP and low < at + step < high:
                # gamma = E at the zero, where the second derivative of ln Z is gamma phi' / 2.
                return Strength(at + step, 0.5 * slope.gamma * slope.derivative, slope.gamma, tried)
        else:
            step = _LONGEST_STEP if search.below == at else -_LONGEST_STEP
        if search.above - search.below < _TOLERANCE:
            break
        at = search.inside(at + min(max(step, -_LONGEST_STEP), _LONGEST_STEP))
    raise InversionError(
        f"ln lambda: the evidence has no maximum between {low:.1f} and {high:.1f} where A can be factorised; "
        "fewer source pixels are needed"
    )


def _no_maximum(low: float, high: float, *, rising: bool) -> InversionError:
    return InversionError(
        f"ln lambda: the evidence rises towards the {'upper' if rising else 'lower'} end of {low:.1f} to {high:.1f}; "
        "a wider interval is needed, or the data hold no source that stands out of the noise"
    )


class _Bracket:
    """The part of the interval where the evidence still has to turn from rising to falling."""

    def __init__(self, low: float, high: float) -> None:
        if not low < high:
            raise SpecError("ln lambda", (low, high), "an interval with its lower end first")
        self._low, self._high = low, high
        self._low_tried = self._high_tried = False
        self.below, self.above = low, high

    def learn(self, at: float, *, rising: bool) -> None:
        """Take in on which side of ``at`` the maximum lies; an InversionError where that is outside."""
        if (rising and at >= self._high) or (not rising and at <= self._low):
            raise _no_maximum(self._low, self._high, rising=rising)
        self._low_tried |= at <= self._low
        self._high_tried |= at >= self._high
        if rising:
            self.below = at
        else:
            self.above = at

    def inside(self, wanted: float) -> float:
        """``wanted`` where it is inside; an end that has not been tried; the middle otherwise."""
        if self.below < wanted < self.above:
            return wanted
        if wanted >= self.above and self.above == self._high and not self._high_tried:
            return self._high
        if wanted <= self.below and self.below == self._low and not self._low_tried:
            return self._low
        return 0.5 * (self.below + self.above)
