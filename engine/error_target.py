"""The cheapest settings that keep a numerical error, found by looking at the errors of cheaper ones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from engine.result import Estimate
from engine.spec.analysis import PROFILES, Analysis

ROUNDS = 3
"""Settings that are tried, the first included."""
_AIM = 0.9
"""Part of what is allowed that is aimed at: a prediction is one of chance too."""
_OF_GRID = 0.7
"""Part of that which the grid may take, where it takes more."""
_FEW, _SOME, _MANY = 4, 8, 32
"""Walkers: those of `draft`, `standard` and `reference`."""
_MOST_DRAWS = 1000
_COST_OF_NODES = 1.5
"""Power of the nodes with which an evaluation of the evidence grows (docs/tables/evidence.md)."""


@dataclass(frozen=True)
class _Wanted:
    """What estimates ask for: so many times the nodes along an axis, and so many independent draws."""

    finer: float
    draws: float


def first_settings(analysis: Analysis) -> Analysis:
    """The walk of `draft`, with the grid and the draws that were asked for."""
    return replace(analysis, **PROFILES["draft"])


def next_settings(settings: Analysis, estimates: Sequence[Estimate], max_error: float) -> Analysis | None:
    """Settings that should keep the error of every magnitude, n in the wide range; None where there is nothing to do.

    Nothing is where these keep it, or where more would cost beyond `reference`.
    """
    judged = [one for one in estimates if one.estimator != "image" and one.index_prior == "wide"]
    over = [one for one in judged if one.budget is not None and one.budget.magnitude.total > max_error]
    if not over:
        return None
    wanted = [_wanted(one, max_error) for one in over]
    finer, draws = max(one.finer for one in wanted), max(one.draws for one in wanted)
    ny, nx = (min(80, math.ceil(nodes * finer)) for nodes in settings.source_pixels)
    draws = min(_MOST_DRAWS, max(settings.draws, math.ceil(draws)))
    walkers = _FEW if draws <= 90 else _SOME if draws <= 600 else _MANY
    # As many independent states as draws and a third more: the chain then adds nothing to what the draws say.
    length = max(float(settings.chain_length), 1.33 * draws / walkers)
    longest = PROFILES["reference"]["chain_length"]
    found = replace(
        settings, source_pixels=(ny, nx), draws=draws, walkers=walkers, chain_length=min(length, longest),
        max_steps=PROFILES["reference"]["max_steps"],
    )  # fmt: skip
    found = _affordable(found)
    # A walk that may be longer is no other one.
    return None if replace(found, max_steps=settings.max_steps) == settings else found


def not_kept(estimates: Sequence[Estimate], max_error: float) -> tuple[str, ...]:
    """A warning for each magnitude, n in the wide range, whose error is not known to be what was asked for."""
    told = []
    for one in estimates:
        if one.index_prior != "wide":
            continue
        if one.budget is None:
            told.append(f"max_error: the numerical error of {one.estimator} could not be predicted")
        elif one.budget.magnitude.total > max_error:
            error = one.budget.magnitude.total
            told.append(
                f"max_error: {one.estimator} has a numerical error of {error:.2g} mag, {max_error:g} is asked for"
            )
    return tuple(told)


def _wanted(estimate: Estimate, max_error: float) -> _Wanted:
    """What one estimate needs to be within what is allowed."""
    if estimate.budget is None:
        raise ValueError("estimate: got one without a budget")
    found, allowed = estimate.budget.magnitude, (_AIM * max_error) ** 2
    grid = min(found.grid, _OF_GRID * _AIM * max_error)
    # The error of the grid falls with the area of a cell.
    finer = math.sqrt(found.grid / grid) if grid > 0.0 else 1.0
    left = max(allowed - grid**2 - found.rendering**2 - found.psf**2, 0.1 * allowed)
    return _Wanted(finer, estimate.magnitude.sd**2 / left)


def _affordable(settings: Analysis) -> Analysis:
    """The same, its grid no finer than leaves the chain within the cost of a `reference` one on the default grid."""
    reference = PROFILES["reference"]
    states = settings.walkers * settings.chain_length / (reference["walkers"] * reference["chain_length"])
    ny, nx = settings.source_pixels
    most = (20 * 20) * (1.0 / states) ** (1.0 / _COST_OF_NODES)
    if ny * nx <= most:
        return settings
    shrink = math.sqrt(most / (ny * nx))
    return replace(settings, source_pixels=(max(2, int(ny * shrink)), max(2, int(nx * shrink))))
