"""The regularisation strength: the lambda that maximises the evidence.

With gamma = tr(A^-1 F) the number of parameters that the data determine and E = lambda s^T H s the penalty of the
solution, d ln Z / d ln lambda = (gamma - E) / 2 (Gull 1989; MacKay 1992, section 4.4). Its zero is what is looked for,
as that of ln gamma - ln E, which is far straighter in ln lambda: gamma and E both fall and rise as powers of lambda.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import lapack
from scipy.optimize import brentq

from engine.conventions import FloatArray
from engine.errors import InversionError, SpecError
from engine.lensing.power_law import PowerLawLens
from engine.likelihood.amplitudes import MarginalLikelihood
from engine.likelihood.evidence import MAX_CONDITION, least_condition, normal_equations
from engine.source.regularisation import SourceModel, add_regularisation, sparse_regularisation
from engine.work import count

LOWEST, HIGHEST = -80.0, 80.0
"""Interval of ln lambda that is searched where none is given."""

_TOLERANCE = 1e-3
_STEP = 8.0
"""In ln lambda, while the maximum is not yet between two values."""


@dataclass(frozen=True)
class Strength:
    """Where the evidence of a lens has its maximum in ln lambda, and how often A was factorised to find it."""

    ln_lambda: float
    factorisations: int


@dataclass
class _Slope:
    """ln gamma - ln E by ln lambda for F (n, n), valid in its lower triangle, and D (n,); counts its factorisations."""

    f: FloatArray
    d: FloatArray
    model: SourceModel
    factorisations: int = field(default=0, init=False)

    def __call__(self, ln_lambda: float) -> float:
        """Positive where the evidence rises; infinite where A cannot be trusted in float64 and needs more of lambda."""
        self.factorisations += 1
        count("evidence_evaluations", 1)
        count("columns_solved", self.d.size)
        a = self.f.copy(order="F")
        add_regularisation(a, self.model, math.exp(ln_lambda))
        factor, info = lapack.dpotrf(a, lower=1, clean=0, overwrite_a=1)
        if info != 0 or least_condition(factor) > MAX_CONDITION:
            return math.inf
        solution, _ = lapack.dpotrs(factor, self.d, lower=1)
        inverse, _ = lapack.dpotri(factor, lower=1, overwrite_c=1)
        # Both are symmetric, and the lower triangle is what there is of them.
        gamma = float(2.0 * (np.tril(self.f, -1) * np.tril(inverse, -1)).sum() + np.diag(self.f) @ np.diag(inverse))
        penalty = math.exp(ln_lambda) * float(solution @ (sparse_regularisation(self.model) @ solution))
        return math.log(gamma / penalty) if gamma > 0.0 and penalty > 0.0 else math.inf


def find_strength(
    likelihood: MarginalLikelihood,
    lens: PowerLawLens,
    model: SourceModel,
    *,
    low: float = LOWEST,
    high: float = HIGHEST,
    start: float | None = None,
) -> Strength:
    """Find the maximum of the evidence in ln lambda to 1e-3, between ``low`` and ``high``.

    The search begins at ``start``, or where lambda H is a hundredth of F in the trace; it climbs, so that of several
    maxima it finds one near there.

    Raises
    ------
    InversionError
        The evidence still rises at an end of the interval (at the upper one the data hold no source that stands out
        of the noise), or A cannot be factorised anywhere in it.
    """
    if not low < high:
        raise SpecError("ln lambda", (low, high), "an interval with its lower end first")
    f, d = normal_equations(likelihood, lens, model)
    if start is None:
        trace, scale = float(np.trace(f)), float(sparse_regularisation(model).diagonal().sum())
        start = math.log(0.01 * trace / scale) if trace > 0.0 else 0.5 * (low + high)
    slope = _Slope(f, d, model)
    below, above = _bracket(slope, min(max(start, low), high), low, high)
    return Strength(float(brentq(slope, below, above, xtol=_TOLERANCE)), slope.factorisations)


def _bracket(slope: _Slope, start: float, low: float, high: float) -> tuple[float, float]:
    """Two values of ln lambda between which the evidence turns from rising to falling, A factorised at both."""
    at, found = start, slope(start)
    step = _STEP if found > 0.0 else -_STEP
    while True:
        before, at = (at, found), min(max(at + step, low), high)
        if at == before[0]:
            raise _no_maximum(low, high, rising=step > 0.0)
        found = slope(at)
        if (found > 0.0) != (before[1] > 0.0):
            break
    (below, rising), (above, _) = sorted([before, (at, found)])
    while math.isinf(rising):
        if above - below < _TOLERANCE:
            raise InversionError(
                f"ln lambda: the evidence has no maximum between {low:.1f} and {high:.1f} where A can be factorised; "
                "fewer source pixels are needed"
            )
        middle = 0.5 * (below + above)
        found = slope(middle)
        if found > 0.0:
            below, rising = middle, found
        else:
            above = middle
    return below, above


def _no_maximum(low: float, high: float, *, rising: bool) -> InversionError:
    return InversionError(
        f"ln lambda: the evidence rises towards the {'upper' if rising else 'lower'} end of {low:.1f} to {high:.1f}; "
        "a wider interval is needed, or the data hold no source that stands out of the noise"
    )
