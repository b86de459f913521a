"""From shifts and spreads to the error budgets of estimates."""

from __future__ import annotations

import math
from dataclasses import replace

from engine.conventions import FloatArray
from engine.parametric.numerical_error import HostShift
from engine.result import BUDGETED, ErrorBudget, Estimate, NumericalError, Quantity

MAGNITUDES = 2.5 / math.log(10.0)
"""Magnitudes in a change of ln flux of one."""


def with_image_budget(estimate: Estimate, shift: HostShift | None) -> Estimate:
    """An ``image`` estimate with its budget: it comes from no grid, no chain and no draws."""
    if shift is None:
        return estimate

    def of(place: int, unit: float) -> NumericalError:
        return NumericalError(
            rendering=unit * abs(float(shift.rendering[place])),
            psf=unit * abs(float(shift.psf[place])),
            grid=0.0,
            sampling=0.0,
            draws=0.0,
        )

    return _with(estimate, ErrorBudget(of(0, MAGNITUDES), of(1, estimate.r_eff.mean), of(2, 1.0)))


def with_source_budget(estimate: Estimate, shifts: dict[str, FloatArray] | None, effective_samples: float) -> Estimate:
    """An estimate from draws of a chain with its budget.

    Parameters
    ----------
    estimate : Estimate
    shifts : mapping of ``rendering``, ``psf`` and ``grid`` to arrays (3,), or None
        Shifts of magnitude, r_eff [arcsec] and n; without them there is no budget.
    effective_samples : float
        Independent samples of the chain.
    """
    fitted = estimate.draws - estimate.failed
    if shifts is None or fitted < 2:
        return estimate

    def of(place: int, spread: Quantity) -> NumericalError:
        # The mean of k draws of a chain of N independent states varies by sd^2/k, of which sd^2/N is the chain's.
        return NumericalError(
            **{stage: abs(float(shift[place])) for stage, shift in shifts.items()},
            sampling=spread.sd / math.sqrt(effective_samples),
            draws=spread.sd * math.sqrt(max(1.0 / fitted - 1.0 / effective_samples, 0.0)),
        )

    return _with(estimate, ErrorBudget(*(of(place, getattr(estimate, name)) for place, name in enumerate(BUDGETED))))


def _with(estimate: Estimate, budget: ErrorBudget) -> Estimate:
    """The estimate with its budget; without where the response of a fit that knows nothing is no number."""
    known = all(math.isfinite(getattr(budget, name).total) for name in BUDGETED)
    return replace(estimate, budget=budget) if known else estimate
