"""Runs that are claimed before a worker is free for them, so that a short one does not wait for the database.

They wait here and not on a worker: what is on a worker that dies stays known, and nobody is suspected beside it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator

from service.store.leases import Lease


class Ahead:
    """Leases without a worker, in the order of the queue, by the engine that they were claimed for."""

    def __init__(self) -> None:
        self._waiting: dict[str, deque[Lease]] = {}

    def __len__(self) -> int:
        return sum(len(leases) for leases in self._waiting.values())

    def __iter__(self) -> Iterator[Lease]:
        for leases in self._waiting.values():
            yield from leases

    def put(self, engine: str, leases: list[Lease]) -> None:
        """Keep leases until a worker is free."""
        self._waiting.setdefault(engine, deque()).extend(leases)

    def count(self, engine: str) -> int:
        """How many wait for an engine."""
        return len(self._waiting.get(engine, ()))

    def take(self, engine: str, free: int, threads: int, batch: int) -> list[Lease]:
        """Leases for ``free`` of so many worker threads: ``batch`` for each, or a fair share where fewer are left."""
        waiting = self._waiting.get(engine, deque())
        share = math.ceil(len(waiting) * free / max(threads, 1))
        return [waiting.popleft() for _ in range(min(free * batch, share, len(waiting)))]

    def take_where(self, wanted: Callable[[Lease], bool]) -> list[Lease]:
        """Take out every lease that is ``wanted``."""
        found = [lease for lease in self if wanted(lease)]
        for engine, leases in self._waiting.items():
            self._waiting[engine] = deque(lease for lease in leases if not wanted(lease))
        return found

    def take_engines_but(self, engines: set[str]) -> list[Lease]:
        """Take out what waits for engines that no worker carries."""
        return [lease for engine in self._waiting.keys() - engines for lease in self._waiting.pop(engine)]
