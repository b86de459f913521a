"""Sersic refits of reconstructed sources: one chain of draws, several estimators.

``paper``: an unweighted least-squares fit to the drawn source map, as GALFIT does without a sigma image.

``projected``: the Sersic profile on the source grid that minimises s^T F s - 2 s^T D, which is the image-plane chi^2 up
to a constant, so that the regularisation cannot bias it. The draw then adds the scatter of the fit given lens and data,
from the curvature of that chi^2.

In both the flux is linear and is solved for (variable projection).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg, optimize
from scipy.linalg import lapack

from engine.compiled import kernel
from engine.conventions import FloatArray, position_angle, rate_to_magnitude
from engine.errors import InversionError
from engine.inversion.evidence import Inversion
from engine.inversion.mapping import SourceGrid
from engine.light.sersic import SersicProfile, kernel_arguments
from engine.result import Estimate, EstimatorName, IndexPrior, Quantity

INDEX_RANGE = (1.0, 4.0)
"""Section 4.2: 'we constrain n to be in the range 1-4'."""

_MAX_ELLIPTICITY = 0.7
_BOUND_MARGIN = 1e-3
_RANK_TOLERANCE = 1e-12


@dataclass(frozen=True)
class SourceDraw:
    """One draw: the inversion at a state of the chain, and a source map (ny, nx) drawn from its posterior."""

    inversion: Inversion
    source: FloatArray


@dataclass(frozen=True)
class SersicFit:
    """One fit: the profile, and whether n or the radius ended at a bound."""

    profile: SersicProfile
    at_bound: bool


@kernel
def _mean_profile(xe: FloatArray, ye: FloatArray, light: FloatArray) -> FloatArray:
    """Mean surface brightness over cells between edges: many points near the centre, few elsewhere."""
    nx, ny = xe.size - 1, ye.size - 1
    out = np.empty(nx * ny)
    for j in range(ny):
        dy = ye[j + 1] - ye[j]
        for i in range(nx):
            dx = xe[i + 1] - xe[i]
            away_x = abs(xe[i] + 0.5 * dx - light[7]) / dx
            away_y = abs(ye[j] + 0.5 * dy - light[8]) / dy
            distance = max(away_x, away_y)
            points = 9 if distance < 1.5 else (5 if distance < 4.0 else 2)
            total = 0.0
            for b in range(points):
                v0 = ye[j] + (b + 0.5) / points * dy - light[8]
                for a in range(points):
                    u0 = xe[i] + (a + 0.5) / points * dx - light[7]
                    u = light[5] * u0 + light[6] * v0
                    v = light[5] * v0 - light[6] * u0
                    z = (light[4] * u * u + v * v / light[4]) * light[3]
                    total += math.exp(-light[1] * z ** light[2])
            out[j * nx + i] = light[0] * total / (points * points)
    return out


def profile_on_grid(profile: SersicProfile, grid: SourceGrid) -> FloatArray:
    """Mean surface brightness [e-/s arcsec^-2] of a profile over the cell round each node, (ny nx,)."""
    return np.asarray(_mean_profile(grid.x_edges, grid.y_edges, kernel_arguments(profile)))


@dataclass(frozen=True)
class _LeastSquares:
    """|transform @ s - target|^2 over source vectors s: an estimator's metric."""

    transform: Callable[[FloatArray], FloatArray]
    target: FloatArray


def _paper_metric(draw: SourceDraw) -> _LeastSquares:
    """Every part of the source plane counts alike: weights are the square roots of the cells' areas."""
    root = np.sqrt(draw.inversion.grid.cell_areas / draw.inversion.grid.cell_areas.mean()).ravel()
    return _LeastSquares(lambda source: root * source, root * draw.source.ravel())


def _projected_metric(draw: SourceDraw) -> _LeastSquares:
    """s^T F s - 2 s^T D as a sum of squares, by a pivoted Cholesky factorisation of the rank-deficient F."""
    f = draw.inversion.curvature
    factor, pivots, rank, info = lapack.dpstrf(f, lower=0, tol=_RANK_TOLERANCE * float(np.diag(f).max()))
    if info < 0 or rank == 0:
        raise InversionError(f"curvature F of the draw: rank {rank}, the data do not constrain the source")
    order = pivots - 1
    upper = np.triu(factor)[:rank]
    target = linalg.solve_triangular(upper[:, :rank], draw.inversion.data_vector[order[:rank]], trans="T")
    return _LeastSquares(lambda source: upper @ source[order], target)


