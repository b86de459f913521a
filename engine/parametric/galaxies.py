"""The fit of a lens behind a bright real galaxy: its light by Gaussians, every Einstein radius tried, then as any."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage

from engine.conventions import FloatArray, pixel_centres
from engine.errors import PosteriorError
from engine.parametric.arc_search import ArcSearch
from engine.parametric.galaxy_light import GalaxyFit, GalaxyImages, GalaxyLight, first_light, fit_galaxy
from engine.parametric.model import ImageModel, weights_sigma, window_round
from engine.parametric.parameters import HOST_FLUX, KnownLight, ParameterSpace
from engine.parametric.refine import fitted_sigma, full_fit, measured_arc_error
from engine.parametric.residual_noise import noise_scale
from engine.parametric.search import Task
from engine.parametric.solution import Solution, minimise

_FIELD = 4.0
"""Radius [arcsec] of what the galaxy's light is fitted in, and in Einstein radii where one is known."""
_FIELD_RADII = 3.0
_BORDER = 3
_STARTS = 5
_WINDOW, _WINDOW_MARGIN = 1.5, 0.4
"""Half-width of the quick fits in the largest Einstein radius of their starts, to which a margin comes [arcsec]."""
_QUICK_STEPS, _QUICK_TOLERANCE = 14, 1e-3
_QUICK_ARC_ERROR = 0.2
"""Part of its light by which an arc may be off in a quick fit; in the full one the residuals tell."""
_FULL_FITS = 3
_RIVAL = 1.3
"""Cost of a quick fit in that of the best up to which it is still fitted in full."""
_APART = 0.02
"""Logarithm of the ratio of Einstein radii below which two quick fits have found the same."""
_ARC_ROUNDS = 2
_LEAST_FIELD = 25.0
"""Pixels."""
_WORTH, _PART = 10.0, 0.01
"""What a Gaussian must lower chi^2 by, and all of them together in its own units, for the galaxy to be worth a fit."""
DESCRIBED = 1.5
"""chi^2 per pixel up to which a galaxy without AGN needs none."""


def asks_for_galaxy(solution: Solution) -> bool:
    """Whether a deflector of more than one profile would lower the chi^2 of a fit by more than its parameters may.

    All that the fit knows is free to follow to first order: one linear solution, not another fit (Rao's score test).
    """
    model, space, values = solution.model, solution.space, solution.values
    jacobian, _ = model.full_jacobian(values)
    _, rest, _ = model.amplitudes(values)
    basis, _ = np.linalg.qr(jacobian[: model.data.size])
    shape = values[space.deflector_slice]
    _, e1, e2, x, y = shape[1:].tolist()
    scale = model.observation.pixel_scale
    light = first_light((x, y), max(_LEAST_FIELD * scale, _FIELD_RADII * solution.lens.theta_E), scale, (e1, e2))
    images = GalaxyImages(model.observation, model.window)(light).reshape(light.size, -1)
    more = model.decorrelated((images * model.weight).T)
    more = more - basis @ (basis.T @ more)
    basis, _ = np.linalg.qr(more)
    gain = float(np.sum((basis.T @ rest) ** 2))
    misfit = max(float(rest @ rest) / model.pixels, 1e-300)
    return gain > _WORTH * light.size * misfit and gain > _PART * float(rest @ rest)


def with_galaxy(task: Task, first: Solution, theta_E: float | None, *, agn_told: bool) -> Solution:
    """The better of the fits with a deflector of Gaussians: without AGN, and with those of the ``first`` fit."""
    found: list[Solution] = []
    if not (agn_told and first.space.n_agn):
        try:
            found.append(galaxy_fit(task, theta_E))
        except PosteriorError:
            if not first.space.n_agn:
                return first
    if first.space.n_agn and not (found and misfit_of(task, found[0]) < DESCRIBED):
        found += [first, _behind_galaxy(task, first, theta_E)]
    return min(found, key=lambda one: misfit_of(task, one))


