"""From quick fits to the fit of the whole image: which of them to go on with, the noise map, shear, exact light."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from engine.conventions import FloatArray, pixel_centres
from engine.lensing.power_law import PowerLawLens
from engine.parametric.misfit import misfit_significance, shared_noise
from engine.parametric.model import ImageModel, weights_sigma
from engine.parametric.model_error import learned
from engine.parametric.optics_error import learned_optics, stamp_is_wrong
from engine.parametric.parameters import BACKGROUND, HOST_FLUX, ParameterSpace
from engine.parametric.point_sources import Detection
from engine.parametric.residual_noise import measured_stamp_error, noise_scale
from engine.parametric.search import Task, agn_light
from engine.parametric.shared_error import SharedError
from engine.parametric.solution import NEAR_STEPS, TOLERANCE, Solution, minimise
from engine.parametric.uncertainty import parameter_covariance

SUBRAYS = 2
_STEPS = 40
_HOPELESS = 10.0
"""Times by which chi^2 may exceed what is accepted for errors of the model to be looked for in it."""
_DOUBTFUL = 1.5
"""Chi^2 per pixel from which on the optics are asked before a fit is made exact."""
_MISLED = 20.0
"""Chi^2 per pixel from which on a fit by a wrong PSF has led elsewhere, so that another would end there too."""
_TELLING = 0.3
"""Part of such a chi^2 that the PSF must explain."""
_ROUNDS = 3
"""Fits with errors of the model: each learns from the one before."""
_ASKED = 4.0
"""Deviations of residuals from noise from which on errors of the model of known exposures are looked for."""
_SHINING = 3.0
"""Light in that of the noise from which on a pixel may tell of such errors."""
_SHEAR_SHOWS = 4.0
"""Square of the shear in its errors below which a lens is taken to have none: two a component, as of the AIC.

Dropping a shear that there is biases all of the lens, keeping one that there is not costs a little precision.
"""
_RIVAL = 2.0
"""BIC of a quick fit, of that of the best, up to which another number of AGN images is still a rival."""
_BORDER = 3
_RADII, _LEAST_RADIUS = 3.0, 2.5
"""The image is fitted within so many Einstein radii, at least so many arcsec, and not in so many border pixels."""
_ARC_ERRORS = (0.01, 0.3)
"""Least and most part of its light by which an arc may be off."""
_FEWEST_RADII = 2.2
"""Einstein radii that are fitted even where stamps of AGN images end in them."""


def ranked(task: Task, groups: list[list[Solution]]) -> list[Solution]:
    """The two solutions to go on with, the better one first.

    A quick fit takes the cusp of a host, or what shear does to an arc, for AGN images; so the best quick fits with
    each number of them that is not out of the question, and that without, are compared as fits of full accuracy
    on one noise map.
    """
    best = sorted(
        (min(group, key=attrgetter("information")) for group in groups if group), key=attrgetter("information")
    )
    if len(best) == 1:
        return sorted((solution for group in groups for solution in group), key=attrgetter("information"))[:2]
    with_agn = [solution for solution in best if solution.space.n_agn]
    chosen = [solution for solution in best if not solution.space.n_agn]
    chosen += [s for s in with_agn if s.information < _RIVAL * with_agn[0].information]
    if len(chosen) < 2:
        return best[:2]
    sigma = fitted_sigma(task, with_agn[0] if with_agn else chosen[0])
    full = [full_fit(task, solution, sigma, shear=task.may_shear) for solution in chosen]
    return sorted(full, key=attrgetter("information"))[:2]


def polished(task: Task, solution: Solution) -> Solution:
    """The fit of the whole image from another one; with shear where it is wanted, or is worth its parameters."""
    best = full_fit(task, solution, fitted_sigma(task, solution), shear=task.may_shear)
    error = _stamp_error(task, best)
    if error is not None and error != best.stamp_error:
        best = replace(best, stamp_error=error)
        best = full_fit(task, best, fitted_sigma(task, best), shear=task.may_shear)
    hopeless = best.cost > _HOPELESS * task.acceptance.chi2_per_dof * best.model.pixels
    if task.observation.optics.misfit_is_noise and not hopeless:
        best = _with_model_error(task, best)
        task = replace(task, observation=best.model.observation)
    if task.shear is None and not _shear_shows(best):
        best = full_fit(task, best, best.model.sigma, shear=False, shared=best.model.shared)
    if best.cost < _DOUBTFUL * best.model.pixels:
        best = _exactly(best)
    if task.observation.response is not None:
        state = _with_state_learned(task, best)
        if state is not best and best.cost > _MISLED * best.model.pixels:
            return state
        known = _with_exposures_learned(task, state)
        best = _exactly(best) if known is best and best.cost >= _DOUBTFUL * best.model.pixels else known
    return best


def _exactly(solution: Solution) -> Solution:
    """The fit with exact columns, as far as the optics know any (:meth:`~.model.ImageModel.corrected`)."""
    for _ in range(solution.model.observation.optics.correction_rounds):
        model = solution.model.corrected(solution.values)
        found = minimise(
            model, solution.start, solution.values, NEAR_STEPS, TOLERANCE, stamp_error=solution.stamp_error
        )
        solution = replace(found, error=solution.error)
    return solution


def _with_state_learned(task: Task, solution: Solution) -> Solution:
    """The fit with the telescope in the state that its AGN images ask for; the same where they ask for none."""
    for _ in range(_ROUNDS):
        found, response = learned_optics(solution), task.observation.response
        if found is None or response is None:
            break
        misled = solution.cost > _MISLED * solution.model.pixels
        if misled and found.explained < _TELLING * solution.cost:
            # A false minimum, whatever the PSF: another start is wanted.
            break
        other, psf = response.in_state(found.state), task.observation.psf
        psf = psf + response.stamp_change(other, psf.shape[0] // 2)
        task = replace(task, observation=replace(task.observation, psf=psf, response=other))
        if misled:
            # Nothing but the state of the telescope is worth keeping of it: a search begins anew from there.
            return full_fit(task, solution, fitted_sigma(task, solution), shear=solution.space.shear, steps=1)
        solution = _exactly(_refitted(task, solution, found.shared))
    return solution


def _with_exposures_learned(task: Task, solution: Solution) -> Solution:
    """The fit with what stamp and host are wrong by beside the telescope's state, where the residuals ask for it."""
    seen, state = solution.model.observation, solution.model.shared
    response, given, known = seen.response, seen.psf, solution.error
    if response is None or solution.cost > _HOPELESS * task.acceptance.chi2_per_dof * solution.model.pixels:
        return solution
    correlation = shared_noise(seen)
    if not stamp_is_wrong(solution) and misfit_significance(*_lit(solution), correlation) < _ASKED:
        return solution
    for _ in range(_ROUNDS):
        stamps, _ = _variances(task, solution)
        # Neighbours share their noise, so that there is more of it in what is smooth.
        base = weights_sigma(seen) * math.sqrt(max(1.0, float(correlation.sum())))
        found = learned(solution, given, known, base, stamps, _fitted(task, solution.lens, solution.agn()), (1.0,))
        if found is None:
            break
        known = found.error
        before = np.zeros_like(given) if response.correction is None else response.correction
        corrected = replace(response, correction=before + known.correction)
        task = replace(task, observation=replace(seen, psf=given + known.correction, response=corrected))
        shared = found.shared if state is None else found.shared.beside(state)
        solution = _exactly(_refitted(task, replace(solution, error=known), shared))
    return solution


