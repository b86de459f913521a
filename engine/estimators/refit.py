"""The estimators that fit drawn sources, on all draws of one chain.

Their fits start from one reference fit, that of the first draw, and from the centres that the estimator before found
for each draw: the mean source is fitted first, from its moments. The widest range of n is fitted first; where a draw's
fit lies within a narrower range, it is that range's fit too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.conventions import FloatArray
from engine.estimators.covariance import CovarianceMetric
from engine.estimators.draws import SourceDraw
from engine.estimators.least_squares import Fits, Metric, fit_shapes, scatter
from engine.estimators.paper import PaperMetric
from engine.estimators.projected import ProjectedMetric
from engine.estimators.sersic_fit import Refit, SersicFit
from engine.light.cell_means import LN_R_EFF, N, X, Y
from engine.light.sersic import profile_of
from engine.result import INDEX_RANGES, IndexPrior
from engine.spec.analysis import EstimatorName

_BOUND_MARGIN = 1e-3
_START_INDICES = (0.8, 2.0, 4.0)


def _moments(draw: SourceDraw) -> FloatArray:
    """Start values from the brightest part of the mean source; the middle of the grid where nothing is bright."""
    grid, source = draw.grid, draw.mean
    y, x = np.meshgrid(grid.y, grid.x, indexing="ij")
    weight = np.clip(source - 0.1 * source.max(), 0.0, None) * grid.cell_areas
    if not weight.sum() > 0 or not source.max() > 0:
        weight = grid.cell_areas.copy()
    weight = weight / weight.sum()
    cx, cy = float((weight * x).sum()), float((weight * y).sum())
    xx, yy, xy = (float((weight * u).sum()) for u in ((x - cx) ** 2, (y - cy) ** 2, (x - cx) * (y - cy)))
    size = max(xx + yy, float(grid.cell_areas.min()))
    e = np.clip(0.5 * np.array([(xx - yy) / size, 2 * xy / size]), -0.5, 0.5)
    return np.array([0.5 * math.log(size), 2.0, *e, cx, cy])


@dataclass(frozen=True)
class _Bounds:
    """Bounds (K, 6) of the draws' shapes for one prior of n."""

    low: FloatArray
    high: FloatArray

    @classmethod
    def of(cls, draws: Sequence[SourceDraw], index_range: tuple[float, float]) -> _Bounds:
        low, high = zip(*(draw.bounds(index_range) for draw in draws), strict=True)
        return cls(np.array(low), np.array(high))

    def hold(self, shapes: FloatArray) -> NDArray[np.bool_]:
        """Which of the shapes (K, 6) lie inside, off the bounds."""
        return np.asarray(((shapes > self.low) & (shapes < self.high)).all(axis=1))


def _first_start(draw: SourceDraw, bounds: _Bounds) -> FloatArray:
    """Fit (6,) to the mean source of a draw, the best of several starts."""
    starts = np.repeat(_moments(draw)[None], len(_START_INDICES), axis=0)
    starts[:, N] = _START_INDICES
    every = np.zeros(len(starts), dtype=np.intp)
    metric = PaperMetric([draw], [draw.mean])
    low, high = (np.repeat(side[:1], len(starts), axis=0) for side in (bounds.low, bounds.high))
    fits = fit_shapes(metric, every, starts, low, high)
    gain = fits.fluxes * metric.normal_equations(every, fits.shapes).right[:, -1]
    return np.asarray(fits.shapes[int(np.argmax(np.where(fits.fluxes > 0, gain, -np.inf)))])


def metric_of(estimator: EstimatorName, draws: Sequence[SourceDraw]) -> Metric:
    """What an estimator minimises for each of the draws."""
    match estimator:
        case "paper":
            return PaperMetric(draws, [draw.drawn for draw in draws])
        case "covariance":
            return CovarianceMetric(draws)
        case "projected":
            return ProjectedMetric(draws)
        case _:
            raise ValueError(f"estimator: got {estimator!r}, allowed are those that fit a drawn source")


