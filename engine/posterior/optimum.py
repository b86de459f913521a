"""The maximum of the posterior and its Gaussian approximation, by Newton steps on a measured quadratic model."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from engine.conventions import FloatArray
from engine.errors import InversionError, PosteriorError
from engine.lensing.power_law import PowerLawLens
from engine.likelihood.strength import find_strength
from engine.posterior.target import Recorded, Target

_MAX_ROUNDS = 16
_MAX_STEP = 4.0
_STRENGTH_SD = 0.3
_NEAR, _WITHIN = 0.5, 2.0
"""Gains of ln of the target that a step promises below which mixed derivatives are measured, and a step with them is
the last one."""
_LEAST_CURVATURE = 0.05


@dataclass(frozen=True)
class Laplace:
    """Maximum and covariance of the Gaussian that matches the curvature there.

    ``known`` are the points (n, d) where the target was evaluated on the way, and its finite ln (n,) at them.
    """

    mean: FloatArray
    covariance: FloatArray
    ln_posterior: float
    rounds: int
    known: tuple[FloatArray, FloatArray] | None = None


def optimal_strength(target: Target, lens: PowerLawLens, low: float = -40.0, high: float = 20.0) -> float:
    """Ln lambda that maximises the evidence of a lens, to 1e-3, between ``low`` and ``high`` and inside the prior.

    The factorisations that it took count as evaluations of the target.

    Raises
    ------
    PosteriorError
        There is no maximum inside the interval.
    """
    low, high = max(low, float(target.prior.low[-1])), min(high, float(target.prior.high[-1]))
    try:
        found = find_strength(target.likelihood, lens, target.source, low=low, high=high)
    except InversionError as error:
        raise PosteriorError(f"{error} ({lens})") from error
    target.evaluations += found.factorisations
    return found.ln_lambda


def _slopes(
    target: Recorded, centre: FloatArray, value: float, root: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Gradient and second derivatives (d,) of the target along the axes z of centre + root z, and it one step ahead.

    From steps of one; an axis along which the target is nothing is taken for flat and as wide as one.
    """
    forward, backward = np.split(target.many(np.vstack([centre + root.T, centre - root.T])), 2)
    usable = np.isfinite(forward) & np.isfinite(backward)
    gradient = np.where(usable, 0.5 * (forward - backward), 0.0)
    return gradient, np.where(usable, forward - 2.0 * value + backward, -1.0), np.where(usable, forward, -math.inf)


def _hessian(
    target: Recorded, centre: FloatArray, value: float, root: FloatArray, forward: FloatArray, diagonal: FloatArray
) -> FloatArray:
    """The Hessian (d, d) in the same coordinates, of which :func:`_slopes` gave the rest."""
    hessian = np.diag(diagonal)
    usable = np.isfinite(forward)
    pairs = [(i, j) for i in range(diagonal.size) for j in range(i) if usable[i] and usable[j]]
    both = target.many(np.array([centre + root[:, i] + root[:, j] for i, j in pairs]).reshape(-1, diagonal.size))
    for (i, j), found in zip(pairs, both, strict=True):
        if math.isfinite(found):
            hessian[i, j] = hessian[j, i] = found - forward[i] - forward[j] + value
    return hessian


def find_optimum(target: Target, start: FloatArray, covariance: FloatArray) -> Laplace:
    """Climb from ``start`` with steps scaled by ``covariance`` (of the parameters, ln lambda included).

    Each round measures gradient and second derivatives over one standard deviation (so that roughness of the evidence
    below that scale does not mislead), takes the Newton step of a negative definite version, shortened until it climbs,
    and rescales the coordinates. Far from the maximum the mixed derivatives, most of the evaluations, are left out
    every other time: the axes are those of the covariance. It ends with a step from less than two deviations away,
    measured with them: what is left then is a tenth of that.

    Raises
    ------
    PosteriorError
        The posterior is not finite at the start.
    """
    known = Recorded(target)
    mean = start.copy()
    value = known(mean)
    if not math.isfinite(value):
        raise PosteriorError(
            f"start {dict(zip(target.prior.names, start.tolist(), strict=True))}: posterior not finite"
        )
    root: FloatArray = np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)
    rounds, near = 0, False
    while rounds < _MAX_ROUNDS and not near:
        rounds += 1
        gradient, diagonal, forward = _slopes(known, mean, value, root)
        hessian = np.diag(diagonal)
        near = 0.5 * float((gradient**2 / _steepness(diagonal)).sum()) < _NEAR
        if near or rounds % 2 == 0:
            hessian = _hessian(known, mean, value, root, forward, diagonal)
        eigenvalues, vectors = np.linalg.eigh(hessian)
        curvature = _steepness(eigenvalues)
        projected = vectors.T @ gradient
        step = vectors @ (projected / curvature)
        near &= 0.5 * float((projected**2 / curvature).sum()) < _WITHIN
        length = float(np.abs(step).max())
        step *= min(1.0, _MAX_STEP / max(length, 1e-300))
        for _ in range(6):
            candidate = mean + root @ step
            trial = known(candidate)
            if trial > value:
                mean, value = candidate, trial
                break
            step *= 0.4
        root = root @ (vectors / np.sqrt(curvature)) @ vectors.T
        root = np.asarray(np.linalg.cholesky(root @ root.T), dtype=np.float64)
    return Laplace(mean, root @ root.T, value, rounds, (np.array(known.points), np.array(known.values)))


def _steepness(second: FloatArray) -> FloatArray:
    """What second derivatives, of coordinates that are about right, are divided by: never flat, never a saddle."""
    return np.clip(np.abs(second), _LEAST_CURVATURE, None)


def start_covariance(lens_covariance: FloatArray, inflation: float = 2.0) -> FloatArray:
    """Covariance of all parameters for :func:`find_optimum`, from that of the lens parameters of the parametric fit.

    Inflated, because the inversion lets the source be anything; ln lambda gets a spread of its own.
    """
    d = lens_covariance.shape[0]
    out = np.zeros((d + 1, d + 1))
    out[:d, :d] = inflation * 0.5 * (lens_covariance + lens_covariance.T)
    out[np.arange(d), np.arange(d)] *= 1.0 + 1e-6
    out[d, d] = _STRENGTH_SD**2
    return out
