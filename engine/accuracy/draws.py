"""How many sources are drawn: scatter of what they say about the host, against many more of them."""

from __future__ import annotations

import time

import numpy as np

from engine.accuracy.curves import SCATTER, Curve, Knob
from engine.accuracy.subject import Subject
from engine.accuracy.timing import Measuring
from engine.conventions import rate_to_magnitude
from engine.errors import PosteriorError
from engine.estimators.draws import source_draw
from engine.estimators.refit import refit_draws

STAGE = "draws"
DRAWS = Knob(
    stage=STAGE,
    name="draws",
    place="Analysis.draws",
    quantity="error of the host's magnitude by `projected`, n in 0.3-8, rms over sets of draws",
    unit="mag",
    work="sources drawn and refitted",
    reference="the draws that are not in the set, of states that no chain has made",
    resolution=SCATTER,
)
_DRAWN = 150
_SETTINGS = (5, 10, 15, 50)
_SEED = 3


def measure(subject: Subject) -> list[Curve]:
    """The one knob of this stage."""
    reference, rng = subject.posterior, np.random.default_rng(_SEED)
    states, zero_point = reference.draws(_DRAWN, rng), subject.simulation.observation.zero_point
    began = time.thread_time()
    drawn = [source_draw(reference.target.invert(state), reference.target.lens(state), rng) for state in states]
    refits = refit_draws(drawn, ["projected"], None, rng)
    seconds = (time.thread_time() - began) / _DRAWN
    wide = next(refit for refit in refits if refit.index_prior == "wide")
    magnitudes = np.array(
        [rate_to_magnitude(fit.profile.flux, zero_point) if fit is not None else np.nan for fit in wide.fits]
    )
    if not np.isfinite(magnitudes).any():
        raise PosteriorError(f"draws: not one of {_DRAWN} could be fitted")
    found = Measuring(DRAWS, floor=float(np.nanstd(magnitudes)) / np.sqrt(_DRAWN))
    for number in sorted({*_SETTINGS, subject.analysis.draws}):

        def one(number: int = number) -> tuple[float, float]:
            errors = []
            for k in range(_DRAWN // number):
                inside = np.zeros(_DRAWN, dtype=bool)
                inside[k * number : (k + 1) * number] = True
                errors.append(np.nanmean(magnitudes[inside]) - np.nanmean(magnitudes[~inside]))
            return seconds * number, float(np.sqrt(np.nanmean(np.square(errors))))

        found.add(f"{number}", one, default=number == subject.analysis.draws)
    return [found.curve()]
