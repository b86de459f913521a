"""The dispatcher's loop: claim, collect, store, look after what went wrong, reconcile."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import CancelledError
from pathlib import Path
from threading import Event

from distributed import KilledWorker
from sqlalchemy.exc import SQLAlchemyError

from service.dispatcher.backlog import PATIENCE_S, Backlog
from service.dispatcher.blame import Blame
from service.dispatcher.claims import Claims
from service.dispatcher.flights import GATHER_S, Flight, Flights, stop_workers_of
from service.dispatcher.heartbeat import Heartbeat
from service.dispatcher.landing import Landing
from service.dispatcher.outcomes import overdue
from service.dispatcher.pickle_guard import read_error
from service.dispatcher.pool import Pool, Worker, is_lost
from service.dispatcher.telemetry import DispatcherMetrics
from service.dispatcher.writer import Writer
from service.runtime import logs
from service.runtime.settings import Settings
from service.store.artefacts import ArtefactStore
from service.store.faults import AWAY
from service.store.leadership import LeadershipLostError
from service.store.leases import Lease, Outcome, Pair
from service.store.queue import RunQueue
from service.worker.answers import Answer

_LOG = logging.getLogger(__name__)
_LOOK_S = 1.0
_AGAIN_S = 10.0
_MAX_BACK_OFF_S = 10.0
_EMPTY_LOOKS = 3


class Dispatcher:
    """One leader's work, from its first claim until it stops, on one pool of workers after another.

    Endings (results and failures) wait in a line until the database has them: while one cannot be written nothing
    is claimed, and no result is dropped because the database was away. Nor because the artefact store was: results
    whose artefacts it did not take are held until it does.
    """

    def __init__(
        self,
        settings: Settings,
        queue: RunQueue,
        heartbeat: Heartbeat,
        generation: int,
        metrics: DispatcherMetrics | None = None,
    ) -> None:
        self._settings = settings
        self._queue = queue
        self._heartbeat = heartbeat
        self._generation = generation
        self._pool: Pool
        self._back_off = 0.0
        self._empty_looks = 0
        self._due: dict[str, float] = {}
        self._metrics = metrics or DispatcherMetrics()
        self._flights = Flights()
        self._claims = Claims(queue, generation, self._flights, settings.window)
        self._endings = Writer(queue, self._metrics)
        self._blame = Blame(self._flights, self._endings, self._metrics)
        self._backlog = Backlog(ArtefactStore(settings.artefacts, PATIENCE_S), Path(settings.scratch), self._metrics)
        self._landing = Landing(self._endings, self._backlog)
        self._metrics.in_flight.set_function(lambda: len(self._flights))
        self._metrics.worker_threads.set_function(lambda: sum(self._heartbeat.engines.values()))

    def run(self, pool: Pool, stop: Event) -> None:
        """Dispatch until ``stop`` is set, the leadership is lost or the scheduler is gone.

        Raises
        ------
        service.store.leadership.LeadershipLostError
            Another dispatcher leads.
        """
        self._pool = pool
        self._empty_looks = 0
        while not (stop.is_set() or self._heartbeat.lost.is_set()):
            if not pool.running:
                _LOG.error("the scheduler is gone")
                return
            with self._metrics.loops.time():
                self._guarded(self._step, stop.wait)

    def drain(self) -> None:
        """Claim nothing more, and wait a little for what is about to end; a run that takes longer is handed back."""
        until = time.monotonic() + self._settings.drain_s
        while self._flights and self._pool.running and time.monotonic() < until and not self._heartbeat.lost.is_set():
            self._guarded(self._land_and_write, time.sleep)

    def hand_back(self, outcome: Outcome = Outcome.HANDED_BACK) -> None:
        """Write what has ended, give the rest back to the queue, uncharged; without the database both wait."""
        self._land(self._flights.ended(0.001))
        self._landing.attend()
        gone = [flight.lease for flight in (*self._flights, *self._blame.deaths.take_back())]
        if outcome is Outcome.HANDED_BACK:
            gone += self._backlog.take_where(lambda _: True)  # what is held needs no workers, only this process
        self._flights.clear()
        if gone:
            _LOG.info("handing back %d runs: %s", len(gone), outcome)
            self._endings.hand_back(gone, outcome)
        self._endings.write()

    def _guarded(self, step: Callable[[], None], wait: Callable[[float], object]) -> None:
        """One step; where the database is away, a wait that grows."""
        try:
            step()
            self._back_off = 0.0
        except AWAY as error:
            self._due.pop("look", None)  # anything may have been cancelled meanwhile
            self._back_off = min(max(2 * self._back_off, 0.2), _MAX_BACK_OFF_S)
            _LOG.warning("the database is away, next try in %.1f s: %s", self._back_off, error)
            wait(self._back_off)

    def _try(self, what: str, step: Callable[[], None]) -> None:
        """A part of a step; where the database refuses it for what it is, the others go on, and it is tried later."""
        if time.monotonic() < self._due.get(f"again {what}", 0.0):
            return
        try:
            step()
        except (*AWAY, LeadershipLostError):
            raise
        except (SQLAlchemyError, ValueError, TypeError):
            _LOG.exception("the step %s is refused, next try in %.0f s", what, _AGAIN_S)
            self._metrics.refusals.labels(what).inc()
            self._due[f"again {what}"] = time.monotonic() + _AGAIN_S

    def _step(self) -> None:
        self._landing.attend()
        self._endings.write()
        workers = self._pool.workers()
        self._tell(workers)
        if self._is_due("look", _LOOK_S):
            self._try("look", self._look)
        self._claim()
        # With every worker busy there is nothing to look for in the queue until one of them is done.
        busy = bool(workers) and not self._flights.slots.free(workers)
        self._collect(_LOOK_S if busy else self._settings.poll_s)
        self._blame.look_for_deaths(self._pool)
        self._blame.replace_stalled(self._pool)
        self._endings.write()
        if self._is_due("reconcile", self._settings.reconcile_s):
            self._try("reconcile", self._reconcile)
        if self._is_due("upkeep", self._settings.reconcile_s):
            self._try("upkeep", self._keep_up)

    def _keep_up(self) -> None:
        if self._queue.upkeep.step():
            self._due["upkeep"] = 0.0  # there may be more, which waits for the next step and not for longer

    def _land_and_write(self) -> None:
        self._land(self._flights.ended(0.1))
        self._landing.attend()
        self._blame.look_for_deaths(self._pool)
        self._endings.write()

    def _tell(self, workers: list[Worker]) -> None:
        engines: Counter[str] = Counter()
        for worker in workers:
            engines[worker.engine] += worker.threads
        if engines != self._heartbeat.engines:
            self._heartbeat.engines = dict(engines)
        self._heartbeat.artefacts_away = self._backlog.away is not None
        self._metrics.workers_unfit.set(len(self._pool.present() or ()) - len(workers))

    def _claim(self) -> None:
        if self._backlog.away is None:
            self._try("claim", lambda: self._claims.fill(self._pool, self._pool.workers()))

    def _collect(self, wait_s: float) -> None:
        """Turn runs that Dask has ended into endings, waiting for the first of them."""
        ended = self._flights.ended(wait_s)
        try:
            if ended:
                # Their workers have the next runs before these answers are fetched and stored.
                self._claim()
        finally:
            self._land(ended)

    def _land(self, ended: list[Flight]) -> None:
        answered: list[tuple[Lease, Answer | BaseException]] = []
        for flight in ended:
            said = self._said(flight)
            if said is not None:
                # Where nobody said so, nobody knows what it left behind.
                flight.memory.latest = said.memory if isinstance(said, Answer) else None
                answered.append((self._flights.take(flight).lease, said))
        self._landing.land(answered)

    def _said(self, flight: Flight) -> Answer | BaseException | None:
        """What came of a flight that Dask has ended; None where that is not known, or not from here."""
        if flight not in self._flights or is_lost(flight.future):
            return None  # went with another on its worker; stopped by us, or for the reconciliation to look at
        if flight.future.status == "error":
            error = read_error(flight.future.exception(timeout=GATHER_S))
            if isinstance(error, KilledWorker):
                self._blame.bury(flight.worker, self._pool)
                return None
            return error
        try:
            return flight.fetch()
        except (OSError, TimeoutError, CancelledError):
            return None  # the worker went before its answer was fetched: a later look finds out what is left
        except Exception as broken:  # noqa: BLE001 - the answer came from another process and may be anything
            return broken

    def _look(self) -> None:
        """End what has been cancelled."""
        if not (self._flights or self._backlog.leases):
            return
        cancelled = self._queue.to_cancel(self._generation)
        # What comes back from a worker now belongs to no flight, and its lease ends with the next write.
        stopped = self._flights.take_where(lambda flight: flight.lease.pair in cancelled)
        waiting = self._backlog.take_where(lambda lease: lease.pair in cancelled)
        for lease in [*(flight.lease for flight in stopped), *waiting]:
            self._endings.cancel(lease)
        stop_workers_of(stopped, self._pool)
        self._endings.write()

    def _reconcile(self) -> None:
        """Compare what is in flight with what Dask and the database think."""
        now = time.monotonic()
        # Several looks in a row: workers that are away for a moment come back to what they were doing.
        self._empty_looks = 0 if self._pool.present() else self._empty_looks + 1
        stranded = self._empty_looks >= _EMPTY_LOOKS
        late = []
        for flight in self._flights:
            if stranded or is_lost(flight.future):
                self._blame.lose([self._flights.take(flight)], "no workers" if stranded else "unknown to Dask")
                flight.drop()
            elif now - flight.started > self._settings.deadline_s:
                late.append(self._flights.take(flight))
                self._endings.fail(flight.lease, overdue(self._settings.deadline_s))
            elif flight.future.done():
                self._flights.look_again(flight)  # its answer did not come, or the callback was lost
        stop_workers_of(late, self._pool)
        self._endings.write()
        self._drop_ended(self._queue.held(self._generation))
        known = [flight.lease for flight in (*self._flights, *self._blame.deaths.waiting)] + self._backlog.leases
        self._queue.requeue_forgotten(self._generation, [lease.pair for lease in known])
        self._queue.release_postdated()

    def _drop_ended(self, held: set[Pair]) -> None:
        """Stop working at runs whose leases have ended without us; what came of them would be dropped."""
        dropped = self._flights.take_where(lambda flight: flight.lease.pair not in held)
        waiting = self._backlog.take_where(lambda lease: lease.pair not in held)
        for lease in [*(flight.lease for flight in dropped), *waiting]:
            told = logs.fields_of(lease)
            _LOG.warning("run %s, attempt %d: its lease has ended", lease.run_id, lease.attempt, extra=told)
        stop_workers_of(dropped, self._pool)

    def _is_due(self, what: str, every_s: float) -> bool:
        if time.monotonic() < self._due.get(what, 0.0):
            return False
        self._due[what] = time.monotonic() + every_s
        return True