def _profile(values: Sequence[float] | FloatArray, fixed_index: float | None) -> SersicProfile:
    ln_r, e1, e2, x, y, *rest = (float(value) for value in values)
    e = min(math.hypot(e1, e2), 0.9)
    n = rest[0] if fixed_index is None else fixed_index
    return SersicProfile(1.0, math.exp(ln_r), n, (1 - e) / (1 + e), 0.5 * math.atan2(e2, e1), x, y)


def _moments(draw: SourceDraw) -> FloatArray:
    """Start values ln r, e1, e2, x, y, n from the brightest part of the mean source of the draw's inversion."""
    grid, source = draw.inversion.grid, draw.inversion.source
    y, x = np.meshgrid(grid.y, grid.x, indexing="ij")
    weight = np.clip(source - 0.1 * source.max(), 0.0, None) * grid.cell_areas
    if not weight.sum() > 0:
        raise InversionError("source of the draw: nowhere positive, no profile can be fitted")
    weight = weight / weight.sum()
    cx, cy = float((weight * x).sum()), float((weight * y).sum())
    xx, yy, xy = (float((weight * u).sum()) for u in ((x - cx) ** 2, (y - cy) ** 2, (x - cx) * (y - cy)))
    size = max(xx + yy, float(grid.cell_areas.min()))
    e = 0.5 * np.array([(xx - yy) / size, 2 * xy / size])
    return np.array([0.5 * math.log(size), *np.clip(e, -0.5, 0.5), cx, cy, 2.0])


def _fit(
    draw: SourceDraw, metric: _LeastSquares, start: FloatArray, fixed_index: float | None
) -> tuple[SersicFit, FloatArray, optimize.OptimizeResult]:
    grid = draw.inversion.grid
    left, right, bottom, top = grid.extent
    e = _MAX_ELLIPTICITY
    pitch = math.sqrt(float(grid.cell_areas.min()))
    low = [math.log(0.1 * pitch), -e, -e, left, bottom, INDEX_RANGE[0]]
    high = [math.log(5.0 * max(right - left, top - bottom)), e, e, right, top, INDEX_RANGE[1]]
    size = 6 if fixed_index is None else 5

    def flux_and_residual(values: FloatArray) -> tuple[float, FloatArray]:
        model = metric.transform(profile_on_grid(_profile(values, fixed_index), grid))
        norm = float(model @ model)
        flux = float(model @ metric.target) / norm if norm > 0 else 0.0
        return flux, flux * model - metric.target

    # Residuals in units of the target's size keep the tolerances meaningful for any estimator's metric.
    unit = float(np.sqrt(metric.target @ metric.target)) or 1.0
    lower, upper = np.array(low[:size]), np.array(high[:size])
    found = optimize.least_squares(
        lambda values: flux_and_residual(values)[1] / unit,
        np.clip(start[:size], lower + 1e-6, upper - 1e-6),
        bounds=(lower, upper),
        x_scale=np.array([0.3, 0.2, 0.2, pitch, pitch, 0.5])[:size],
        ftol=1e-9,
        xtol=1e-7,
        max_nfev=200,
    )
    if not found.success:
        raise InversionError(f"Sersic fit: {found.message}")
    flux, _ = flux_and_residual(found.x)
    if not flux > 0:
        raise InversionError(f"Sersic fit: flux {flux:.3g} e-/s, a positive one is needed")
    shape = _profile(found.x, fixed_index)
    span = upper - lower
    edge = (found.x - lower < _BOUND_MARGIN * span) | (upper - found.x < _BOUND_MARGIN * span)
    profile = SersicProfile(flux, shape.r_eff, shape.n, shape.q, shape.phi, shape.x, shape.y)
    found.jac = found.jac * unit
    return SersicFit(profile, bool(edge[0] or edge[5:].any())), found.x, found


