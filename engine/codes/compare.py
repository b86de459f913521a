"""What several codes find in the image of a measurement."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from engine.codes.answer import CodeAnswer
from engine.codes.by_autolens import fit_with_autolens
from engine.codes.by_lenstronomy import fit_with_lenstronomy
from engine.codes.installed import PEERS, installed
from engine.codes.joint_fit import Task
from engine.errors import EngineError
from engine.measure import ImageMeasurement
from engine.stages import Progress


@dataclass(frozen=True)
class Comparison:
    """``answers`` of the codes, ours first; of the others, why one has none, by its name."""

    task: Task
    answers: tuple[CodeAnswer, ...]
    without_answer: dict[str, str]


def compare_codes(
    found: ImageMeasurement, autolens: Path | None = None, progress: Progress | None = None
) -> Comparison:
    """Fit the image of a measurement by lenstronomy and PyAutoLens, where they are installed.

    Each has our parameters, priors, PSF (as corrected by the AGN images, where they ask for it) and noise, and begins
    two standard deviations away from where our fit ended.

    Parameters
    ----------
    found : ImageMeasurement
    autolens : Path, optional
        The Python that PyAutoLens is installed for; the one that runs where None.
    progress : callable, optional
        Told the code, and how many steps of its search are done.
    """
    task = Task(found.observation, found.fit.sigma, found.fit)
    python = autolens if autolens is not None else Path(sys.executable) if installed("PyAutoLens") else None
    runs: dict[str, Callable[[], CodeAnswer] | None] = {
        "lenstronomy": (lambda: fit_with_lenstronomy(task, progress)) if installed("lenstronomy") else None,
        "PyAutoLens": (lambda: fit_with_autolens(task, python, progress)) if python is not None else None,
    }
    answers, without = [_ours(found)], {}
    for name in PEERS:
        run = runs[name]
        if run is None:
            without[name] = "not installed here"
            continue
        try:
            answers.append(run())
        except EngineError as error:
            without[name] = str(error)
    return Comparison(task, tuple(answers), without)


def _ours(found: ImageMeasurement) -> CodeAnswer:
    """The measurement, in the form of the others."""
    fit, host = found.fit, found.host
    return CodeAnswer(
        code="hostlens",
        version=found.versions["hostlens"],
        lens=fit.lens,
        host=fit.host,
        deflector=fit.deflector,
        agn=fit.agn,
        background=fit.background,
        errors={
            "magnitude": host.magnitude.sd,
            "r_eff": host.r_eff.sd,
            "n": host.n.sd,
            **{name: value.sd for name, value in found.lens.items()},
        },
        chi2_per_dof=fit.chi2 / fit.degrees_of_freedom,
        zero_point=found.observation.zero_point,
        seconds=found.seconds,
        evaluations=found.work.columns_solved,
        limits=("the deflector is several Gaussians",) if fit.deflector_gaussians else (),
    )