def _fit(metric: Metric, starts: FloatArray, bounds: _Bounds, wider: Fits | None) -> Fits:
    """Fit the first draw from its start, and all draws from there, each with the centre of its own start (K, 6).

    The lens moves the source between the draws: against a peaked profile elsewhere the fit would rather blunt it than
    move it. With ``wider``, fits with a wider prior of n, only draws whose fit lies outside are fitted again, from that
    fit.
    """
    if wider is not None:
        outside = np.flatnonzero(~bounds.hold(wider.shapes))
        if not outside.size:
            return wider
        low, high = bounds.low[outside], bounds.high[outside]
        return wider.replaced(outside, fit_shapes(metric, outside, wider.shapes[outside], low, high))
    every = np.arange(len(bounds.low))
    reference = fit_shapes(metric, every[:1], starts[:1], bounds.low[:1], bounds.high[:1]).shapes[0]
    moved = np.repeat(reference[None], every.size, axis=0)
    moved[:, (X, Y)] += starts[:, (X, Y)] - starts[0, (X, Y)]
    return fit_shapes(metric, every, moved, bounds.low, bounds.high)


def _flagged(fits: Fits, shapes: FloatArray, fluxes: FloatArray, bounds: _Bounds) -> tuple[SersicFit | None, ...]:
    margin = _BOUND_MARGIN * (bounds.high - bounds.low)
    at_bound = (fits.shapes - bounds.low < margin) | (bounds.high - fits.shapes < margin)
    out: list[SersicFit | None] = []
    for k, (shape, flux) in enumerate(zip(shapes, fluxes, strict=True)):
        found = bool(fits.converged[k]) and flux > 0 and fits.fluxes[k] > 0 and math.isfinite(flux)
        out.append(
            SersicFit(profile_of(shape, float(flux)), bool(at_bound[k, N]), bool(at_bound[k, LN_R_EFF]))
            if found
            else None
        )
    return tuple(out)


def refit_draws(
    draws: Sequence[SourceDraw],
    estimators: Sequence[EstimatorName],
    fixed_index: float | None,
    rng: np.random.Generator | None,
) -> list[Refit]:
    """Refit draws (one at least) by every estimator that fits drawn sources.

    With n free, n in a wide range, and n held at ``fixed_index`` if there is one. A fit that does not converge, or
    whose flux is not positive, is None. Without ``rng`` all fits are those of least chi^2, with nothing drawn.
    """
    ranges = dict(INDEX_RANGES)
    if fixed_index is not None:
        ranges["fixed"] = (fixed_index, fixed_index)
    bounds = {prior: _Bounds.of(draws, index_range) for prior, index_range in ranges.items()}
    starts = np.repeat(_first_start(draws[0], bounds["wide"])[None], len(draws), axis=0)
    seeds = None if rng is None else [int(seed) for seed in rng.integers(2**63, size=len(draws))]
    out = []
    for estimator in estimators:
        found, wide = _refit_sources(estimator, draws, starts, bounds, seeds)
        starts = np.where((wide.fluxes > 0)[:, None], wide.shapes, starts)
        out += found
    return out


def _refit_sources(
    estimator: EstimatorName,
    draws: Sequence[SourceDraw],
    starts: FloatArray,
    bounds: dict[IndexPrior, _Bounds],
    seeds: Sequence[int] | None,
) -> tuple[list[Refit], Fits]:
    """An estimator that fits each drawn source, with every prior of n, the widest first; and its fits with that."""
    metric, every = metric_of(estimator, draws), np.arange(len(draws))
    out: list[Refit] = []
    first: Fits | None = None
    spread: tuple[FloatArray, FloatArray] | None = None
    for prior, inside in bounds.items():
        fits = _fit(metric, starts, inside, first if prior == "free" else None)
        if first is None:
            first = fits
            starts = np.where((fits.fluxes > 0)[:, None], fits.shapes, starts)
        # The same random numbers for every prior: what differs between them is not chance, and scatter that stays
        # within a narrower range need not be drawn again.
        if not (fits is first and spread is not None and inside.hold(spread[0]).all()):
            spread = fits.shapes, fits.fluxes
            if isinstance(metric, ProjectedMetric) and seeds is not None:
                # Its chi^2 is that of the data: the source's own scatter is not in the draws that it sees.
                generators = [np.random.default_rng(seed) for seed in seeds]
                spread = scatter(metric, every, fits, inside.low, inside.high, generators)
        out.append(Refit(estimator, prior, _flagged(fits, *spread, inside)))
    if first is None:
        raise ValueError("bounds: got none, allowed is one prior of n at least")
    return out, first