def misfit_of(task: Task, solution: Solution) -> float:
    """chi^2 per pixel of a full fit, in the scatter outside the lens."""
    amplitudes, _, columns = solution.model.amplitudes(solution.values)
    noise = solution.model.sigma if solution.noise is None else solution.noise
    counted = np.isfinite(noise) & np.isfinite(solution.model.sigma)
    residual = np.where(counted, task.observation.image - solution.model.unwhitened(columns, amplitudes), 0.0)
    scale = noise_scale(task.observation, residual, np.where(counted, noise, np.inf), solution.lens) or 1.0
    return float(np.mean((residual[counted] / noise[counted]) ** 2)) / scale**2


def _behind_galaxy(task: Task, first: Solution, theta_E: float | None) -> Solution:
    """The fit that begins at another one, with Gaussians instead of its deflector."""
    sigma, reach = _searched(task, theta_E)
    light = first_light(task.centre, reach, task.observation.pixel_scale)
    galaxy = fit_galaxy(task.observation, task.observation.image - _without_deflector(first), sigma, light)
    known, images = _known(task, galaxy.light, galaxy.fluxes)
    space = replace(first.space, deflector=False, light=known)
    values = np.delete(first.values, first.space.deflector_slice)
    model = ImageModel(
        task.observation, space, first.model.sigma, first.model.window, subrays=1, exact=False, priors=task.priors,
        galaxy=images,
    )  # fmt: skip
    low, high = space.bounds(values, task.observation.pixel_scale, task.priors)
    return _with_arc_error(task, replace(first, model=model, values=values, low=low, high=high, error=None))


def _without_deflector(solution: Solution) -> FloatArray:
    """Image (ny, nx) of AGN and arcs."""
    amplitudes, _, columns = solution.model.amplitudes(solution.values)
    chosen = [*range(solution.space.n_agn), solution.space.amplitudes + HOST_FLUX]
    return solution.model.unwhitened(columns[:, chosen], amplitudes[chosen])


def galaxy_fit(task: Task, theta_E: float | None) -> Solution:
    """The best solution with a deflector of Gaussians and no AGN; a PosteriorError where there is none."""
    sigma, reach = _searched(task, theta_E)
    galaxy = fit_galaxy(
        task.observation, task.observation.image, sigma, first_light(task.centre, reach, task.observation.pixel_scale)
    )
    quick = _quick_fits(task, galaxy, sigma, theta_E)
    if not quick:
        raise PosteriorError("parametric model: no start behind a galaxy of Gaussians has a positive host")
    chosen: list[Solution] = []
    for solution in quick:
        same = any(abs(np.log(other.lens.theta_E / solution.lens.theta_E)) < _APART for other in chosen)
        if not same and len(chosen) < _FULL_FITS and solution.cost < _RIVAL * quick[0].cost:
            chosen.append(solution)
    # The same pixels with the same noise for all, or their costs could not be compared.
    noise = fitted_sigma(task, max(chosen, key=lambda one: one.lens.theta_E))
    noise = np.sqrt(noise**2 + _arc_variance(galaxy, task.observation.image))
    full = [_full(task, solution, galaxy.light, sigma, noise) for solution in chosen]
    return _with_arc_error(task, min(full, key=lambda one: one.cost))


def _searched(task: Task, theta_E: float | None) -> tuple[FloatArray, float]:
    """Noise (ny, nx) of the pixels that the galaxy is fitted in, infinite elsewhere, and their radius [arcsec]."""
    observation = task.observation
    scale, (ny, nx) = observation.pixel_scale, observation.shape
    x, y = pixel_centres(nx, scale) - task.centre[0], pixel_centres(ny, scale) - task.centre[1]
    radius = _FIELD if theta_E is None else max(_FIELD, _FIELD_RADII * theta_E)
    reach = min(radius, 0.5 * min(ny, nx) * scale - _BORDER * scale)
    sigma = weights_sigma(observation)
    inside = np.hypot(y[:, None], x[None, :]) <= reach
    return np.where(inside, sigma, np.inf), reach