def _scattered(
    draw: SourceDraw,
    metric: _LeastSquares,
    found: optimize.OptimizeResult,
    fixed_index: float | None,
    rng: np.random.Generator,
    at_bound: bool,
) -> SersicFit:
    """A draw from the Gaussian approximation of the fit's posterior given lens and data."""
    scale = np.sqrt((found.jac**2).sum(axis=0))
    free = (found.active_mask == 0) & (scale > 0)
    jacobian = found.jac[:, free] / scale[free]
    values = found.x.copy()
    covariance = np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-10)
    step = rng.multivariate_normal(np.zeros(int(free.sum())), covariance, method="eigh")
    values[free] += step / scale[free]
    if fixed_index is None:
        values[5] = float(np.clip(values[5], *INDEX_RANGE))
    values[1:3] = np.clip(values[1:3], -_MAX_ELLIPTICITY, _MAX_ELLIPTICITY)
    shape = _profile(values, fixed_index)
    model = metric.transform(profile_on_grid(shape, draw.inversion.grid))
    norm = float(model @ model)
    flux = float(model @ metric.target) / norm + rng.standard_normal() / math.sqrt(norm)
    if not flux > 0:
        raise InversionError("Sersic fit: a draw of the flux is not positive; the host is lost in the noise")
    return SersicFit(SersicProfile(flux, shape.r_eff, shape.n, shape.q, shape.phi, shape.x, shape.y), at_bound)


def fit_draws(
    draws: Sequence[SourceDraw],
    estimator: EstimatorName,
    fixed_index: float | None,
    rng: np.random.Generator,
) -> tuple[list[SersicFit], int]:
    """Fit every draw; the fits that succeeded, and how many failed.

    Parameters
    ----------
    draws : sequence of SourceDraw
    estimator : {'paper', 'projected'}
    fixed_index : float, optional
        n held at this value; free within 1-4 where None.
    rng : Generator
        For the scatter of ``projected``.

    Raises
    ------
    InversionError
        Not one draw could be fitted.
    """
    fits: list[SersicFit] = []
    last: InversionError | None = None
    start: FloatArray | None = None
    for draw in draws:
        metric = _paper_metric(draw) if estimator == "paper" else _projected_metric(draw)
        try:
            fit, values, found = _fit(draw, metric, _moments(draw) if start is None else start, fixed_index)
            if estimator == "projected":
                fit = _scattered(draw, metric, found, fixed_index, rng, fit.at_bound)
        except InversionError as error:
            last = error
            continue
        start = values
        fits.append(fit)
    if not fits:
        raise InversionError(f"{estimator} estimator: not one of {len(draws)} draws could be fitted ({last})")
    return fits, len(draws) - len(fits)


def _quantity(values: Sequence[float], truth: float | None) -> Quantity:
    array = np.array(values)
    return Quantity(float(array.mean()), float(array.std(ddof=1)) if array.size > 1 else 0.0, truth)


def _angle_quantity(angles: Sequence[float], truth: float | None) -> Quantity:
    """Mean and deviation of angles with period 180 degrees; the mean is given near the truth."""
    doubled = np.exp(2j * np.radians(np.array(angles)))
    centre = 0.5 * math.degrees(np.angle(doubled.mean()))
    away = np.array([math.remainder(angle - centre, 180.0) for angle in angles])
    mean = centre + float(away.mean())
    reference = 90.0 if truth is None else truth
    mean = reference + math.remainder(mean - reference, 180.0)
    return Quantity(mean, float(away.std(ddof=1)) if away.size > 1 else 0.0, truth)


def summarise(
    fits: Sequence[SersicFit],
    failed: int,
    estimator: EstimatorName,
    index_prior: IndexPrior,
    zero_point: float,
    truth: SersicProfile | None,
) -> Estimate:
    """Mean, deviation and bias of an estimator over its fits."""
    profiles = [fit.profile for fit in fits]
    return Estimate(
        estimator=estimator,
        index_prior=index_prior,
        magnitude=_quantity(
            [rate_to_magnitude(p.flux, zero_point) for p in profiles],
            None if truth is None else rate_to_magnitude(truth.flux, zero_point),
        ),
        r_eff=_quantity([p.r_eff for p in profiles], None if truth is None else truth.r_eff),
        n=_quantity([p.n for p in profiles], None if truth is None else truth.n),
        q=_quantity([p.q for p in profiles], None if truth is None else truth.q),
        position_angle=_angle_quantity(
            [position_angle(p.phi) for p in profiles], None if truth is None else position_angle(truth.phi)
        ),
        draws=len(fits) + failed,
        at_bound=sum(fit.at_bound for fit in fits),
        failed=failed,
    )
