"""Bounded least squares with a linear flux, for many draws at a time.

Each draw has a sum of squares chi^2(p, f) = f^2 m^T W m - 2 f m^T b in the shape parameters p of a model m(p) of unit
flux. The flux f is solved for at every step (variable projection), the shape moves by damped Gauss-Newton steps inside
its bounds. The draws move in step, so that a metric whose W they share multiplies all their models by it at once; scipy
would fit one at a time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from engine.conventions import FloatArray
from engine.light.cell_means import COLUMNS

_FLUX = COLUMNS - 1
_MAX_ROUNDS = 40
_FIRST_DAMPING, _MIN_DAMPING, _MAX_DAMPING = 1e-3, 1e-6, 1e8
_CALMER, _STRONGER = 0.1, 10.0
_ENOUGH = 1e-3
"""A predicted gain in half the chi^2 below this ends a fit: 0.05 of a standard deviation at most."""


@dataclass(frozen=True)
class NormalEquations:
    """Products of k draws: C^T W C (k, COLUMNS, COLUMNS) and C^T b (k, COLUMNS).

    C holds the derivatives of the unit-flux model by its shape, then the model m itself. ``unit`` (k,) is the gain in
    chi^2 that counts as one standard deviation.
    """

    gram: FloatArray
    right: FloatArray
    unit: FloatArray


class Metric(Protocol):
    """The sum of squares of an estimator, for each of its draws."""

    def normal_equations(self, which: NDArray[np.intp], shapes: FloatArray) -> NormalEquations:
        """The normal equations of the draws ``which`` (k,) at their shapes (k, 6)."""
        ...


@dataclass(frozen=True)
class Fits:
    """Fits of K draws.

    ``shapes`` (K, 6); ``fluxes`` (K,), which may be negative; ``value`` (K,), ``gradient`` (K, 6) and ``hessian``
    (K, 6, 6) of half the chi^2 by the shape, flux profiled out and a constant left out; ``converged`` (K,).
    """

    shapes: FloatArray
    fluxes: FloatArray
    value: FloatArray
    gradient: FloatArray
    hessian: FloatArray
    converged: NDArray[np.bool_]

    def replaced(self, which: NDArray[np.intp], fits: Fits) -> Fits:
        """These fits with those of the draws ``which`` taken from ``fits``."""
        merged = {}
        for field in fields(self):
            merged[field.name] = getattr(self, field.name).copy()
            merged[field.name][which] = getattr(fits, field.name)
        return Fits(**merged)


@dataclass(frozen=True)
class _Profiled:
    """Half the chi^2 with the flux profiled out: value (k,), gradient (k, 6), Gauss-Newton hessian (k, 6, 6)."""

    value: FloatArray
    gradient: FloatArray
    hessian: FloatArray
    flux: FloatArray
    unit: FloatArray


def _best_flux(norm: FloatArray, right: FloatArray) -> FloatArray:
    """Flux that minimises the chi^2, zero where the model puts no light on the data."""
    bright = norm > 0
    return np.where(bright, right / np.where(bright, norm, 1.0), 0.0)


def _profile_out(equations: NormalEquations) -> _Profiled:
    gram, right = equations.gram, equations.right
    flux = _best_flux(gram[:, _FLUX, _FLUX], right[:, _FLUX])
    by_flux = gram[:, :_FLUX, _FLUX]
    gradient = flux[:, None] * (flux[:, None] * by_flux - right[:, :_FLUX])
    norm = gram[:, _FLUX, _FLUX, None, None]
    shadow = by_flux[:, :, None] * by_flux[:, None, :] / np.where(norm > 0, norm, 1.0)
    hessian = (flux**2)[:, None, None] * (gram[:, :_FLUX, :_FLUX] - shadow)
    return _Profiled(-0.5 * flux * right[:, _FLUX], gradient, hessian, flux, equations.unit)


def _bounded_step(
    gradient: FloatArray, hessian: FloatArray, point: FloatArray, low: FloatArray, high: FloatArray, damping: FloatArray
) -> FloatArray:
    """Steps (k, 6) that minimise the damped quadratic model inside the bounds; what would cross one stops there."""
    k, d = gradient.shape
    # Where the model puts no light on the data, rounding is all that is left of the curvature.
    diagonal = np.maximum(np.einsum("kii->ki", hessian), 0.0)
    floor = 1e-12 * diagonal.max(axis=1)[:, None] + 1e-200
    damped = hessian.copy()
    damped[:, range(d), range(d)] = (1.0 + damping[:, None]) * diagonal + floor
    pinned = np.zeros((k, d), dtype=np.bool_)
    shift = np.zeros((k, d))
    for _ in range(d + 1):
        free = ~pinned
        matrix = np.where(free[:, :, None] & free[:, None, :], damped, np.eye(d))
        right = np.where(free, -gradient - np.einsum("kij,kj->ki", damped, np.where(pinned, shift, 0.0)), 0.0)
        scale = 1.0 / np.sqrt(np.einsum("kii->ki", matrix))
        scaled = matrix * scale[:, :, None] * scale[:, None, :]
        shift = np.where(pinned, shift, scale * np.linalg.solve(scaled, (scale * right)[..., None])[..., 0])
        below, above = free & (point + shift < low), free & (point + shift > high)
        if not (below | above).any():
            break
        shift = np.where(below, low - point, np.where(above, high - point, shift))
        pinned |= below | above
    return shift


def fit_shapes(metric: Metric, which: NDArray[np.intp], starts: FloatArray, low: FloatArray, high: FloatArray) -> Fits:
    """Minimise the metric over shape and flux of the draws ``which`` (K,).

    Parameters
    ----------
    metric : Metric
    which : array (K,)
    starts, low, high : arrays (K, 6)
        Where each draw starts, and its bounds; a parameter with equal bounds is held.
    """
    point = np.clip(starts, low, high)
    best = _profile_out(metric.normal_equations(which, point))
    damping = np.full(len(point), _FIRST_DAMPING)
    done = np.zeros(len(point), dtype=np.bool_)
    for _ in range(_MAX_ROUNDS):
        active = np.flatnonzero(~done)
        gradient, hessian = best.gradient[active], best.hessian[active]
        step = _bounded_step(gradient, hessian, point[active], low[active], high[active], damping[active])
        gain = -(gradient * step).sum(axis=1) - 0.5 * np.einsum("ki,kij,kj->k", step, hessian, step)
        small = gain < _ENOUGH * best.unit[active]
        done[active[small]] = True
        active, step = active[~small], step[~small]
        if not active.size:
            break
        trial = np.clip(point[active] + step, low[active], high[active])
        found = _profile_out(metric.normal_equations(which[active], trial))
        better = (found.value < best.value[active]) & np.isfinite(found.value)
        kept = active[better]
        point[kept] = trial[better]
        for name in ("value", "gradient", "hessian", "flux", "unit"):
            getattr(best, name)[kept] = getattr(found, name)[better]
        damping[active] = np.clip(damping[active] * np.where(better, _CALMER, _STRONGER), _MIN_DAMPING, None)
        # No step is small enough any more: rounding, or a metric that is not smooth at this scale.
        done[active[damping[active] > _MAX_DAMPING]] = True
    return Fits(point, best.flux, best.value, best.gradient, best.hessian, done)


def scatter(
    metric: Metric,
    which: NDArray[np.intp],
    fits: Fits,
    low: FloatArray,
    high: FloatArray,
    generators: Sequence[np.random.Generator],
) -> tuple[FloatArray, FloatArray]:
    """Shapes (K, 6) and fluxes (K,) drawn from the posterior given the lens, for a metric that is a chi^2 of data.

    The shape is drawn from the Gaussian of the fit, cut off at the bounds, the flux from its own given the shape. Where
    the Gaussian lies so far outside that none of many draws is inside, the parameters at a bound are held there.
    """
    shapes = np.array(
        [
            _truncated(fits.shapes[k], fits.gradient[k], fits.hessian[k], low[k], high[k], generators[k])
            for k in range(len(fits.shapes))
        ]
    )
    found = metric.normal_equations(which, shapes)
    norm = found.gram[:, _FLUX, _FLUX]
    noise = np.array([rng.standard_normal() for rng in generators])
    return shapes, _best_flux(norm, found.right[:, _FLUX] + noise * np.sqrt(np.maximum(norm, 0.0)))


_TRIES = 256


def _truncated(
    shape: FloatArray, gradient: FloatArray, hessian: FloatArray, low: FloatArray, high: FloatArray,
    rng: np.random.Generator,
) -> FloatArray:  # fmt: skip
    normal = rng.standard_normal((_TRIES, shape.size))
    at_bound = (shape <= low) | (shape >= high)
    for free in (low < high, (low < high) & ~at_bound):
        scale = 1.0 / np.sqrt(np.maximum(np.diag(hessian)[free], 1e-300))
        values, vectors = np.linalg.eigh(hessian[np.ix_(free, free)] * np.outer(scale, scale))
        values = np.maximum(values, 1e-8)
        centre = -vectors @ ((vectors.T @ (scale * gradient[free])) / values)
        moved = scale * (centre + (normal[:, free] / np.sqrt(values)) @ vectors.T)
        tried = np.repeat(shape[None, :], _TRIES, axis=0)
        tried[:, free] += moved
        inside = ((tried >= low) & (tried <= high)).all(axis=1)
        if inside.any():
            return np.asarray(tried[inside.argmax()])
    return np.asarray(np.clip(tried[0], low, high))
