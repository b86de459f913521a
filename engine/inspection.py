"""One inversion looked at closely: images, source, resolution, and the evidence along each parameter. No chain."""

from __future__ import annotations

from dataclasses import dataclass

from threadpoolctl import threadpool_limits

from engine.imaging.observation import Observation
from engine.likelihood.evidence import Inversion
from engine.likelihood.problem import prepare_problem
from engine.likelihood.resolution import SourceResolution, source_resolution
from engine.parametric.fit import ParametricFit, fit_parametric
from engine.posterior.optimum import find_optimum
from engine.posterior.start import find_start, prepare_target
from engine.posterior.traces import EvidenceTrace, trace_evidence
from engine.reconstruction import degrees_of_freedom, inverted_image, inverted_source
from engine.result import ImagePlane, SourcePlane
from engine.spec.analysis import Analysis


@dataclass(frozen=True)
class InversionView:
    """An inversion at the maximum of its evidence.

    ``source_plane`` has the maximum as the only sample of its chain; ``traces`` has one element for each of
    its ``parameter_names``; ``chi2`` and ``degrees_of_freedom`` as in :class:`~engine.result.RunResult`.
    """

    inversion: Inversion
    image_plane: ImagePlane
    source_plane: SourcePlane
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
    fit : ParametricFit, optional
        Where to start, if it is known already.

    Raises
    ------
    ObservationError, PosteriorError, InversionError
        The observation cannot be analysed; the message says what stands in the way.
    """
    with threadpool_limits(1):
        fit = fit or fit_parametric(observation, agn_images=agn_images, deflector=deflector, shear=shear)
        observation = fit.seen_through(observation)
        problem = prepare_problem(observation, fit, analysis)
        target = prepare_target(problem, fit, analysis)
        # A third of a deviation may be left the first time, which is enough to begin a chain and not to be looked at.
        near = find_optimum(target, *find_start(target, fit))
        optimum = find_optimum(target, near.mean, near.covariance)
        inversion = target.invert(optimum.mean)
        names = target.prior.names
        image_plane, chi2 = inverted_image(observation, problem, inversion)
        return InversionView(
            inversion=inversion,
            image_plane=image_plane,
            source_plane=inverted_source(inversion, optimum.mean[None], names),
            resolution=source_resolution(inversion),
            traces=trace_evidence(target, names, optimum.mean, optimum.covariance),
            effective_parameters=inversion.effective_parameters(),
            chi2=chi2,
            degrees_of_freedom=degrees_of_freedom(problem, inversion),
        )