def _refitted(task: Task, solution: Solution, shared: SharedError) -> Solution:
    """The fit of the task's observation from another one, with errors that pixels share."""
    return full_fit(task, solution, fitted_sigma(task, solution), shear=solution.space.shear, shared=shared)


def _lit(solution: Solution) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Whitened residuals (ny, nx) of a fit, and where AGN images or arcs outshine the noise."""
    model, observation = solution.model, solution.model.observation
    amplitudes, _, columns = model.amplitudes(solution.values)
    host = model.unwhitened(columns[:, HOST_FLUX:BACKGROUND], amplitudes[HOST_FLUX:BACKGROUND])
    shining = agn_light(observation, solution.agn()) + host
    counted = np.isfinite(model.sigma) & observation.valid
    return model.explained(solution.values)[2].reshape(model.shape), counted & (shining > _SHINING * observation.noise)


def _with_model_error(task: Task, solution: Solution) -> Solution:
    """The fit with the errors of the model that it shows marginalised, and the stamp corrected."""
    given, known = task.observation.psf, solution.error
    for _ in range(_ROUNDS):
        stamps, extended = _variances(task, solution)
        base = weights_sigma(task.observation, extended + _noise_excess(task, solution))
        found = learned(solution, given, known, base, stamps, _fitted(task, solution.lens, solution.agn()))
        if found is None:
            break
        known = found.error
        task = replace(task, observation=replace(task.observation, psf=given + known.correction))
        solution = replace(solution, stamp_error=found.left, error=known)
        solution = full_fit(task, solution, fitted_sigma(task, solution), shear=task.may_shear, shared=found.shared)
    return solution


def _noise_excess(task: Task, solution: Solution) -> FloatArray:
    """Variance (ny, nx) that the noise map lacks by the scatter outside the lens: it is no error of the model."""
    model, observation = solution.model, task.observation
    amplitudes, _, _ = model.amplitudes(solution.values)
    residual = observation.image - model.image(solution.values, amplitudes)
    scale = noise_scale(observation, residual, model.sigma, solution.lens) or 1.0
    return np.asarray((max(1.0, scale) ** 2 - 1.0) * np.where(observation.valid, observation.noise, 0.0) ** 2)


def full_fit(
    task: Task,
    solution: Solution,
    sigma: FloatArray,
    *,
    shear: bool,
    shared: SharedError | None = None,
    steps: int = _STEPS,
) -> Solution:
    """The fit of the whole image that begins where another ended."""
    ny, nx = task.observation.shape
    space: ParameterSpace = replace(solution.space, shear=shear)
    whole = slice(0, ny), slice(0, nx)
    model = ImageModel(
        task.observation, space, sigma, whole, subrays=SUBRAYS, exact=True, priors=task.priors, shared=shared,
        galaxy=solution.model.galaxy,
    )  # fmt: skip
    values = solution.space.with_shear(solution.values, shear=shear)
    found = minimise(model, solution.start, values, steps, TOLERANCE, stamp_error=solution.stamp_error)
    return replace(found, error=solution.error)


def _variances(task: Task, solution: Solution) -> tuple[FloatArray, FloatArray]:
    """Variance (ny, nx) allowed for the light of the AGN images as they were fitted, and for extended light."""
    optics, space = task.observation.optics, solution.space
    amplitudes, _, columns = solution.model.amplitudes(solution.values)
    extended = slice(space.n_agn, -1)
    light = solution.model.unwhitened(columns[:, extended], amplitudes[extended])
    return optics.agn_variance(agn_light(task.observation, solution.agn())), optics.extended_variance(light)


def fitted_sigma(task: Task, solution: Solution) -> FloatArray:
    """Standard deviation of the pixels of the final fit, the PSF's errors included; infinite where not fitted."""
    stamps, extended = _variances(task, solution)
    sigma = weights_sigma(task.observation, solution.stamp_error**2 * stamps + extended)
    sigma[~_fitted(task, solution.lens, solution.agn())] = np.inf
    return sigma


