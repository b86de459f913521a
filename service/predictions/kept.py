"""Predictors that are kept between requests: reading their runs and fitting them takes seconds."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable
from threading import Lock

from sqlalchemy import Connection

from engine import Predictor, SimulatedRun
from service.predictions.shipped import shipped_predictor, shipped_runs
from service.store.bias_rows import content
from service.store.result_filter import ResultFilter
from service.store.simulated_runs import simulated_runs

_MOST = 8

Kept = tuple[tuple[SimulatedRun, ...], Predictor]


class KeptPredictors:
    """Predictors by the runs that they were made of; the least used go first."""

    def __init__(self) -> None:
        self._kept: OrderedDict[Hashable, Kept] = OrderedDict()
        self._lock = Lock()

    def find(self, connection: Connection | None, study: bool, grids: list[str]) -> Kept:
        """The runs that are meant, and a predictor of them; without a ``connection`` those that come with hostlens."""
        if connection is None:
            return shipped_runs(), shipped_predictor()
        key: Hashable = (study, tuple(grids), content(connection, ResultFilter.read({"grid": grids})))
        with self._lock:
            found = self._kept.pop(key, None)
            if found is None:
                runs = (*(shipped_runs() if study else ()), *simulated_runs(connection, grids))
                found = runs, Predictor(runs)
            self._kept[key] = found
            while len(self._kept) > _MOST:
                self._kept.popitem(last=False)
            return found
