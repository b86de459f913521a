"""One run: realization in, result out. Each step is a function of its own module; this one only joins them.

    Realization -> Scene -> Observation -> parametric start -> posterior -> source draws -> refits -> RunResult

From the observation on nothing sees the truth; it comes back at the very end, for the biases.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np
from threadpoolctl import threadpool_limits

from engine.acceptance import check_realization
from engine.catalogue import load_system
from engine.conventions import FloatArray, rate_to_magnitude
from engine.digest import engine_digest, engine_versions
from engine.errors import SpecError
from engine.estimators.draws import DrawSet, source_draw
from engine.estimators.refit import refit_draws
from engine.estimators.sersic_fit import Refit
from engine.estimators.summaries import summarise, summarise_aperture
from engine.imaging.observation import Observation
from engine.lensing.power_law import PowerLawLens
from engine.light.cell_means import profile_on_grid
from engine.light.sersic import SersicProfile, mean_surface_brightness
from engine.likelihood.evidence import Inversion
from engine.likelihood.problem import Problem, prepare_problem
from engine.parametric.fit import ParametricFit, fit_parametric
from engine.posterior.agn_positions import AgnPositions
from engine.posterior.chain import Chain, run_chain
from engine.posterior.optimum import find_optimum, optimal_strength, start_covariance
from engine.posterior.target import Target, wide_prior
from engine.result import (
    ESTIMATORS,
    Aperture,
    Estimate,
    LensParameter,
    Products,
    Quantity,
    RunResult,
    StageTime,
)
from engine.simulation.seeds import generator
from engine.simulation.simulate import simulate_realization
from engine.source.grid import SourceGrid
from engine.source.regularisation import SourceModel
from engine.spec.analysis import Analysis
from engine.spec.instrument import NOMINAL_OPTICS
from engine.spec.realization import Realization

Progress = Callable[[str, float], None]
STAGES = ("simulate", "parametric", "prepare", "optimum", "chain", "draws", "refit")


@dataclass
class _Stopwatch:
    """Wall and CPU time of each stage, told to ``progress`` as they begin."""

    progress: Progress | None
    stages: list[StageTime] = field(default_factory=list)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        if self.progress is not None:
            self.progress(name, 0.0)
        wall, cpu = time.perf_counter(), time.process_time()
        yield
        self.stages.append(StageTime(name, time.perf_counter() - wall, time.process_time() - cpu))


@dataclass(frozen=True)
class Truth:
    """What a simulation knows and an observation does not."""

    lens: PowerLawLens
    host: SersicProfile


@dataclass(frozen=True)
class Measurement:
    """What the analysis of an observation finds."""

    estimates: tuple[Estimate, ...]
    refits: tuple[Refit, ...]
    aperture: Aperture | None
    lens: tuple[LensParameter, ...]
    chain: Chain
    best: Inversion
    ln_evidence: float
    chi2: float
    degrees_of_freedom: int
    products: Products
    warnings: tuple[str, ...]


def _lens_parameters(target: Target, chain: Chain, truth: Truth | None) -> tuple[LensParameter, ...]:
    flat = chain.flat()
    out = []
    for k, name in enumerate(target.prior.names):
        mean, sd = float(flat[:, k].mean()), float(flat[:, k].std(ddof=1))
        true: float | None = None
        if truth is not None and name != "ln_lambda":
            true = float(getattr(truth.lens, name))
            if name == "phi":
                true = mean + math.remainder(true - mean, math.pi)
        out.append(LensParameter(name, Quantity(mean, sd, true)))
    return tuple(out)


def _on_grid(host: SersicProfile, grid: SourceGrid) -> FloatArray:
    return profile_on_grid(host, grid.x_edges, grid.y_edges).reshape(grid.shape)


def products_of(
    observation: Observation,
    problem: Problem,
    best: Inversion,
    samples: FloatArray,
    names: tuple[str, ...],
    truth: Truth | None,
) -> tuple[Products, float]:
    """Maps for figures and files of an inversion with the samples (n, d) it is one of, and its chi^2."""
    likelihood, mask = problem.likelihood, problem.mask
    arc = likelihood.blurring @ best.lensing.apply(best.source.ravel())
    amplitudes = likelihood.fit_amplitudes(arc)
    arc_image = np.zeros(observation.shape)
    arc_image[mask] = arc
    model = arc_image + np.tensordot(amplitudes, problem.amplitude_images, axes=1)
    residual = np.zeros(observation.shape)
    fitted = mask & ~problem.core
    residual[fitted] = ((observation.image - model) / observation.noise)[fitted]
    products = Products(
        image=observation.image,
        noise=observation.noise,
        model=model,
        arc_model=arc_image,
        residual=residual,
        mask=mask,
        pixel_scale=observation.pixel_scale,
        source=best.source,
        source_sd=np.sqrt(best.source_variance()),
        source_truth=None if truth is None else _on_grid(truth.host, best.grid),
        source_x_edges=best.grid.x_edges,
        source_y_edges=best.grid.y_edges,
        chain=samples,
        parameter_names=names,
    )
    return products, likelihood.chi2(arc, amplitudes)


def _refit(
    drawn: DrawSet,
    zero_point: float,
    truth: Truth | None,
    fixed_index: float | None,
    rng: np.random.Generator,
) -> tuple[tuple[Refit, ...], tuple[Estimate, ...], Aperture | None, list[str]]:
    """Fits, estimates, aperture magnitude, and a warning for each of them that is not there."""
    host = truth.host if truth else None
    refits = tuple(refit_draws(drawn, ESTIMATORS, fixed_index, rng))
    summaries = [summarise(refit, zero_point, host) for refit in refits]
    warnings = [
        f"{refit.estimator} estimator, n {refit.index_prior}: not one of {len(refit.fits)} draws could be fitted"
        for refit, summary in zip(refits, summaries, strict=True)
        if summary is None
    ]
    on_maps = next(refit for refit in refits if (refit.estimator, refit.index_prior) == ("paper", "wide"))
    aperture = summarise_aperture(drawn.draws, on_maps, zero_point, host)
    if aperture is None:
        warnings.append("aperture: no drawn source has light within it")
    return refits, tuple(summary for summary in summaries if summary is not None), aperture, warnings


def prepare_target(problem: Problem, fit: ParametricFit, analysis: Analysis, *, shear: bool) -> Target:
    """The posterior of lens and strength round a parametric fit."""
    source = SourceModel(
        analysis.source_pixels,
        analysis.regularisation,
    )
    prior = wide_prior(fit.lens, shear=shear).restricted(analysis.priors)
    anchors = problem.likelihood.rays.anchors
    agn = None
    if analysis.agn_position_sd is not None:
        if len(anchors) < 2:
            raise SpecError("agn_position_sd", analysis.agn_position_sd, "nothing where there are no two AGN images")
        agn = AgnPositions(anchors, analysis.agn_position_sd)
    return Target(problem.likelihood, prior, source, agn)


def find_start(target: Target, fit: ParametricFit) -> tuple[FloatArray, FloatArray]:
    """Where the search for the optimum begins: the parametric fit's lens inside the prior, and a covariance (d, d)."""
    lens = target.lens(target.prior.inside(target.vector(fit.lens, 0.0)))
    start = target.prior.inside(target.vector(lens, optimal_strength(target, lens)))
    return start, target.prior.no_wider(start_covariance(fit.lens_covariance))


