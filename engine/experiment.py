"""One run: realization in, result out. Simulate, analyse, compare; the analysis is blind.

Realization -> Scene -> Observation -> Reconstruction -> RunResult
"""

from __future__ import annotations

from dataclasses import replace

from engine.acceptance import check_realization
from engine.catalogue import resolve_system
from engine.comparison import compare, view_beside
from engine.inspection import InversionView, inspect_inversion
from engine.parametric.search import Acceptance
from engine.reconstruction import analyse
from engine.result import RunResult
from engine.simulation.seeds import generator
from engine.simulation.simulate import Simulation, simulate_realization
from engine.spec.analysis import Analysis
from engine.spec.realization import Realization
from engine.stages import Progress, Stopwatch
from engine.work import counted

_ANALYSIS = 1
"""The purpose of the random generator of chain and draws."""
_ANY_HOST = Acceptance(chi2_per_dof=300.0)
"""No galaxy is a Sersic profile: what describes one poorly is told as such, with the error that it makes."""


def analysis_of(realization: Realization) -> Analysis:
    """The analysis with the priors that the system states, where it has none of its own."""
    stated, analysis = resolve_system(realization).priors, realization.analysis
    return replace(analysis, priors={**stated, **analysis.priors}) if stated else analysis


def run(realization: Realization, progress: Progress | None = None) -> RunResult:
    """Simulate and analyse one realization.

    Parameters
    ----------
    realization : Realization
    progress : callable, optional
        Called as ``progress(stage, fraction)`` with a stage of :data:`~engine.stages.STAGES` and the part of it that
        is done.

    Raises
    ------
    SpecError
        The realization asks for something that is not there.
    EngineError
        The run has no trustworthy result; the message says why.
    """
    check_realization(realization)
    watch = Stopwatch(progress)
    with watch.stage("simulate"), counted() as simulating:
        simulation = simulate_realization(realization)
    scene = simulation.scene
    found = analyse(
        simulation.observation,
        analysis_of(realization),
        generator(realization, _ANALYSIS),
        agn_images=len(scene.agn),
        deflector=scene.deflector is not None,
        shear=scene.lens.sheared,
        acceptance=_ANY_HOST,
        fixed_index=scene.host.n,
        progress=progress,
    )
    return compare(found, realization, simulation, tuple(watch.stages), simulating.work())


def inspect_simulation(simulation: Simulation, analysis: Analysis) -> InversionView:
    """Look at the inversion of a simulated observation beside its truth.

    Errors as :func:`~engine.inspection.inspect_inversion`.
    """
    scene = simulation.scene
    view = inspect_inversion(
        simulation.observation,
        analysis,
        agn_images=len(scene.agn),
        deflector=scene.deflector is not None,
        shear=scene.lens.sheared,
    )
    return view_beside(view, scene)
