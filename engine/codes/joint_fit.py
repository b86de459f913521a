"""Least squares with the images of any code: our parameters, bounds and priors, its lensing, light and blurring.

Amplitudes are solved for at every step (variable projection, Golub & Pereyra 1973); derivatives are differences.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from engine.codes.answer import CodeAnswer
from engine.conventions import FloatArray
from engine.errors import PosteriorError
from engine.imaging.observation import Observation
from engine.light.sersic import SersicProfile, profile_of, shape_of
from engine.parametric.constraints import constraints
from engine.parametric.fit import ParametricFit
from engine.parametric.parameters import BACKGROUND, HOST_FLUX, ParameterSpace
from engine.stages import Progress

Columns = Callable[[ParameterSpace, FloatArray], FloatArray]
"""Images (ny nx, amplitudes) of unit flux [1 per pixel] of a vector, in the order of the space's amplitudes."""
_STEP = 1e-4
"""Of the differences [arcsec, or of the parameter]: what codes that sample light are smooth over."""
_TOLERANCE = 1e-6
_DISPLACED = 2.0
"""Standard deviations that lens and host begin away from where ours ended: the answer is to be the code's own."""
_ROOM = 1e-6
_GALAXY_INDEX = 4.0


@dataclass(frozen=True)
class Task:
    """An image, the noise (ny, nx) [e-/s] that every code is given, infinite where a pixel does not count, and ours."""

    observation: Observation
    sigma: FloatArray
    fit: ParametricFit

    @property
    def space(self) -> ParameterSpace:
        """The components of our fit; a deflector of several Gaussians is one Sersic profile here."""
        shines = self.fit.deflector is not None or bool(self.fit.deflector_gaussians)
        return ParameterSpace(len(self.fit.agn), shines, "gamma1" in self.fit.lens_names)

    @property
    def limits(self) -> tuple[str, ...]:
        """What ours does that no other code is asked to."""
        out = ["the deflector is one Sersic profile, ours several Gaussians"] if self.fit.deflector_gaussians else []
        if self.observation.response is not None:
            out.append("one PSF for the whole image, ours has the exposures behind it")
        if self.fit.error is not None and self.fit.error.host > 0:
            out.append("a host that is a Sersic profile, ours may depart from one")
        return tuple(out)

    @property
    def deflector(self) -> SersicProfile | None:
        """Where the deflector's light begins."""
        parts = self.fit.deflector_gaussians
        if self.fit.deflector is not None or not parts:
            return self.fit.deflector
        flux = sum(one.flux for one in parts)
        radius = sum(one.flux * one.r_eff for one in parts) / flux
        return replace(parts[0], flux=flux, r_eff=radius, n=_GALAXY_INDEX)

    def start(self) -> FloatArray:
        """Our parameters, of lens and host displaced by :data:`_DISPLACED` of their errors, by turns up and down."""
        space, fit = self.space, self.fit
        places = [coordinate for image in fit.agn for coordinate in (image.x, image.y)]
        light = np.empty(0) if self.deflector is None else shape_of(self.deflector)
        ours = space.vector([(image.x, image.y) for image in fit.agn], fit.lens, 1.0, (fit.host.x, fit.host.y))
        lens, host = ours[space.lens_slice], shape_of(fit.host)
        posterior = fit.hosts["wide"]
        lens_sd = np.sqrt(np.diag(fit.lens_covariance))
        # The errors of q and phi are not those of e1 and e2, but as large.
        lens_sd[1:3] = min(lens_sd[1], 0.1)
        lens = lens + _DISPLACED * lens_sd * _by_turns(lens.size)
        host[:2] += _DISPLACED * np.sqrt(np.diag(posterior.covariance)[1:3]) * _by_turns(2)
        return np.concatenate([places, light, lens, host])


def _by_turns(size: int) -> FloatArray:
    return np.where(np.arange(size) % 2, -1.0, 1.0)


