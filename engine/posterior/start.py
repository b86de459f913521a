"""From the parametric fit to the target of the chain, and to where the search for its maximum begins."""

from __future__ import annotations

from engine.conventions import FloatArray
from engine.errors import SpecError
from engine.likelihood.problem import Problem
from engine.parametric.fit import ParametricFit
from engine.posterior.agn_positions import AgnPositions
from engine.posterior.optimum import optimal_strength, start_covariance
from engine.posterior.target import Target, wide_prior
from engine.source.regularisation import SourceModel
from engine.spec.analysis import Analysis


def prepare_target(problem: Problem, fit: ParametricFit, analysis: Analysis) -> Target:
    """The posterior of lens and strength round a parametric fit, with shear where the fit has it.

    Raises
    ------
    SpecError
        Priors leave nothing of a parameter, or positions are to be data where there are no two AGN images.
    """
    prior = wide_prior(fit.lens, shear="gamma1" in fit.lens_names).restricted(analysis.priors)
    anchors = problem.likelihood.rays.anchors
    agn = None
    if analysis.agn_position_sd is not None:
        if len(anchors) < 2:
            raise SpecError("agn_position_sd", analysis.agn_position_sd, "nothing where there are no two AGN images")
        agn = AgnPositions(anchors, analysis.agn_position_sd)
    return Target(problem.likelihood, prior, SourceModel(analysis.source_pixels, analysis.regularisation), agn)


def find_start(target: Target, fit: ParametricFit) -> tuple[FloatArray, FloatArray]:
    """Where the search for the optimum begins: the parametric fit's lens inside the prior, and a covariance (d, d)."""
    lens = target.lens(target.prior.inside(target.vector(fit.lens, 0.0)))
    start = target.prior.inside(target.vector(lens, optimal_strength(target, lens)))
    return start, target.prior.no_wider(start_covariance(fit.lens_covariance))
