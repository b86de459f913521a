"""Which worker has room for which run: one run a thread, a suspect alone."""

from __future__ import annotations

from collections.abc import Sequence

from service.dispatcher.pool import Worker


class Slots:
    """What is on which worker.

    A worker with a suspect takes nothing else, and one suspect is under way at a time, of whatever engine: what dies
    with it, it did. While none is under way and a suspect of an engine waits for a worker of its own, the emptiest of
    that engine takes no more runs.
    """

    def __init__(self) -> None:
        self._on: dict[str, set[str]] = {}
        self._kept: dict[str, str] = {}
        """Worker that is being emptied, by the engine of the suspect that it is for."""
        self._suspect: tuple[str, str] | None = None
        """The suspect under way: its worker and its key."""

    def take(self, address: str, key: str, *, alone: bool) -> None:
        """Put a run on a worker."""
        self._on.setdefault(address, set()).add(key)
        if alone:
            self._suspect = address, key
            # The next one starts when this has ended, which may take an hour.
            self._kept.clear()

    def release(self, address: str, key: str) -> None:
        """Take a run off its worker."""
        self._on.get(address, set()).discard(key)
        if not self._on.get(address):
            self._on.pop(address, None)
        if self._suspect == (address, key):
            self._suspect = None

    def clear(self) -> None:
        """Nothing is on any worker."""
        self._on.clear()
        self._kept.clear()
        self._suspect = None

    def free(self, workers: Sequence[Worker]) -> list[Worker]:
        """A worker for each run that there is room for, the emptiest first; a worker with room for two twice."""
        rounds = []
        for worker in workers:
            alone = self._suspect is not None and self._suspect[0] == worker.address
            if not alone and self._kept.get(worker.engine) != worker.address:
                taken = len(self._on.get(worker.address, ()))
                rounds += [(place, worker.address, worker) for place in range(taken, worker.threads)]
        return [worker for _, _, worker in sorted(rounds, key=lambda place: place[:2])]

    def lane(self, engine: str, workers: Sequence[Worker]) -> Worker | None:
        """A worker with nothing on it for the engine's next suspect; None while one is under way or none is empty."""
        self._kept.pop(engine, None)
        if self._suspect is not None or not workers:
            return None
        emptiest = min(workers, key=lambda worker: (len(self._on.get(worker.address, ())), worker.address))
        if self._on.get(emptiest.address):
            self._kept[engine] = emptiest.address
            return None
        return emptiest

    def no_suspects(self, engine: str) -> None:
        """None of the engine waits, so none of its workers has to be emptied for one."""
        self._kept.pop(engine, None)
