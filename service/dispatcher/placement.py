"""Which worker has room for which run: one run a thread, a suspect alone."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

from service.dispatcher.pool import Worker

_SPREAD = 0.2


class Slots:
    """What is on which worker.

    A worker with a suspect takes nothing else, and one suspect is under way at a time: whatever dies with it, it did.
    While a suspect waits for a worker of its own, the emptiest takes no more runs.
    """

    def __init__(self, lifetime_s: float | None = None) -> None:
        self._lifetime_s = lifetime_s
        self._on: dict[str, set[str]] = {}
        self._lane: str | None = None
        self._suspect: str | None = None

    def take(self, address: str, key: str, *, alone: bool) -> None:
        """Put a run on a worker."""
        self._on.setdefault(address, set()).add(key)
        if alone:
            self._lane, self._suspect = address, key

    def release(self, address: str, key: str) -> None:
        """Take a run off its worker."""
        self._on.get(address, set()).discard(key)
        if not self._on.get(address):
            self._on.pop(address, None)
        if key == self._suspect:
            self._lane = self._suspect = None

    def clear(self) -> None:
        """Nothing is on any worker."""
        self._on.clear()
        self._lane = self._suspect = None

    def free(self, workers: Sequence[Worker]) -> list[Worker]:
        """A worker for each run that there is room for, the emptiest first; a worker with room for two twice."""
        rounds = []
        for worker in workers:
            if worker.address != self._lane:
                taken = len(self._on.get(worker.address, ()))
                rounds += [(place, worker.address, worker) for place in range(taken, worker.threads)]
        return [worker for _, _, worker in sorted(rounds, key=lambda place: place[:2])]

    def lane(self, workers: Sequence[Worker]) -> Worker | None:
        """A worker with nothing on it for the next suspect; None while one is under way or no worker is empty yet."""
        if self._suspect is not None or not workers:
            return None
        self._lane = None
        emptiest = min(workers, key=lambda worker: (len(self._on.get(worker.address, ())), worker.address))
        if self._on.get(emptiest.address):
            self._lane = emptiest.address
            return None
        return emptiest

    def no_suspects(self) -> None:
        """None waits, so no worker has to be emptied for one."""
        if self._suspect is None:
            self._lane = None

    def outlived(self, workers: Sequence[Worker], now: float) -> list[str]:
        """Idle workers that are older than they may become: each at an age of its own, or all would go at once."""
        if self._lifetime_s is None:
            return []
        old = []
        for worker in workers:
            die = hashlib.sha256(worker.address.encode()).digest()[0] / 255.0
            lifetime = self._lifetime_s * (1.0 + _SPREAD * (2.0 * die - 1.0))
            if now - worker.since > lifetime and not self._on.get(worker.address):
                old.append(worker.address)
        return old
