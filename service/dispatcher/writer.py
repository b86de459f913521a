"""Endings on their way into the database: what became of runs, in the order in which it did."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from service.dispatcher.outcomes import unstorable
from service.dispatcher.telemetry import DispatcherMetrics
from service.domain.payload import Payload
from service.runtime import logs
from service.store.faults import AWAY, StatementTooLongError
from service.store.leases import Lease, Outcome
from service.store.queue import Failure, RunQueue, Stored

_LOG = logging.getLogger(__name__)
_STORE_AT_ONCE = 1000


@dataclass(frozen=True)
class _Ending:
    """One transaction: ``items`` begin with a lease each, and may be written one by one as well."""

    write: Callable[[list[Any]], object]
    items: list[Any]
    refused: Callable[[Any, Exception], list[_Ending]]
    """What is written instead of a single one that the database refuses."""


class Writer:
    """Endings in a line, each of which stays at its head until the database has it.

    While the database is away nothing is dropped. One that it refuses for what it is - and not for when it comes - is
    set aside with its run, and keeps no other waiting.
    """

    def __init__(self, queue: RunQueue, metrics: DispatcherMetrics) -> None:
        self._queue = queue
        self._metrics = metrics
        self._line: deque[_Ending] = deque()

    def __len__(self) -> int:
        return len(self._line)

    def store(self, results: Sequence[tuple[Lease, Payload]]) -> None:
        """Results to be stored, a thousand in one transaction."""
        for first in range(0, len(results), _STORE_AT_ONCE):
            some = list(results[first : first + _STORE_AT_ONCE])
            self._line.append(_Ending(self._store, some, lambda one, error: [self._failed(one[0], unstorable(error))]))

    def fail(self, lease: Lease, failure: Failure) -> None:
        """A run whose attempt has failed."""
        self._line.append(self._failed(lease, failure))

    def cancel(self, lease: Lease) -> None:
        """A run whose grid was cancelled."""
        self._add([lease], lambda items: self._queue.cancel_leased(items[0][0]))

    def refuse_engine(self, lease: Lease, engine: str) -> None:
        """A run that another engine has answered."""
        self._add([lease], lambda items: self._queue.refuse_engine(items[0][0], engine))

    def lose(self, lease: Lease, detail: str, outcome: Outcome = Outcome.FORGOTTEN) -> None:
        """A run that went missing through no fault of its own."""
        self._add([lease], lambda items: self._queue.requeue_lost(items[0][0], outcome, detail))

    def suspect(self, leases: Iterable[Lease], detail: str) -> None:
        """Runs one of which is to blame."""
        self._add(leases, lambda items: self._queue.suspect([lease for (lease,) in items], detail))

    def hand_back(self, leases: Iterable[Lease], outcome: Outcome) -> None:
        """Runs that go back to the queue."""
        self._add(leases, lambda items: self._queue.hand_back([lease for (lease,) in items], outcome))

    def write(self) -> None:
        """Write all of them.

        Raises
        ------
        sqlalchemy.exc.DBAPIError
            The database is away; what is left waits.
        """
        while self._line:
            ending = self._line[0]
            try:
                ending.write(ending.items)
            except Exception as error:  # noqa: BLE001 - one that ended the dispatcher would end the next one too
                instead = self._instead(ending, error)
                self._line.popleft()
                self._line.extendleft(reversed(instead))
            else:
                self._line.popleft()

    def _instead(self, ending: _Ending, error: Exception) -> list[_Ending]:
        """What to write instead of what could not be written; the error again where the database is away."""
        several = len(ending.items) > 1
        # What takes too long together may be quick enough one by one.
        if isinstance(error, AWAY) and not (several and isinstance(error, StatementTooLongError)):
            raise error
        if several:
            # Nothing was written; each is tried alone, so that one that is refused keeps no other out.
            return [replace(ending, items=[one]) for one in ending.items]
        (lease, *_) = ending.items[0]
        _LOG.error("the end of run %s is refused", lease.run_id, exc_info=error, extra=logs.fields_of(lease))
        return ending.refused(ending.items[0], error)

    def _add(self, leases: Iterable[Lease], write: Callable[[list[Any]], object]) -> None:
        self._line.append(_Ending(write, [(lease,) for lease in leases], self._set_aside))

    def _failed(self, lease: Lease, failure: Failure) -> _Ending:
        return _Ending(lambda items: self._queue.fail(items[0][0], failure), [(lease,)], self._set_aside)

    def _set_aside(self, item: tuple[Lease], reason: Exception) -> list[_Ending]:
        self._metrics.refusals.labels("ending").inc()
        # Should that be refused too, the run stays as it is, and the next reconciliation finds a lease without a run.
        return [_Ending(lambda items: self._queue.set_aside(items[0][0], reason), [item], lambda _, __: [])]

    def _store(self, results: list[tuple[Lease, Payload]]) -> None:
        for (lease, _), outcome in zip(results, self._queue.store_all(results), strict=True):
            if outcome is not Stored.STORED:
                told = logs.fields_of(lease)
                _LOG.warning("run %s, attempt %d came too late: %s", lease.run_id, lease.attempt, outcome, extra=told)