def _arc_variance(galaxy: GalaxyFit, image: FloatArray) -> FloatArray:
    """Variance (ny, nx) of arcs that are no Sersic profile's, before any lens is known: of what the galaxy leaves."""
    rest = np.where(galaxy.others, image - galaxy.image, 0.0)
    return np.asarray((_QUICK_ARC_ERROR * np.maximum(ndimage.gaussian_filter(rest, 1.0), 0.0)) ** 2)


def _quick_fits(task: Task, galaxy: GalaxyFit, sigma: FloatArray, theta_E: float | None) -> list[Solution]:
    """Quick fits from the best starts of the whole lattice, the best first, all of the same pixels."""
    observation, light = task.observation, galaxy.light
    scale, shape = observation.pixel_scale, observation.shape
    # What the PSF is not known to hides arcs where the galaxy is bright.
    variance = observation.optics.extended_variance(galaxy.image) + _arc_variance(galaxy, observation.image)
    noise = np.sqrt(sigma**2 + variance)
    known, images = _known(task, light, galaxy.fluxes)
    reach = float(light.widths[-1]) / 0.8
    search = ArcSearch(observation, noise, images, window_round(shape, scale, light.centre, reach), light.centre)
    starts = [rated.start for rated in search.best(known.ellipticity, _STARTS, theta_E)]
    if not starts:
        return []
    reach = _WINDOW * max(start.lens.theta_E for start in starts) + _WINDOW_MARGIN
    window = window_round(shape, scale, light.centre, reach)
    space = ParameterSpace(0, deflector=False, shear=task.may_shear, light=known)
    model = ImageModel(observation, space, noise, window, subrays=1, exact=False, priors=task.priors, galaxy=images)
    out = []
    for start in starts:
        try:
            found = minimise(model, start, start.vector(space), _QUICK_STEPS, _QUICK_TOLERANCE)
        except PosteriorError:
            continue
        if found.host_flux > 0:
            out.append(found)
    return sorted(out, key=lambda one: one.cost)


def _full(task: Task, solution: Solution, light: GalaxyLight, sigma: FloatArray, noise: FloatArray) -> Solution:
    """The full fit from a quick one, with Gaussians that are fitted to what its arcs leave."""
    galaxy = fit_galaxy(task.observation, task.observation.image - _without_deflector(solution), sigma, light, rounds=1)
    known, images = _known(task, galaxy.light, galaxy.fluxes)
    space = replace(solution.space, light=known)
    old = solution.model
    model = ImageModel(
        task.observation, space, old.sigma, old.window, subrays=1, exact=False, priors=task.priors, galaxy=images
    )
    return full_fit(task, replace(solution, model=model), noise, shear=task.may_shear)


def _with_arc_error(task: Task, solution: Solution) -> Solution:
    """The fit in which arcs may be off by the part of their light that the residuals show."""
    for _ in range(_ARC_ROUNDS):
        noise = fitted_sigma(task, solution)
        part, variance = measured_arc_error(task, solution, noise)
        solution = full_fit(task, solution, np.sqrt(noise**2 + variance), shear=task.may_shear)
        solution = replace(solution, noise=noise, arc_error=part)
    return solution


def _known(task: Task, light: GalaxyLight, fluxes: FloatArray) -> tuple[KnownLight, FloatArray]:
    """The Gaussians that shine, and their images (gaussians, ny, nx) of unit flux."""
    shining = np.flatnonzero(fluxes > 0)
    observation, profiles = task.observation, light.profiles
    known = KnownLight(light.centre, light.ellipticity(fluxes), tuple(profiles[k] for k in shining))
    if observation.response is not None:
        return known, np.stack([observation.optics.sersic_image(profile) for profile in known.gaussians])
    ny, nx = observation.shape
    return known, GalaxyImages(observation, (slice(0, ny), slice(0, nx)))(light)[shining]