def measure(
    observation: Observation,
    analysis: Analysis,
    rng: np.random.Generator,
    *,
    agn_images: int,
    deflector: bool = True,
    shear: bool = False,
    fixed_index: float | None = None,
    truth: Truth | None = None,
    watch: _Stopwatch | None = None,
    fit: ParametricFit | None = None,
) -> Measurement:
    """Analyse an observation; ``truth`` is used for nothing but the biases.

    Parameters
    ----------
    observation : Observation
    analysis : Analysis
        Source grid, regularisation, noise treatment, mask, chain.
    rng : Generator
        For the chain and the draws.
    agn_images : int
        How many AGN images the observer sees.
    deflector, shear : bool
        Whether the deflector shines, whether the lens model has external shear.
    fixed_index : float, optional
        The n at which the fixed-n estimates hold it; without it there are none.
    fit : ParametricFit, optional
        Where to start, if it is known already.

    Raises
    ------
    ObservationError, PosteriorError, InversionError
        The observation cannot be analysed; the message says what stands in the way.
    """
    watch = watch or _Stopwatch(None)
    with watch.stage("parametric"):
        if fit is None:
            fit = fit_parametric(
                observation, agn_images=agn_images, deflector=deflector, shear=shear, priors=analysis.priors,
                fixed_index=fixed_index,
            )  # fmt: skip
    with watch.stage("prepare"):
        problem = prepare_problem(observation, fit, analysis)
    with watch.stage("optimum"):
        target = prepare_target(problem, fit, analysis, shear=shear)
        laplace = find_optimum(target, *find_start(target, fit))
    with watch.stage("chain"):
        report = watch.progress
        chain = run_chain(
            target,
            laplace,
            walkers=analysis.walkers,
            max_steps=analysis.max_steps,
            length=analysis.chain_length,
            rng=rng,
            progress=None if report is None else lambda done: report("chain", done),
        )
    with watch.stage("draws"):
        states = chain.thinned(analysis.draws, rng)
        draws = [source_draw(target.invert(state), target.lens(state), rng) for state in states]
        flat_ln = chain.ln_posterior.ravel()
        best = target.invert(chain.flat()[int(np.argmax(flat_ln))])
        products, chi2 = products_of(observation, problem, best, chain.flat(), target.prior.names, truth)
    with watch.stage("refit"):
        drawn = DrawSet(tuple(draws), fit.hosts)
        refits, estimates, aperture, warnings = _refit(drawn, observation.zero_point, truth, fixed_index, rng)
    if chain.summary.status != "converged":
        warnings.append(
            f"chain: {chain.summary.steps} steps are {chain.summary.steps / chain.summary.tau:.0f} "
            f"autocorrelation times, {analysis.chain_length:g} are asked for"
        )
    if target.refused:
        warnings.append(f"evidence: {target.refused} of {target.evaluations} inversions were refused")
    fitted = int((problem.mask & ~problem.core).sum())
    return Measurement(
        estimates=estimates,
        refits=refits,
        aperture=aperture,
        lens=_lens_parameters(target, chain, truth),
        chain=chain,
        best=best,
        ln_evidence=best.ln_evidence,
        chi2=chi2,
        degrees_of_freedom=fitted - problem.likelihood.amplitudes - round(best.effective_parameters()),
        products=products,
        warnings=tuple(warnings),
    )


