"""Which runs are claimed, and for which of the free workers."""

from __future__ import annotations

import time
from collections.abc import Sequence

from service.dispatcher.flights import Flights
from service.dispatcher.pool import Pool, Worker
from service.store.queue import RunQueue

_LOOK_S = 1.0
_NO_WINDOW = 1_000_000


class Claims:
    """Claims as many runs as there is room for, a suspect first, and starts each where it has room.

    Parameters
    ----------
    queue, generation
        Whom they are claimed from, and as which leader.
    flights
        Where there is room, and where claimed runs go at once: nothing is claimed that no worker is free for.
    window
        Runs in flight at most, whatever the workers have room for; None for no such limit.
    """

    def __init__(self, queue: RunQueue, generation: int, flights: Flights, window: int | None) -> None:
        self._queue = queue
        self._generation = generation
        self._flights = flights
        self._window = window
        self._turn = 0
        self._suspects: set[str] = set()
        """Engines for which a suspect waits."""
        self._asked: dict[str, float] = {}
        """When it was last seen whether a suspect of an engine waits."""

    def fill(self, pool: Pool, workers: Sequence[Worker]) -> None:
        """Claim and start what these workers have room for."""
        engines = sorted({worker.engine for worker in workers})
        # Each first in its turn: what only one of them can have, a suspect or the last of the window, goes round.
        self._turn = (self._turn + 1) % max(len(engines), 1)
        for engine in engines[self._turn :] + engines[: self._turn]:
            mine = [worker for worker in workers if worker.engine == engine]
            self._fill_lane(pool, engine, mine)
            free = self._flights.slots.free(mine)
            wanted = min(len(free), self._room())
            if wanted > 0 and self._queue.waiting(engine):
                self._start(pool, wanted, engine, free)

    def _fill_lane(self, pool: Pool, engine: str, workers: Sequence[Worker]) -> None:
        """Give the next suspect a worker of its own."""
        if time.monotonic() - self._asked.get(engine, float("-inf")) >= _LOOK_S:
            self._asked[engine] = time.monotonic()
            if self._queue.waiting(engine, suspects=True):
                self._suspects.add(engine)
            else:
                self._suspects.discard(engine)
                self._flights.slots.no_suspects(engine)
        lane = self._flights.slots.lane(engine, workers) if engine in self._suspects and self._room() else None
        if lane is not None:
            self._suspects.discard(engine)
            self._start(pool, 1, engine, [lane], suspects=True)

    def _start(self, pool: Pool, wanted: int, engine: str, free: Sequence[Worker], *, suspects: bool = False) -> None:
        leases = self._queue.claim(self._generation, wanted, engine, suspects=suspects)
        for lease, worker in zip(leases, free, strict=False):
            self._flights.start(pool, lease, worker)

    def _room(self) -> int:
        return max((self._window or _NO_WINDOW) - len(self._flights), 0)