def fitted(
    task: Task, code: str, version: str, columns: Columns, *, limits: tuple[str, ...] = (),
    progress: Progress | None = None,
) -> CodeAnswer:  # fmt: skip
    """The best model of a code, with errors from its own derivatives; a PosteriorError where it finds no host."""
    began, space = time.perf_counter(), task.space
    weight = np.where(np.isfinite(task.sigma), 1.0 / task.sigma, 0.0).ravel()
    data = np.where(task.observation.valid, task.observation.image, 0.0).ravel() * weight
    start = task.start()
    low, high = space.bounds(start, task.observation.pixel_scale, {})
    start = np.clip(start, low + _ROOM * (high - low), high - _ROOM * (high - low))
    evaluations = 0

    def whitened(values: FloatArray) -> tuple[FloatArray, FloatArray]:
        nonlocal evaluations
        evaluations += 1
        if progress is not None and evaluations % (space.size + 1) == 0:
            progress(code, evaluations / (space.size + 1))
        design = columns(space, values) * weight[:, None]
        amplitudes, _, _, _ = np.linalg.lstsq(design, data, rcond=None)
        return design, amplitudes

    def residuals(values: FloatArray) -> FloatArray:
        design, amplitudes = whitened(values)
        return np.concatenate([data - design @ amplitudes, constraints(space, values, {})])

    found = least_squares(
        residuals, start, bounds=(low, high), x_scale="jac", diff_step=_STEP, ftol=_TOLERANCE, xtol=_TOLERANCE,
        max_nfev=100,
    )  # fmt: skip
    values: FloatArray = found.x
    design, amplitudes = whitened(values)
    if not amplitudes[HOST_FLUX] > 0:
        raise PosteriorError(f"{code}: the host's flux is {amplitudes[HOST_FLUX]:.3g} e-/s, a positive one is needed")
    pixels = int(np.count_nonzero(weight))
    freedom = pixels - space.size - space.amplitudes
    chi2 = float(np.sum((data - design @ amplitudes) ** 2)) / freedom
    covariance = _covariance(found.jac, design, amplitudes, lambda at: whitened(at)[1], values, max(1.0, chi2))
    return CodeAnswer(
        code=code,
        version=version,
        lens=space.lens(values),
        host=space.host(values, float(amplitudes[HOST_FLUX])),
        deflector=(
            profile_of(values[space.deflector_slice], float(amplitudes[space.n_agn])) if space.deflector else None
        ),
        agn=tuple(
            replace(image, x=float(x), y=float(y), flux=float(flux))
            for image, (x, y), flux in zip(task.fit.agn, space.agn(values), amplitudes[: space.n_agn], strict=True)
        ),
        background=float(amplitudes[BACKGROUND]),
        errors=_errors(space, values, amplitudes, covariance),
        chi2_per_dof=chi2,
        zero_point=task.observation.zero_point,
        seconds=time.perf_counter() - began,
        evaluations=evaluations,
        limits=limits,
    )


def _covariance(
    jacobian: FloatArray, design: FloatArray, amplitudes: FloatArray,
    solve: Callable[[FloatArray], FloatArray], values: FloatArray, misfit: float,
) -> FloatArray:  # fmt: skip
    """Covariance of parameters and amplitudes together, of the Jacobian (data and priors, k) of the reduced problem."""
    shape = misfit * np.linalg.pinv(jacobian.T @ jacobian, hermitian=True)
    conditional = misfit * np.linalg.pinv(design.T @ design, hermitian=True)
    slopes = np.empty((amplitudes.size, values.size))
    for k, value in enumerate(values):
        moved = values.copy()
        moved[k] += _STEP * max(abs(value), _STEP)
        slopes[:, k] = (solve(moved) - amplitudes) / (moved[k] - value)
    cross = slopes @ shape
    return np.block([[shape, cross.T], [cross, conditional + cross @ slopes.T]])


def _errors(
    space: ParameterSpace, values: FloatArray, amplitudes: FloatArray, covariance: FloatArray
) -> dict[str, float]:
    host = space.host_block(covariance, float(amplitudes[HOST_FLUX]))
    ln_flux, ln_r_eff, n = np.sqrt(np.diag(host)[:3]).tolist()
    lens = np.sqrt(np.diag(space.lens_covariance(covariance[: space.size, : space.size], values))).tolist()
    return {
        "magnitude": 2.5 / math.log(10.0) * ln_flux,
        "r_eff": float(np.exp(values[space.host_slice.start])) * ln_r_eff,
        "n": n,
        **dict(zip(space.lens_names, lens, strict=True)),
    }
