"""A parametric fit of the whole image: AGN images, deflector, ray-traced Sersic host and a background.

It supplies what the inversion keeps fixed (AGN positions, the deflector's shape) and where its posterior starts. Quick
fits from several deterministic starts on a window of the image come first (:mod:`.search`); the best are fitted to the
whole of it (:mod:`.refine`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from engine.conventions import FloatArray
from engine.errors import PosteriorError, SpecError
from engine.imaging.observation import Observation
from engine.imaging.optics.exposed import ExposedOptics
from engine.imaging.telescope import NOMINAL_STATE
from engine.lensing.power_law import PowerLawLens
from engine.light.sersic import SersicProfile, profile_of
from engine.parametric.constraints import worst_miss
from engine.parametric.galaxies import asks_for_galaxy, with_galaxy
from engine.parametric.host_posterior import COORDINATES, HostPosterior
from engine.parametric.model import ImageModel
from engine.parametric.numerical_error import HostShift, host_shifts
from engine.parametric.optics_error import BLUR_SD, COLOUR_SD, DEFOCUS_SD
from engine.parametric.parameters import BACKGROUND, HOST_FLUX, ParameterSpace
from engine.parametric.point_sources import Detection
from engine.parametric.refine import SUBRAYS, polished, ranked
from engine.parametric.search import Acceptance, Task, find_starts, quick_fits, varied_starts
from engine.parametric.shared_error import ModelError
from engine.parametric.solution import Solution
from engine.parametric.starts import Start
from engine.parametric.uncertainty import host_posteriors, parameter_covariance, positive_mean
from engine.result import IndexPrior
from engine.spec.priors import LensParameterName, ParameterPrior

__all__ = ["GOOD_START", "Acceptance", "ParametricFit", "fit_of", "fit_parametric"]

GOOD_START = Acceptance()
_N = COORDINATES.index("n")
_DOUBTFUL = 1.5
"""chi^2 per degree of freedom from which on an acceptable fit may be a false minimum: others are tried as well."""
_LEARNED = 1.1
"""Deviations behind a PSF that was learned from the image itself, in units of what least squares say.

