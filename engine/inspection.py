"""One inversion looked at closely: images, source, resolution, and the evidence along each parameter. No chain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from engine.imaging.observation import Observation
from engine.likelihood.evidence import Inversion
from engine.likelihood.problem import prepare_problem
from engine.likelihood.resolution import SourceResolution, source_resolution
from engine.parametric.fit import ParametricFit, fit_parametric
from engine.posterior.optimum import find_optimum
from engine.posterior.traces import EvidenceTrace, trace_evidence
from engine.result import Products
from engine.run import Truth, find_start, prepare_target, products_of
from engine.simulation.simulate import Simulation
from engine.spec.analysis import Analysis


@dataclass(frozen=True)
class InversionView:
    """An inversion at the maximum of its evidence.

    ``products`` holds its maps, with the maximum as the only sample of its chain; ``traces`` has one element for each
    of ``products.parameter_names``; ``chi2`` and ``degrees_of_freedom`` as in :class:`~engine.result.RunResult`.
    """

    inversion: Inversion
    products: Products
    resolution: SourceResolution
    traces: tuple[EvidenceTrace, ...]
    effective_parameters: float
    chi2: float
    degrees_of_freedom: int


def inspect_inversion(
    observation: Observation,
    analysis: Analysis,
    *,
    agn_images: int,
    deflector: bool = True,
    shear: bool = False,
    truth: Truth | None = None,
    fit: ParametricFit | None = None,
) -> InversionView:
    """Find the lens and strength of highest evidence, and look at the inversion there.

    Parameters
    ----------
    observation : Observation
    analysis : Analysis
        Source grid, regularisation, noise treatment and mask; nothing of the chain.
    agn_images : int
        How many AGN images the observer sees.
    deflector, shear : bool
        Whether the deflector shines, whether the lens model has external shear.
    truth : Truth, optional
        Shown beside what is found, and used for nothing else.
    fit : ParametricFit, optional
        Where to start, if it is known already.

    Raises
    ------
    ObservationError, PosteriorError, InversionError
        The observation cannot be analysed; the message says what stands in the way.
    """
    if fit is None:
        fit = fit_parametric(observation, agn_images=agn_images, deflector=deflector, shear=shear)
    problem = prepare_problem(observation, fit, analysis)
    target = prepare_target(problem, fit, analysis, shear=shear)
    optimum = find_optimum(target, *find_start(target, fit))
    inversion = target.invert(optimum.mean)
    names = target.prior.names
    true = None if truth is None else np.array([getattr(truth.lens, name) for name in names[:-1]])
    products, chi2 = products_of(observation, problem, inversion, optimum.mean[None], names, truth)
    gamma = inversion.effective_parameters()
    return InversionView(
        inversion=inversion,
        products=products,
        resolution=source_resolution(inversion),
        traces=trace_evidence(target, names, optimum.mean, optimum.covariance, truth=true),
        effective_parameters=gamma,
        chi2=chi2,
        degrees_of_freedom=int((problem.mask & ~problem.core).sum()) - problem.likelihood.amplitudes - round(gamma),
    )


def inspect_simulation(simulation: Simulation, analysis: Analysis) -> InversionView:
    """Look at the inversion of a simulated observation, whose truth is known; errors as :func:`inspect_inversion`."""
    scene = simulation.scene
    with threadpool_limits(1):
        return inspect_inversion(
            simulation.observation,
            analysis,
            agn_images=len(scene.agn),
            deflector=scene.deflector is not None,
            shear=scene.lens.gamma1 != 0.0 or scene.lens.gamma2 != 0.0,
            truth=Truth(scene.lens, scene.host),
        )
