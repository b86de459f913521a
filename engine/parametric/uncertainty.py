"""How well a fit knows its parameters, and what that says of the host with each prior of n."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy import ndimage, stats

from engine.conventions import FloatArray
from engine.parametric.host_posterior import HostPosterior
from engine.parametric.model import ImageModel
from engine.parametric.parameters import HOST_FLUX
from engine.parametric.solution import Solution, minimise_held
from engine.result import INDEX_RANGES, IndexPrior

_TAIL = 8.0


def parameter_covariance(model: ImageModel, jacobian: FloatArray, held: int | None = None) -> FloatArray:
    """Covariance (k, k) of the k parameters and amplitudes of a fit, of its full Jacobian.

    H^-1 (H + S) H^-1 with H = J^T J and S what pixels share. Parameter ``held`` has no variance.
    """
    shared = _shared(model, model.decorrelated(jacobian[: model.data.size]))
    free = np.delete(np.arange(jacobian.shape[1]), [] if held is None else held)
    chosen = jacobian if held is None else jacobian[:, free]
    scale = np.sqrt((chosen**2).sum(axis=0))
    scale[scale == 0.0] = 1.0
    scaled = chosen / scale
    inverse = np.linalg.pinv(scaled.T @ scaled, rcond=1e-12, hermitian=True)
    joint = inverse + inverse @ (shared[np.ix_(free, free)] / np.outer(scale, scale)) @ inverse
    out = np.zeros_like(shared)
    out[np.ix_(free, free)] = joint / np.outer(scale, scale)
    return out


def _shared(model: ImageModel, jacobian: FloatArray) -> FloatArray:
    """J^T (C - diag C) J of the whitened Jacobian: what pixels share of their noise and of the error of AGN images."""
    observation = model.observation
    shape, size = observation.shape, jacobian.shape[1]
    noise = np.where(observation.valid, observation.noise, 0.0)
    inside = np.where(np.isfinite(model.sigma), model.sigma, 0.0)
    stamp = np.sqrt(np.maximum(inside**2 - noise**2, 0.0)) * (inside > 0)
    out = np.zeros((size, size))
    width = observation.optics.error_correlation
    if width > 0.0 and stamp.any():
        moved = (jacobian.reshape(*shape, size) * (stamp.ravel() * model.weight).reshape(*shape, 1)).copy()
        # A Gaussian filter has unit sum; the correlation of a pixel with itself is one.
        smooth = ndimage.gaussian_filter(moved, (width, width, 0.0), mode="constant") * (2.0 * math.pi * width**2)
        flat = moved.reshape(-1, size)
        out += flat.T @ (smooth.reshape(-1, size) - flat)
    if observation.covariance is not None:
        shared = observation.covariance.copy()
        shared.setdiag(0.0)
        weighted = jacobian * model.weight[:, None]
        out += weighted.T @ (shared @ weighted)
    return 0.5 * (out + out.T)


def positive_mean(flux: float, deviation: float) -> float:
    """Mean of a normal distribution above zero: of a host whose best flux is negative."""
    ratio = flux / deviation
    # Far below zero the tail falls as an exponential of this length.
    return deviation * float(stats.truncnorm.mean(-ratio, np.inf, loc=ratio)) if ratio > -_TAIL else -deviation / ratio


def host_posteriors(
    solution: Solution, flux: float, covariance: FloatArray, inflation: float, fixed_index: float | None
) -> dict[IndexPrior, HostPosterior]:
    """The host with each prior of n, from a solution with the widest and its covariance, ``inflation`` included.

    ``flux`` [e-/s] is its own, or a positive one that stands for it. A maximum inside a narrower range is that range's
    too. One outside ends at its bound: everything else is fitted again with n held there. A prior with which the host
    has no light is left out.
    """
    values, at_n = solution.values, solution.space.host_slice.start + 1
    ranges = INDEX_RANGES if fixed_index is None else {**INDEX_RANGES, "fixed": (fixed_index, fixed_index)}
    wide = _host_posterior(solution, flux, covariance)
    out: dict[IndexPrior, HostPosterior] = {"wide": wide}
    for prior, (low, high) in ranges.items():
        if prior == "wide":
            continue
        if low < values[at_n] < high:
            out[prior] = wide.inside(low, high)
            continue
        held = float(np.clip(values[at_n], low, high))
        shift = covariance[: values.size, at_n] / covariance[at_n, at_n] * (held - values[at_n])
        found = minimise_held(solution, values + shift, at_n, held)
        jacobian, amplitudes = found.model.full_jacobian(found.values)
        bright = float(amplitudes[HOST_FLUX])
        if bright > 0:
            known = inflation * parameter_covariance(found.model, jacobian, at_n)
            out[prior] = replace(_host_posterior(found, bright, known).inside(held, held), n_at_bound=low < high)
    return out


def _host_posterior(solution: Solution, flux: float, covariance: FloatArray) -> HostPosterior:
    """The host's part of a covariance of all parameters and amplitudes."""
    space = solution.space
    where, ended = space.host_slice, solution.at_bound
    return HostPosterior(
        mean=np.array([math.log(flux), *solution.values[where]]),
        covariance=space.host_block(covariance, flux),
        low=np.array([-math.inf, *solution.low[where]]),
        high=np.array([math.inf, *solution.high[where]]),
        n_at_bound="host.n" in ended,
        r_eff_at_bound="host.ln_r_eff" in ended,
    )
