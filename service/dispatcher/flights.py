"""A run on its way through a worker, as the dispatcher's loop knows it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from service.dispatcher.stalls import WorkerMemory
from service.store.leases import Lease
from service.worker.answers import Answers, read_answers

GATHER_S = 30.0
"""How long what a worker said may take to come, at most."""
_FETCH_S = 1.0


@dataclass
class Flight:
    """A run on a worker: at ``place`` of the answers of a Dask task, where ``beside`` others are too."""

    lease: Lease
    worker: str
    engine: str
    memory: WorkerMemory
    """Of its worker."""
    future: Any
    place: int
    beside: int
    started: float
    missed: float | None = None
    """Since when its worker has been gone."""
    answered: bool = False
    """Whether it has come to its end on its worker, which may be at the next run while the answer is fetched."""
    patience_s: float = _FETCH_S
    """How long the next look waits for the answer."""

    def fetch(self) -> Answers:
        """The answers of the Dask task, which has ended; TimeoutError where they do not come for now.

        Dask waits on for a worker that never returns, and everything else would wait with it: hence a short wait, and
        a longer one at each later look, for a large answer over a slow line.
        """
        try:
            return read_answers(self.future.result(timeout=self.patience_s), self.beside + 1)
        except TimeoutError:
            self.patience_s = min(2.0 * self.patience_s, GATHER_S)
            raise