def analysis_of(realization: Realization) -> Analysis:
    """The analysis with the priors that the system states, where it has none of its own."""
    system = realization.system
    stated = (load_system(system) if isinstance(system, str) else system).priors
    analysis = realization.analysis
    return replace(analysis, priors={**stated, **analysis.priors}) if stated else analysis


def run(realization: Realization, progress: Progress | None = None) -> RunResult:
    """Simulate and analyse one realization.

    Parameters
    ----------
    realization : Realization
    progress : callable, optional
        Called as ``progress(stage, fraction)`` with a stage of :data:`STAGES` and the part of it that is done.

    Raises
    ------
    SpecError
        The realization asks for something that is not there.
    EngineError
        The run has no trustworthy result; the message says why.
    """
    check_realization(realization)
    watch = _Stopwatch(progress)
    # One thread: a worker is given one core, and sums in a fixed order give the same bits everywhere.
    with threadpool_limits(1):
        with watch.stage("simulate"):
            simulation = simulate_realization(realization)
            scene = simulation.scene
        found = measure(
            simulation.observation,
            analysis_of(realization),
            generator(realization, 1),
            agn_images=len(scene.agn),
            deflector=scene.deflector is not None,
            shear=scene.lens.gamma1 != 0.0 or scene.lens.gamma2 != 0.0,
            fixed_index=scene.host.n,
            truth=Truth(scene.lens, scene.host),
            watch=watch,
        )
    zero_point = scene.camera.zero_point
    agn_flux = sum(source.flux for source in scene.agn)
    noise = simulation.exposures.noise
    warnings = found.warnings
    if noise.level != noise.requested:
        warnings = (*warnings, f"noise: camera has no level {noise.requested!r}, {noise.level!r} was used")
    if scene.optics != NOMINAL_OPTICS:
        spoilt = f"{scene.optics.defocus_nm:g} nm of defocus and {scene.optics.jitter:g} arcsec of jitter"
        warnings = (*warnings, f"optics: simulated with {spoilt}, analysed with the nominal PSF")
    return RunResult(
        realization_digest=realization.digest,
        engine_digest=engine_digest(),
        versions=engine_versions(),
        seed=realization.seed,
        noise_level=noise.level,
        noise_treatment=realization.analysis.noise_treatment,
        regularisation=realization.analysis.regularisation,
        profile=realization.analysis.profile,
        estimates=found.estimates,
        aperture=found.aperture,
        lens=found.lens,
        chain=found.chain.summary,
        ln_evidence=found.ln_evidence,
        chi2=found.chi2,
        degrees_of_freedom=found.degrees_of_freedom,
        condition_number=found.best.condition_number,
        arc_magnitude=simulation.arc_magnitude,
        agn_contrast=(rate_to_magnitude(agn_flux, zero_point) - simulation.arc_magnitude if agn_flux > 0 else None),
        surface_brightness=mean_surface_brightness(rate_to_magnitude(scene.host.flux, zero_point), scene.host.r_eff),
        stages=tuple(watch.stages),
        warnings=warnings,
        products=found.products,
    )
