"""Runs on their way through a worker, each a Dask task of its own."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from distributed.client import ClosedClientError

from service.dispatcher.placement import Slots
from service.dispatcher.pool import Pool, Worker
from service.dispatcher.stalls import WorkerMemory
from service.store.leases import Lease
from service.worker.answers import Answer, read_answer

GATHER_S = 30.0
"""How long what a worker said may take to come, at most."""
_FETCH_S = 1.0
_GONE_S = 1.0
"""Long enough for Dask to have said that a worker died with a run, if it had."""


@dataclass
class Flight:
    """A run on a worker."""

    lease: Lease
    worker: str
    memory: WorkerMemory
    """Of its worker."""
    future: Any
    started: float
    missed: float | None = None
    """Since when its worker has been gone."""
    answered: bool = False
    """Whether it has come to its end on its worker, which may be at the next run while the answer is fetched."""
    patience_s: float = _FETCH_S
    """How long the next look waits for the answer."""

    def fetch(self) -> Answer:
        """The answer of the Dask task, which has ended; TimeoutError where it does not come for now.

        Dask waits on for a worker that never returns, and everything else would wait with it: hence a short wait, and
        a longer one at each later look, for a large answer over a slow line.
        """
        try:
            return read_answer(self.future.result(timeout=self.patience_s))
        except TimeoutError:
            self.patience_s = min(2.0 * self.patience_s, GATHER_S)
            raise

    def drop(self) -> None:
        """Let Dask forget it."""
        # Dask's client closes itself when the scheduler is gone, and this may be the moment.
        with suppress(ClosedClientError):
            self.future.cancel()


class Flights:
    """All that is on workers; ``slots`` says where there is room for more."""

    def __init__(self) -> None:
        self.slots = Slots()
        self._flying: dict[str, Flight] = {}
        self._ended: queue.SimpleQueue[str] = queue.SimpleQueue()

    def __len__(self) -> int:
        return len(self._flying)

    def __contains__(self, flight: Flight) -> bool:
        return flight.lease.key in self._flying

    def __iter__(self) -> Iterator[Flight]:
        return iter(list(self._flying.values()))

    def start(self, pool: Pool, lease: Lease, worker: Worker) -> None:
        """Give a run to a worker."""
        self.slots.take(worker.address, lease.key, alone=lease.suspect)
        future = pool.submit(lease, worker)
        self._flying[lease.key] = Flight(lease, worker.address, worker.memory, future, time.monotonic())
        future.add_done_callback(lambda done: self._ended.put(done.key))

    def ended(self, wait_s: float) -> list[Flight]:
        """Flights that Dask has ended since the last look, after a wait for the first; their workers have room."""
        keys: list[str] = []
        with suppress(queue.Empty):
            keys.append(self._ended.get(block=wait_s > 0.0, timeout=wait_s))
            while True:
                keys.append(self._ended.get_nowait())
        found = [self._flying[key] for key in dict.fromkeys(keys) if key in self._flying]
        for flight in found:
            if flight.future.status == "finished":
                flight.answered = True
                self.slots.release(flight.worker, flight.lease.key)
        return found

    def look_again(self, flight: Flight) -> None:
        """Let the next look find a flight among those that have ended."""
        self._ended.put(flight.lease.key)

    def take(self, flight: Flight) -> Flight:
        """Take one out."""
        del self._flying[flight.lease.key]
        self.slots.release(flight.worker, flight.lease.key)
        return flight

    def take_where(self, wanted: Callable[[Flight], bool]) -> list[Flight]:
        """Take out every one that is ``wanted``."""
        return [self.take(flight) for flight in self if wanted(flight)]

    def take_on(self, worker: str) -> list[Flight]:
        """Take out what is on a worker."""
        return self.take_where(lambda flight: flight.worker == worker)

    def take_missing(self, present: Collection[str]) -> list[Flight]:
        """Take out what is on workers that have been gone for a moment without Dask having blamed anyone."""
        now = time.monotonic()
        for flight in self._flying.values():
            if flight.worker in present:
                flight.missed = None
            elif flight.missed is None:
                flight.missed = now
        return self.take_where(
            lambda one: one.missed is not None and now - one.missed > _GONE_S and not one.future.done()
        )

    def oldest(self) -> dict[str, float]:
        """Since when each worker with runs has had the oldest of them, on the monotonic clock."""
        busy: dict[str, float] = {}
        for flight in self._flying.values():
            busy[flight.worker] = min(busy.get(flight.worker, flight.started), flight.started)
        return busy

    def clear(self) -> None:
        """Nothing is on any worker."""
        self._flying.clear()
        self.slots.clear()


def stop_workers_of(flights: Sequence[Flight], pool: Pool) -> None:
    """End the workers of runs that are no longer wanted; what is beside them goes back once the worker is gone."""
    if flights:
        pool.stop({flight.worker for flight in flights}, [flight.future for flight in flights])
