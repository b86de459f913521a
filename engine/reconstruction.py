"""What an observation says of its lens and host. Blind: nothing here knows a truth.

    Observation -> parametric fit -> posterior -> source draws -> refits -> Reconstruction

The part behind the parametric fit is left out where no estimator needs it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from engine.conventions import FloatArray
from engine.error_target import ROUNDS, first_settings, next_settings, not_kept
from engine.errors import InversionError, LensEquationError
from engine.estimators.draws import source_draw
from engine.estimators.error_budget import with_image_budget, with_source_budget
from engine.estimators.image import image_estimate
from engine.estimators.numerical_error import Answer, BestState, source_shifts
from engine.estimators.refit import refit_draws
from engine.estimators.sersic_fit import Refit
from engine.estimators.summaries import summarise_all
from engine.imaging.observation import Observation
from engine.imaging.telescope import NOMINAL_STATE
from engine.likelihood.evidence import Inversion
from engine.likelihood.problem import Problem, prepare_problem
from engine.parametric.fit import GOOD_START, Acceptance, ParametricFit, fit_parametric
from engine.parametric.poor_fit import POOR_FIT, widened
from engine.posterior.chain import Chain, run_chain
from engine.posterior.optimum import find_optimum
from engine.posterior.start import find_start, prepare_target
from engine.result import (
    INDEX_PRIORS,
    Aperture,
    Estimate,
    ImagePlane,
    IndexPrior,
    LensParameter,
    Products,
    Quantity,
    SourcePlane,
    StageTime,
)
from engine.spec.analysis import Analysis
from engine.stages import Progress, Stopwatch
from engine.work import Work, counted

DETECTED = 3.0
"""Flux of a host in its own errors below which it is said that none was detected."""
_BRIGHT_SIDE = 1.645
"""Standard deviations that 95 % of a normal distribution are above."""


@dataclass(frozen=True)
class SampledInversion:
    """The inversion of an observation, sampled over lens and strength.

    ``best`` is the inversion at the chain's highest posterior, with its ``chi2`` and ``degrees_of_freedom`` (fitted
    pixels less amplitudes and the source parameters that the data determine) and its maps; ``lens`` are the parameters
    of the chain. ``refits`` to sources drawn from it are behind the ``estimates``; ``aperture`` is None
    where no drawn source has light in it, or where ``paper``, which places it, was not asked for.
    """

    chain: Chain
    lens: tuple[LensParameter, ...]
    best: Inversion
    chi2: float
    degrees_of_freedom: int
    image_plane: ImagePlane
    source_plane: SourcePlane
    refits: tuple[Refit, ...]
    estimates: tuple[Estimate, ...]
    aperture: Aperture | None
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class Reconstruction:
    """What the analysis of an observation finds; ``inversion`` is None where no estimator needed one.

    ``work`` is what it took.
    """

    observation: Observation
    analysis: Analysis
    fit: ParametricFit
    estimates: tuple[Estimate, ...]
    inversion: SampledInversion | None
    stages: tuple[StageTime, ...]
    warnings: tuple[str, ...]
    work: Work

    @property
    def lens(self) -> tuple[LensParameter, ...]:
        """The lens of the chain, or of the parametric fit where there is none."""
        return lens_of_fit(self.fit) if self.inversion is None else self.inversion.lens

    @property
    def chi2(self) -> float:
        """Of the inversion, or of the parametric fit where there is none."""
        return self.fit.chi2 if self.inversion is None else self.inversion.chi2

    @property
    def degrees_of_freedom(self) -> int:
        """Those of ``chi2``."""
        return self.fit.degrees_of_freedom if self.inversion is None else self.inversion.degrees_of_freedom

    @property
    def products(self) -> Products:
        """Maps of the inversion, or of the parametric fit where there is none."""
        if self.inversion is None:
            return Products(fitted_image(self.observation, self.fit), None)
        return Products(self.inversion.image_plane, self.inversion.source_plane)


def analyse(
    observation: Observation,
    analysis: Analysis,
    rng: np.random.Generator,
    *,
    agn_images: int | None = None,
    deflector: bool = True,
    shear: bool | None = False,
    theta_E: float | None = None,
    positions: Sequence[tuple[float, float]] | None = None,
    acceptance: Acceptance = GOOD_START,
    fixed_index: float | None = None,
    fit: ParametricFit | None = None,
    real_galaxy: bool = False,
    centre: tuple[float, float] | None = None,
    progress: Progress | None = None,
) -> Reconstruction:
    """Reconstruct the host galaxy in an observation of any origin.

    Parameters
    ----------
    observation : Observation
    analysis : Analysis
        Estimators and priors; source grid, regularisation, noise treatment, mask and chain of the inversion.
    rng : Generator
        For the chain and the draws; not used where there is no inversion.
    agn_images, deflector, shear, theta_E, positions, acceptance, real_galaxy, centre
        What the observer sees and accepts, as :func:`~engine.parametric.fit.fit_parametric` takes it.
    fixed_index : float, optional
        The n at which the fixed-n estimates hold it; without it there are none.
    fit : ParametricFit, optional
        The parametric fit, if it is known already.
    progress : callable, optional
        Told each stage, and how far it is.

    Raises
    ------
    SpecError, ObservationError, PosteriorError, InversionError
        The observation cannot be analysed; the message says what stands in the way.
    """
    watch = Stopwatch(progress)
    # One thread: a worker is given one core, and sums in a fixed order give the same bits everywhere.
    with threadpool_limits(1), counted() as tally:
        if fit is None:
            with watch.stage("parametric"):
                fit = fit_parametric(
                    observation, agn_images=agn_images, deflector=deflector, shear=shear, theta_E=theta_E,
                    positions=positions, acceptance=acceptance, priors=analysis.priors, fixed_index=fixed_index,
                    real_galaxy=real_galaxy, centre=centre,
                )  # fmt: skip
        observation = fit.seen_through(observation)
        inversion = _sampled(observation, fit, analysis, rng, fixed_index, watch) if analysis.needs_chain else None
    estimates, warnings = ((), ()) if inversion is None else (inversion.estimates, inversion.warnings)
    if "image" in analysis.estimators:
        poor = fit.misfit > POOR_FIT
        hosts = {prior: widened(observation, fit, host) if poor else host for prior, host in fit.hosts.items()}
        missing = [prior for prior in _priors(fixed_index) if prior not in fit.hosts]
        warnings += tuple(f"image estimator, n {prior}: no fit has a positive host" for prior in missing)
        estimates += tuple(
            with_image_budget(image_estimate(hosts[prior], prior, observation.zero_point), fit.shifts.get(prior))
            for prior in _priors(fixed_index)
            if prior in hosts
        )
    if analysis.max_error is not None:
        warnings += not_kept(estimates, analysis.max_error)
    found = Reconstruction(
        observation, analysis, fit, estimates, inversion, tuple(watch.stages), warnings, tally.work()
    )  # fmt: skip
    told = [
        *warnings,
        *of_model(fit),
        # Of a poor fit the error is that of the model, and says nothing of whether there is a host.
        *(
            undetected(one)
            for one in estimates
            if fit.misfit <= POOR_FIT and one.estimator == "image" and one.index_prior == "wide"
        ),
    ]
    told.append(poor_fit(found.chi2 / found.degrees_of_freedom))
    return replace(found, warnings=tuple(filter(None, told)))


def poor_fit(misfit: float) -> str:
    """What is said of a chi2 per degree of freedom; nothing up to :data:`POOR_FIT`."""
    if misfit <= POOR_FIT:
        return ""
    return f"model: chi2 per degree of freedom is {misfit:.2f}; the errors do not cover what it misses"


def of_model(fit: ParametricFit) -> list[str]:
    """What is said of a model that is not exact."""
    told = []
    if fit.response is not None and fit.response.state != NOMINAL_STATE:
        state = fit.response.state
        told.append(
            f"psf: by the AGN images the telescope has {state.defocus_nm:+.1f} nm of defocus, "
            f"{state.blur:+.2g} arcsec^2 of blur and {state.colour:+.1f} of colour"
        )
    if fit.error is not None and fit.error.psf > 0:
        told.append(f"psf: by the AGN images the stamp is wrong by {fit.error.psf:.0%} of its light; corrected by them")
    if fit.error is not None and fit.error.host > 0:
        told.append(f"host: departs from its Sersic profile by {fit.error.host:.0%} of its light")
    return [f"{one}; the errors hold what that leaves open" for one in told]


def undetected(host: Estimate) -> str:
    """What is said of a host that the data do not show; nothing of one whose flux is :data:`DETECTED` errors.

    A magnitude is that of a positive flux, however little of it there is: of such a host it says what the prior does.
    """
    significance = 2.5 / math.log(10.0) / host.magnitude.sd
    if significance >= DETECTED:
        return ""
    limit = brightest_limit(host)
    told = f"its flux is {significance:.1f} times its error, {DETECTED:g} are a detection"
    return f"host: not detected: {told}; fainter than {limit:.1f} mag (95 %)"


def brightest_limit(host: Estimate) -> float:
    """The magnitude that a host is fainter than with 95 %."""
    return host.magnitude.mean - _BRIGHT_SIDE * host.magnitude.sd


def _priors(fixed_index: float | None) -> list[IndexPrior]:
    """Priors of n that are asked for."""
    return [prior for prior in INDEX_PRIORS if prior != "fixed" or fixed_index is not None]


def _sampled(
    observation: Observation,
    fit: ParametricFit,
    analysis: Analysis,
    rng: np.random.Generator,
    fixed_index: float | None,
    watch: Stopwatch,
) -> SampledInversion:
    """The chain as it was asked for, or as the numerical error that was asked for needs it."""
    if analysis.max_error is None:
        return _sample(observation, fit, analysis, rng, fixed_index, watch)
    settings = first_settings(analysis)
    found = _sample(observation, fit, settings, rng, fixed_index, watch)
    for _ in range(ROUNDS - 1):
        following = next_settings(settings, found.estimates, analysis.max_error)
        if following is None:
            break
        settings = following
        found = _sample(observation, fit, settings, rng, fixed_index, watch)
    return found


def _sample(
    observation: Observation,
    fit: ParametricFit,
    analysis: Analysis,
    rng: np.random.Generator,
    fixed_index: float | None,
    watch: Stopwatch,
) -> SampledInversion:
    """The chain over lens and strength from a parametric fit, and what is drawn from it."""
    with watch.stage("prepare"):
        problem = prepare_problem(observation, fit, analysis)
    with watch.stage("optimum"):
        target = prepare_target(problem, fit, analysis)
        laplace = find_optimum(target, *find_start(target, fit))
    with watch.stage("chain"):
        chain = run_chain(
            target, laplace, walkers=analysis.walkers, max_steps=analysis.max_steps, length=analysis.chain_length,
            rng=rng, progress=lambda done: watch.tell("chain", done),
        )  # fmt: skip
    with watch.stage("draws"):
        states = chain.thinned(analysis.draws, rng)
        draws = [source_draw(target.invert(state), target.lens(state), rng) for state in states]
        flat = chain.flat()
        at_best = flat[int(np.argmax(chain.ln_posterior.ravel()))]
        best = target.invert(at_best)
        image_plane, chi2 = inverted_image(observation, problem, best)
    with watch.stage("refit"):
        drawn = [name for name in analysis.estimators if name != "image"]
        refits = tuple(refit_draws(draws, drawn, fixed_index, rng))
        answers = summarise_all(draws, refits, observation.zero_point)
    warnings = list(answers.warnings)
    shifts: dict[Answer, dict[str, FloatArray]] = {}
    with watch.stage("errors"):
        state = BestState(target.lens(at_best), float(at_best[-1]), best)
        try:
            shifts = source_shifts(observation, problem, target.source, state, analysis.psf_radius, drawn, fixed_index)
        except (InversionError, LensEquationError) as error:
            warnings.append(f"numerical error: not predicted, {error}")
    if chain.summary.status != "converged":
        warnings.append(
            f"chain: {chain.summary.steps} steps are {chain.summary.steps / chain.summary.tau:.0f} "
            f"autocorrelation times, {analysis.chain_length:g} are asked for"
        )
    if target.refused:
        warnings.append(f"evidence: {target.refused} of {target.evaluations} inversions were refused")
    return SampledInversion(
        chain=chain,
        lens=tuple(
            LensParameter(name, Quantity(float(flat[:, k].mean()), float(flat[:, k].std(ddof=1))))
            for k, name in enumerate(target.prior.names)
        ),
        best=best,
        chi2=chi2,
        degrees_of_freedom=degrees_of_freedom(problem, best),
        image_plane=image_plane,
        source_plane=inverted_source(best, flat, target.prior.names),
        refits=refits,
        estimates=tuple(
            with_source_budget(one, shifts.get((one.estimator, one.index_prior)), chain.summary.effective_samples)
            for one in answers.estimates
        ),
        aperture=answers.aperture,
        warnings=tuple(warnings),
    )


def degrees_of_freedom(problem: Problem, inversion: Inversion) -> int:
    """Fitted pixels less the amplitudes and the source parameters that the data determine."""
    fitted = int((problem.mask & ~problem.core).sum())
    return fitted - problem.likelihood.amplitudes - round(inversion.effective_parameters())


def lens_of_fit(fit: ParametricFit, inflation: float = 1.0) -> tuple[LensParameter, ...]:
    """The lens of a parametric fit, its errors times ``inflation``."""
    sd = inflation * np.sqrt(np.diag(fit.lens_covariance))
    return tuple(
        LensParameter(name, Quantity(float(getattr(fit.lens, name)), float(error)))
        for name, error in zip(fit.lens_names, sd, strict=True)
    )


def fitted_image(observation: Observation, fit: ParametricFit) -> ImagePlane:
    """Maps of a parametric fit; residuals in units of all that its pixels may be off by."""
    used = np.isfinite(fit.sigma)
    return ImagePlane(
        image=observation.image,
        noise=observation.noise,
        model=fit.model,
        arc_model=fit.arc,
        residual=np.where(used, (observation.image - fit.model) / fit.sigma, 0.0),
        mask=used,
        pixel_scale=observation.pixel_scale,
    )


def inverted_image(observation: Observation, problem: Problem, inversion: Inversion) -> tuple[ImagePlane, float]:
    """Maps of an inversion in the image plane, and its chi^2."""
    likelihood, mask = problem.likelihood, problem.mask
    arc = likelihood.blurring @ inversion.lensing.apply(inversion.source.ravel())
    amplitudes = likelihood.fit_amplitudes(arc)
    arc_image = np.zeros(observation.shape)
    arc_image[mask] = arc
    model = arc_image + np.tensordot(amplitudes, problem.amplitude_images, axes=1)
    residual = np.zeros(observation.shape)
    fitted = mask & ~problem.core
    residual[fitted] = ((observation.image - model) / observation.noise)[fitted]
    plane = ImagePlane(
        image=observation.image,
        noise=observation.noise,
        model=model,
        arc_model=arc_image,
        residual=residual,
        mask=mask,
        pixel_scale=observation.pixel_scale,
    )
    return plane, likelihood.chi2(arc, amplitudes)


def inverted_source(inversion: Inversion, samples: FloatArray, names: tuple[str, ...]) -> SourcePlane:
    """Maps of an inversion in the source plane, with the samples (n, d) that it is one of."""
    return SourcePlane(
        source=inversion.source,
        source_sd=np.sqrt(inversion.source_variance()),
        source_x_edges=inversion.grid.x_edges,
        source_y_edges=inversion.grid.y_edges,
        chain=samples,
        parameter_names=names,
    )