def _fitted(task: Task, lens: PowerLawLens, agn: Sequence[Detection]) -> NDArray[np.bool_]:
    """Pixels (ny, nx) of the final fit: a circle.

    Nobody knows what shines into the image's border; and where the stamp of an AGN image ends, its light does not.
    """
    scale, (ny, nx) = task.observation.pixel_scale, task.observation.shape
    x, y = pixel_centres(nx, scale), pixel_centres(ny, scale)
    radius = min(0.5 * min(ny, nx) * scale - _BORDER * scale, max(_LEAST_RADIUS, _RADII * lens.theta_E))
    if agn:
        reach = max(math.hypot(found.x - lens.x, found.y - lens.y) for found in agn)
        radius = min(radius, max(task.observation.optics.star_radius - reach, _FEWEST_RADII * lens.theta_E))
    return np.asarray(np.hypot(y[:, None] - lens.y, x[None, :] - lens.x) <= radius)


def measured_arc_error(task: Task, solution: Solution, sigma: FloatArray) -> tuple[float, FloatArray]:
    """By which part of their light the arcs of a full fit are off, as the residuals show it; their variance (ny, nx).

    ``sigma`` is that of all else. Real hosts have clumps and arms: what they miss of a Sersic profile is no noise.
    """
    amplitudes, _, columns = solution.model.amplitudes(solution.values)
    arc = solution.model.unwhitened(columns[:, HOST_FLUX:BACKGROUND], amplitudes[HOST_FLUX:BACKGROUND])
    model = solution.model.unwhitened(columns, amplitudes)
    counted = np.isfinite(sigma) & np.isfinite(solution.model.sigma)
    residual = np.where(counted, task.observation.image - model, 0.0)
    scale = noise_scale(task.observation, residual, sigma, solution.lens) or 1.0
    others = np.where(counted, sigma**2 + (scale**2 - 1.0) * weights_sigma(task.observation) ** 2, np.inf)
    part = measured_stamp_error(residual, arc**2, others, _ARC_ERRORS)
    return (0.0, np.zeros(arc.shape)) if part is None else (part, (part * arc) ** 2)


def _stamp_error(task: Task, solution: Solution) -> float | None:
    """Error of the light of AGN images in units of what is allowed for, as the residuals of a full fit have it.

    None where there are none, or the residuals do not tell.
    """
    if not solution.space.n_agn:
        return None
    observation, model = task.observation, solution.model
    _, rest, _ = model.amplitudes(solution.values)
    counted = np.isfinite(model.sigma)
    residual = rest.reshape(observation.shape) * np.where(counted, model.sigma, 0.0)
    stamps, extended = _variances(task, solution)
    noise = weights_sigma(observation)
    scale = noise_scale(observation, residual, model.sigma, solution.lens)
    scaled = noise if scale is None else scale * noise
    others = np.where(counted, scaled**2 + extended, np.inf)
    return measured_stamp_error(residual, stamps, others, observation.optics.error_range)


def _shear_shows(solution: Solution) -> bool:
    """Whether a fit's shear differs from none by more than its covariance lets expect."""
    jacobian, _ = solution.model.full_jacobian(solution.values)
    covariance = parameter_covariance(solution.model, jacobian)
    stop = solution.space.lens_slice.stop
    where = slice(stop - 2, stop)
    shear = solution.values[where]
    return bool(shear @ np.linalg.solve(covariance[where, where], shear) > _SHEAR_SHOWS)