What a few modes of the telescope and of a smooth residual leave of a wrong PSF is in no covariance: 109 runs of
benchmarks.model_errors scatter by 1.09 (magnitude), 1.06 (r_eff) and 1.19 (n) of their errors without it.
"""
_FAR = 0.2
"""Deviations of its prior by which a state of the telescope has to move for a search to be begun anew."""
_SEARCHES = 4
"""How often the optics may be learned and the search begun anew."""


@dataclass(frozen=True)
class ParametricFit:
    """The best parametric model of an observation.

    ``host.flux`` and ``deflector.flux`` are the fitted fluxes [e-/s]; ``agn`` are the fitted positions and fluxes;
    ``lens_covariance`` (k, k) is that of the lens parameters in the order of ``lens_names``, all other parameters free,
    multiplied by chi^2 per degree of freedom where that is above one. A deflector that is more than one profile is
    ``deflector_gaussians``, and ``deflector`` is None. ``chi2`` counts the fitted pixels with ``sigma`` (ny, nx), their
    noise and the error of the PSF, infinite where a pixel was not fitted; ``stamp_error`` is how many times what is
    allowed for moved stamps the residuals at AGN images show, ``arc_error`` by which part of their light the
    covariances let arcs be off, which no Sersic profile describes; ``chi2`` does not. ``hosts`` are the posteriors of
    the host with each prior of n, without those that could not be fitted. ``model`` and ``arc`` are images (ny, nx) of
    all and of the lensed host [e-/s], with what the model is wrong by where the residuals show that: ``error`` says how
    much, or is None, and ``psf`` (n, n) is the stamp with its correction, ``response`` the exposures with theirs.
    ``shifts`` are numerical errors of the ``hosts``.
    """

    lens: PowerLawLens
    host: SersicProfile
    deflector: SersicProfile | None
    deflector_gaussians: tuple[SersicProfile, ...]
    agn: tuple[Detection, ...]
    background: float
    lens_names: tuple[str, ...]
    lens_covariance: FloatArray
    hosts: Mapping[IndexPrior, HostPosterior]
    chi2: float
    degrees_of_freedom: int
    stamp_error: float
    arc_error: float
    at_bound: tuple[str, ...]
    model: FloatArray
    arc: FloatArray
    sigma: FloatArray
    psf: FloatArray
    response: ExposedOptics | None
    error: ModelError | None
    shifts: Mapping[IndexPrior, HostShift] = field(default_factory=dict)

    @property
    def misfit(self) -> float:
        """chi^2 per degree of freedom where it is above one: by this the variances are larger than ``sigma`` says."""
        return max(1.0, self.chi2 / self.degrees_of_freedom)

    def seen_through(self, observation: Observation) -> Observation:
        """The observation that was fitted, with the optics that the fit has learned."""
        if self.error is None and self.response in (None, observation.response):
            return observation
        return replace(observation, psf=self.psf, response=self.response)


def fit_parametric(
    observation: Observation,
    *,
    agn_images: int | None = None,
    deflector: bool = True,
    shear: bool | None = False,
    theta_E: float | None = None,
    positions: Sequence[tuple[float, float]] | None = None,
    acceptance: Acceptance = GOOD_START,
    priors: Mapping[LensParameterName, ParameterPrior] = MappingProxyType({}),
    fixed_index: float | None = None,
    real_galaxy: bool = False,
    centre: tuple[float, float] | None = None,
) -> ParametricFit:
    """Find lens, AGN images and host, from nothing but the observation.

    Parameters
    ----------
    observation : Observation
    agn_images : int, optional
        Number of AGN images; where None, four, three, two and none are tried and the least BIC decides.
    deflector : bool
        Whether the deflector shines: a component that is absent is not built.
    shear : bool, optional
        Whether the lens has external shear; where None it has where the fit's differs from none.
    theta_E : float, optional
        Rough Einstein radius [arcsec].
    positions : sequence of (x, y), optional
        Rough positions of the AGN images [arcsec, image frame]; then ``agn_images`` is their number.
    acceptance : Acceptance
        How bad a fit may be that is handed on.
    priors : mapping, optional
        What is known of lens parameters, by name, instead of the wide priors that hold otherwise.
    fixed_index : float, optional
        An index at which the host's n is held for one more of its posteriors.
    real_galaxy : bool
        Whether a deflector may be more than one Sersic profile, where the residuals ask for it, may stand anywhere, and
        its host may be one that AGN images show alone.
    centre : (x, y), optional
        Where the deflector is, to half an arcsec [arcsec, image frame].

    Raises
    ------
    ObservationError
        The AGN images are not found.
    PosteriorError
        No start leads to an acceptable fit; the message says what is wrong with the best.
    """
    radius = min(observation.shape) * observation.pixel_scale / 2
    if agn_images is not None and not 0 <= agn_images <= 8:
        raise SpecError("agn_images", agn_images, "a number from 0 to 8")
    if theta_E is not None and not 0 < theta_E < radius:
        raise SpecError("theta_E", theta_E, f"a radius on the image, below {radius:g}")
    task = Task(
        observation, deflector, shear, acceptance, priors, dark_host=real_galaxy, near=centre, anywhere=real_galaxy
    )
    told = positions is not None or agn_images is not None
    refusals: list[str] = []
    best: ParametricFit | None = None
    for _ in range(_SEARCHES):
        groups = find_starts(task, agn_images, theta_E, positions)
        best, elsewhere = _searched(task, groups, refusals, theta_E, fixed_index, agn_told=told)
        if elsewhere is None:
            break
        # The PSF that misled this search is known better now.
        task = replace(task, observation=elsewhere)
    if best is not None:
        return best
    raise PosteriorError("; then ".join(dict.fromkeys(refusals)) or "parametric model: no start has a positive host")


def _searched(
    task: Task,
    groups: list[list[Start]],
    refusals: list[str],
    theta_E: float | None,
    fixed_index: float | None,
    *,
    agn_told: bool,
) -> tuple[ParametricFit | None, Observation | None]:
    """The best fit from groups of starts; ``refusals`` gains what the others were refused for.

    The second is the observation with its optics in the state that a doubtful fit has learned, to be searched anew.
    """
    best: ParametricFit | None = None
    for wave in (groups, [varied_starts(group) for group in groups]):
        for solution in ranked(task, [quick_fits(task, group) for group in wave]):
            learned: Observation | None = None
            try:
                reached = polished(task, solution)
                if _is_elsewhere(task.observation.response, reached.model.observation.response):
                    learned = reached.model.observation
                if task.dark_host and task.deflector and asks_for_galaxy(reached):
                    reached = with_galaxy(task, reached, theta_E, agn_told=agn_told)
                found = fit_of(task, reached, fixed_index)
            except PosteriorError as error:
                refusals.append(str(error))
                if learned is not None:
                    return best, learned
                continue
            # Behind a galaxy of Gaussians every Einstein radius has been tried.
            if found.misfit < _DOUBTFUL or found.deflector_gaussians:
                return found, None
            if best is None or found.misfit < best.misfit:
                best = found
            if learned is not None:
                return best, learned
    return best, None


def _is_elsewhere(one: ExposedOptics | None, other: ExposedOptics | None) -> bool:
    """Whether optics have moved so far that a search with the others may end elsewhere."""
    if one is None or other is None or one is other:
        return False
    here, there = one.state, other.state
    moved = (
        abs(there.defocus_nm - here.defocus_nm) / DEFOCUS_SD,
        abs(there.blur - here.blur) / BLUR_SD,
        abs(there.colour - here.colour) / COLOUR_SD,
    )
    return max(moved) > _FAR or (one.correction is None and other.correction is not None)


def fit_of(task: Task, solution: Solution, fixed_index: float | None = None) -> ParametricFit:
    """A solution as it is handed on; a PosteriorError where it is no good."""
    model, values, space = solution.model, solution.values, solution.space
    jacobian, amplitudes = model.full_jacobian(values)
    host_departs, unmodelled, rest = model.explained(values)
    freedom = model.pixels - space.size - space.amplitudes - round(model.shared_parameters)
    covered = float(rest @ rest)
    chi2 = covered if solution.noise is None else _chi2_of(solution, rest, solution.noise)
    flux = float(amplitudes[HOST_FLUX])
    if not flux > 0 and not (task.dark_host and space.n_agn):
        raise PosteriorError(f"parametric model: the host's flux is {flux:.3g} e-/s, a positive one is needed")
    if not freedom > 0 or chi2 > task.acceptance.chi2_per_dof * freedom:
        raise PosteriorError(
            f"parametric model: chi2 is {chi2:.0f} for {freedom} degrees of freedom, "
            f"{task.acceptance.chi2_per_dof:g} times as many are allowed"
        )
    miss = worst_miss(space, values)
    if miss > task.acceptance.miss:
        raise PosteriorError(
            f"parametric model: an AGN image maps {miss:.3f} arcsec from the host, {task.acceptance.miss:g} are allowed"
        )
    inflation = max(1.0, covered / freedom) * (_LEARNED**2 if _psf_is_learned(model.observation.response) else 1.0)
    covariance = inflation * parameter_covariance(model, jacobian)
    if not flux > 0:
        flux = positive_mean(flux, math.sqrt(float(covariance[HOST_FLUX, HOST_FLUX])))
    hosts = host_posteriors(solution, flux, covariance, inflation, fixed_index)
    shape = model.observation.shape
    shown = ImageModel(
        model.observation, space, np.ones(shape), model.window, subrays=SUBRAYS, exact=True, galaxy=model.galaxy
    )
    columns = shown.columns(values)
    deflector = profile_of(values[space.deflector_slice], float(amplitudes[space.n_agn])) if space.deflector else None
    return ParametricFit(
        lens=solution.lens,
        host=space.host(values, flux),
        deflector=deflector,
        deflector_gaussians=_gaussians(space, amplitudes),
        agn=solution.agn(),
        background=float(amplitudes[BACKGROUND]),
        lens_names=space.lens_names,
        lens_covariance=space.lens_covariance(covariance, values),
        hosts=hosts,
        chi2=chi2,
        degrees_of_freedom=freedom,
        stamp_error=solution.stamp_error,
        arc_error=solution.arc_error,
        at_bound=solution.at_bound,
        model=(columns @ amplitudes).reshape(shape) + unmodelled,
        arc=(columns[:, HOST_FLUX] * flux).reshape(shape) + host_departs,
        sigma=model.sigma if solution.noise is None else solution.noise,
        psf=model.observation.psf,
        response=model.observation.response,
        error=solution.error,
        shifts=host_shifts(
            solution, jacobian, amplitudes, {prior: host.covariance[_N, _N] == 0.0 for prior, host in hosts.items()}
        ),
    )


def _psf_is_learned(response: ExposedOptics | None) -> bool:
    """Whether the PSF of known exposures is not the one that was given."""
    return response is not None and (response.state != NOMINAL_STATE or response.correction is not None)


def _gaussians(space: ParameterSpace, amplitudes: FloatArray) -> tuple[SersicProfile, ...]:
    """The Gaussians that the deflector's light is made of, with their fluxes."""
    if space.light is None:
        return ()
    fluxes = amplitudes[space.n_agn : space.n_agn + space.gaussians].tolist()
    return tuple(replace(one, flux=flux) for one, flux in zip(space.light.gaussians, fluxes, strict=True) if flux > 0)


def _chi2_of(solution: Solution, rest: FloatArray, noise: FloatArray) -> float:
    """chi^2 of whitened residuals with the noise that does not let the arcs be off."""
    counted = np.isfinite(noise) & np.isfinite(solution.model.sigma)
    ratio = np.where(counted, solution.model.sigma, 0.0) / np.where(counted, noise, 1.0)
    return float(np.sum((rest.reshape(noise[solution.model.window].shape) * ratio[solution.model.window]) ** 2))
