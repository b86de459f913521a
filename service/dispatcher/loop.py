"""The dispatcher's loop: claim, submit, collect, store, reconcile."""

from __future__ import annotations

import logging
import queue as queues
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import CancelledError
from dataclasses import dataclass
from functools import partial
from threading import Event
from typing import Any

from sqlalchemy.exc import DBAPIError, InterfaceError, OperationalError

from service.dispatcher.endings import overdue, read_answer, read_exception, unstorable
from service.dispatcher.heartbeat import Heartbeat
from service.dispatcher.pool import Pool, is_lost
from service.payload import ResultPayload
from service.settings import Settings
from service.store.leases import Lease, Outcome
from service.store.queue import Failure, RunQueue, Stored

_LOG = logging.getLogger(__name__)
_GATHER_S = 30.0
_CANCEL_LOOK_S = 1.0
_MAX_BACK_OFF_S = 10.0
_EMPTY_LOOKS = 3


@dataclass
class _Flight:
    lease: Lease
    future: Any
    started: float


class Dispatcher:
    """One leader's work, from its first claim until it stops.

    Endings (results and failures) wait in a line until the database has them: while one cannot be written nothing
    is claimed, and no result is dropped because the database was away.
    """

    def __init__(self, settings: Settings, queue: RunQueue, pool: Pool, heartbeat: Heartbeat, generation: int) -> None:
        self._settings = settings
        self._queue = queue
        self._pool = pool
        self._heartbeat = heartbeat
        self._generation = generation
        self._flights: dict[str, _Flight] = {}
        self._done: queues.SimpleQueue[str] = queues.SimpleQueue()
        self._endings: deque[Callable[[], object]] = deque()
        self._back_off = 0.0
        self._empty_looks = 0
        self._due = {"cancel": 0.0, "reconcile": 0.0}

    def run(self, stop: Event) -> None:
        """Dispatch until ``stop`` is set, the leadership is lost or the scheduler is gone."""
        while not (stop.is_set() or self._heartbeat.lost.is_set()):
            if not self._pool.running:
                _LOG.error("the scheduler is gone")
                return
            try:
                self._step()
                self._back_off = 0.0
            except (OperationalError, InterfaceError) as error:
                self._back_off = min(max(2 * self._back_off, 0.2), _MAX_BACK_OFF_S)
                _LOG.warning("the database is away, next try in %.1f s: %s", self._back_off, error.orig)
                stop.wait(self._back_off)

    def hand_back(self) -> None:
        """Write what has ended, give the rest back to the queue, uncharged."""
        self._collect(0.001)
        self._write_endings()
        leases = [flight.lease for flight in self._flights.values()]
        self._flights.clear()
        if leases:
            _LOG.info("handing back %d runs", self._queue.hand_back(leases))

    def _step(self) -> None:
        self._write_endings()
        self._fill()
        # With every worker busy there is nothing to look for in the queue until one of them is done.
        busy = len(self._flights) >= self._pool.threads() > 0
        self._collect(_CANCEL_LOOK_S if busy else self._settings.poll_s)
        self._write_endings()
        if self._is_due("cancel", _CANCEL_LOOK_S) and self._flights:
            self._stop_cancelled()
        if self._is_due("reconcile", self._settings.reconcile_s):
            self._reconcile()

    def _fill(self) -> None:
        """Claim and submit as many runs as there is room for."""
        threads = self._pool.threads()
        self._heartbeat.workers = threads
        room = min(self._settings.window or threads, threads) - len(self._flights)
        if room <= 0 or not self._queue.waiting():
            return
        for lease in self._queue.claim(self._generation, room):
            key = lease.key
            future = self._pool.submit(lease, lambda _, key=key: self._done.put(key))  # type: ignore[misc]
            self._flights[key] = _Flight(lease, future, time.monotonic())

    def _collect(self, wait_s: float) -> None:
        """Turn runs that Dask has ended into endings, waiting for the first of them."""
        try:
            self._land(self._done.get(timeout=wait_s))
            while True:
                self._land(self._done.get_nowait())
        except queues.Empty:
            return

    def _land(self, key: str) -> None:
        flight = self._flights.get(key)
        if flight is None or is_lost(flight.future):
            return  # stopped by us, or for the reconciliation to look at
        lease = flight.lease
        ending: ResultPayload | Failure
        if flight.future.status == "error":
            ending = read_exception(flight.future.exception(timeout=_GATHER_S))
        else:
            try:
                ending = read_answer(lease, flight.future.result(timeout=_GATHER_S))
            except (OSError, TimeoutError, CancelledError):
                return  # the worker went before its answer was fetched: the reconciliation finds out what is left
            except Exception as error:  # noqa: BLE001 - the answer came from another process and may be anything
                ending = read_exception(error)
        del self._flights[key]
        if isinstance(ending, Failure):
            _LOG.warning("run %s, attempt %d: %s", lease.run_id, lease.attempt, ending.detail)
            self._endings.append(partial(self._queue.fail, lease, ending))
        else:
            self._endings.append(partial(self._store, lease, ending))

    def _store(self, lease: Lease, payload: ResultPayload) -> None:
        try:
            stored = self._queue.store(lease, payload)
        except (OperationalError, InterfaceError):
            raise
        except DBAPIError as error:
            _LOG.exception("run %s cannot be stored", lease.run_id)
            self._queue.fail(lease, unstorable(error))
            return
        if stored is not Stored.STORED:
            _LOG.warning("run %s, attempt %d came too late: %s", lease.run_id, lease.attempt, stored)

    def _write_endings(self) -> None:
        while self._endings:
            self._endings[0]()
            self._endings.popleft()

    def _stop_cancelled(self) -> None:
        cancelled = set(self._queue.to_cancel(self._generation))
        for key, flight in list(self._flights.items()):
            if flight.lease.run_id in cancelled:
                # First the database, then the worker: whatever comes back now finds its lease gone.
                self._queue.cancel_leased(flight.lease)
                del self._flights[key]
                self._pool.stop(flight.future)

    def _reconcile(self) -> None:
        """Compare what is in flight with what Dask and the database think."""
        now = time.monotonic()
        # Several looks in a row: workers that are away for a moment come back to what they were doing.
        self._empty_looks = 0 if self._pool.threads() else self._empty_looks + 1
        stranded = self._empty_looks >= _EMPTY_LOOKS
        for key, flight in list(self._flights.items()):
            lease = flight.lease
            if stranded or is_lost(flight.future):
                self._queue.requeue_lost(lease, Outcome.FORGOTTEN, "no workers" if stranded else "unknown to Dask")
                del self._flights[key]
                flight.future.cancel()
            elif now - flight.started > self._settings.deadline_s:
                self._queue.fail(lease, overdue(self._settings.deadline_s))
                del self._flights[key]
                self._pool.stop(flight.future)
            elif flight.future.done():
                self._done.put(key)  # in case the callback was lost
        self._queue.requeue_forgotten(self._generation, [f.lease.run_id for f in self._flights.values()])

    def _is_due(self, what: str, every_s: float) -> bool:
        if time.monotonic() < self._due[what]:
            return False
        self._due[what] = time.monotonic() + every_s
        return True
