"""Predictions for a lens from simulated runs of others: expected bias and scatter, and how near the runs are."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from threading import Lock

import numpy as np

from engine.conventions import FloatArray
from engine.errors import SpecError
from engine.prediction.model import LEAST_LENSES, BiasModel, Expected
from engine.prediction.traits import FEATURES, LensTraits, features

PREDICTED = ("magnitude", "r_eff", "n")
NEAR = 1.5
"""Distance beyond which no run is near: one large difference (:data:`engine.prediction.traits.FEATURES`) and a half, or
several that are as large together."""
_SHOWN_RUNS = 10


@dataclass(frozen=True)
class SimulatedRun:
    """A run that predictions learn from: which lens it is of, and by estimator and quantity (bias, stated sd).

    Quantities are ``magnitude`` [mag], ``r_eff`` [arcsec] and ``n``. Runs of one lens share what is particular to it,
    whatever their host, slope, depth and seed. ``cpu_s`` is what the run took.
    """

    run_id: str
    lens: str
    traits: LensTraits
    found: Mapping[str, Mapping[str, tuple[float, float]]]
    cpu_s: float | None = None


@dataclass(frozen=True)
class Range:
    """A number with the interval that holds it with the probability asked for."""

    expected: float
    low: float
    high: float


@dataclass(frozen=True)
class QuantityPrediction:
    """What is expected of one quantity, recovered minus true.

    ``bias`` is the mean over many images of this lens, with the interval of that mean; ``scatter`` the standard
    deviation of one measurement about it; ``measurement`` what a single image will show, both together.
    """

    bias: Range
    scatter: Range
    measurement: Range


@dataclass(frozen=True)
class EstimatorPrediction:
    """What is expected of one estimator, from how many ``runs`` of how many ``lenses``.

    ``distance`` is that to the nearest run, in large differences; ``differences`` those by feature. ``extrapolating``
    where it is above :data:`NEAR`. ``run_ids`` are the nearest runs, the nearest first. ``quantities`` is None for
    what the estimator does not measure.
    """

    quantities: Mapping[str, QuantityPrediction | None]
    runs: int
    lenses: int
    extrapolating: bool
    distance: float
    differences: Mapping[str, float]
    nearest_lens: str
    run_ids: tuple[str, ...]


class Predictor:
    """What simulated runs say of other lenses; models are fitted when they are first asked for (0.2 s each).

    May be asked from several threads.
    """

    def __init__(self, runs: Sequence[SimulatedRun]) -> None:
        self._runs = tuple(runs)
        self._x = np.array([features(run.traits) for run in self._runs]).reshape(-1, len(FEATURES))
        self._models: dict[tuple[str, str], BiasModel | None] = {}
        self._lock = Lock()

    def __len__(self) -> int:
        """How many runs there are."""
        return len(self._runs)

    def estimators(self) -> tuple[str, ...]:
        """Those that can be predicted: with runs of lenses enough."""
        lenses: dict[str, set[str]] = {}
        for run in self._runs:
            for name in run.found:
                lenses.setdefault(name, set()).add(run.lens)
        return tuple(sorted(name for name, known in lenses.items() if len(known) >= LEAST_LENSES))

    def predict(self, traits: LensTraits, estimator: str, level: float = 0.9) -> EstimatorPrediction:
        """What an estimator is expected to find in a lens, with intervals of probability ``level``.

        Raises
        ------
        SpecError
            There are not runs enough of the estimator, or the level is none.
        """
        if not 0.5 <= level <= 0.99:
            raise SpecError("level", level, "a probability from 0.5 to 0.99")
        if estimator not in self.estimators():
            raise SpecError(
                "estimators", estimator, f"one with runs of {LEAST_LENSES} lenses: {list(self.estimators())}"
            )
        x = features(traits)
        mine = [place for place, run in enumerate(self._runs) if estimator in run.found]
        distances = np.linalg.norm(self._x[mine] - x, axis=1)
        order = np.argsort(distances, kind="stable")
        nearest = mine[int(order[0])]
        return EstimatorPrediction(
            quantities={name: self._quantity(traits, x, estimator, name, level) for name in PREDICTED},
            runs=len(mine),
            lenses=len({self._runs[place].lens for place in mine}),
            extrapolating=bool(distances[order[0]] > NEAR),
            distance=float(distances[order[0]]),
            differences={name: float(d) for name, d in zip(FEATURES, x - self._x[nearest], strict=True)},
            nearest_lens=self._runs[nearest].lens,
            run_ids=tuple(self._runs[mine[int(place)]].run_id for place in order[:_SHOWN_RUNS]),
        )

    def _quantity(
        self, traits: LensTraits, x: FloatArray, estimator: str, name: str, level: float
    ) -> QuantityPrediction | None:
        model = self._model(estimator, name)
        return None if model is None else _in_units(model.expect(x, level), traits, name)

    def _model(self, estimator: str, name: str) -> BiasModel | None:
        with self._lock:
            if (estimator, name) not in self._models:
                self._models[estimator, name] = self._fitted(estimator, name)
            return self._models[estimator, name]

    def _fitted(self, estimator: str, name: str) -> BiasModel | None:
        """The model, or None where the quantity is held fixed: no run states a deviation for it."""
        mine = [place for place, run in enumerate(self._runs) if name in run.found.get(estimator, ())]
        found = np.array([_relative(self._runs[place], estimator, name) for place in mine]).reshape(-1, 2)
        names = [self._runs[place].lens for place in mine]
        places = {lens: number for number, lens in enumerate(dict.fromkeys(names))}
        if len(places) < LEAST_LENSES or not found[:, 1].any():
            return None
        lens = np.array([places[one] for one in names], dtype=np.intp)
        return BiasModel(self._x[mine], found[:, 0], found[:, 1], lens)


def _relative(run: SimulatedRun, estimator: str, name: str) -> tuple[float, float]:
    """Bias and deviation of a magnitude, or of the logarithm of a radius or an index."""
    bias, sd = run.found[estimator][name]
    if name == "magnitude":
        return bias, sd
    true = getattr(run.traits, name)
    return math.log1p(bias / true), sd / (true + bias)


def _in_units(found: Expected, traits: LensTraits, name: str) -> QuantityPrediction:
    """Of a magnitude as it is, of a radius or an index in its own units."""
    true: float | None = None if name == "magnitude" else getattr(traits, name)
    size = 1.0 if true is None else true * math.exp(found.mean)

    def bias(*values: float) -> Range:
        return Range(*(value if true is None else true * math.expm1(value) for value in values))

    return QuantityPrediction(
        bias=bias(found.mean, found.mean_low, found.mean_high),
        scatter=Range(*(size * value for value in (found.scatter, found.scatter_low, found.scatter_high))),
        measurement=bias(found.mean, found.low, found.high),
    )
