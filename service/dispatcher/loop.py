"""The dispatcher's loop: claim, place, collect, store, reconcile."""

from __future__ import annotations

import logging
import math
import queue as queues
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import CancelledError
from contextlib import suppress
from pathlib import Path
from threading import Event
from typing import Any

from distributed import KilledWorker
from sqlalchemy.exc import SQLAlchemyError

from service.dispatcher.ahead import Ahead
from service.dispatcher.backlog import PATIENCE_S, Holding, NoRoomError
from service.dispatcher.blame import Blame
from service.dispatcher.flights import GATHER_S, Flight
from service.dispatcher.heartbeat import Heartbeat
from service.dispatcher.outcomes import OtherEngine, overdue, read_artefacts, read_exception, read_part
from service.dispatcher.pickle_guard import read_error
from service.dispatcher.placement import Slots
from service.dispatcher.pool import Pool, Worker, forget, is_lost
from service.dispatcher.telemetry import DispatcherMetrics
from service.dispatcher.writer import Writer
from service.domain.payload import ResultPayload
from service.runtime import logs
from service.runtime.settings import Settings
from service.store.artefacts import ArtefactStore
from service.store.faults import AWAY
from service.store.leadership import LeadershipLostError
from service.store.leases import Lease, Outcome, Pair
from service.store.queue import Failure, RunQueue

_LOG = logging.getLogger(__name__)
_LOOK_S = 1.0
_SURE_S = 5.0
"""A look at what has been cancelled is good for so long; without a newer one nothing that waits is started."""
_AGAIN_S = 10.0
_MAX_BACK_OFF_S = 10.0
_EMPTY_LOOKS = 3
_GONE_S = 1.0
_NO_WINDOW = 1_000_000
_BRIEF_S = 10.0
"""Where runs take less, the next are claimed before a worker is free: it waits 30 ms for the database otherwise."""


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
        self._flights: dict[str, Flight] = {}
        self._done: queues.SimpleQueue[str] = queues.SimpleQueue()
        self._slots = Slots(settings.worker_lifetime_s)
        self._ahead = Ahead()
        self._brief: set[str] = set()
        """Engines whose runs take little time."""
        self._turn = 0
        self._looked = float("-inf")
        """When it was last seen what has been cancelled and paused."""
        self._suspects: set[str] = set()
        """Engines for which a suspect waits."""
        self._back_off = 0.0
        self._empty_looks = 0
        self._due: dict[str, float] = {}
        self._metrics = metrics or DispatcherMetrics()
        self._endings = Writer(queue, self._metrics)
        self._blame = Blame(self._endings)
        self._holding = Holding(ArtefactStore(settings.artefacts, PATIENCE_S), Path(settings.scratch), self._metrics)
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
        self._give_back(self._ahead.take_where(lambda _: True), Outcome.HANDED_BACK)
        until = time.monotonic() + self._settings.drain_s
        while self._flights and self._pool.running and time.monotonic() < until and not self._heartbeat.lost.is_set():
            self._guarded(self._land_and_write, time.sleep)

    def hand_back(self, outcome: Outcome = Outcome.HANDED_BACK) -> None:
        """Write what has ended, give the rest back to the queue, uncharged; without the database both wait."""
        waiting = self._ahead.take_where(lambda _: True)
        self._collect(0.001)
        self._attend()
        gone = [flight.lease for flight in (*self._flights.values(), *self._blame.deaths.take_back())]
        if outcome is Outcome.HANDED_BACK:
            gone += self._holding.take_where(lambda _: True)  # what is held needs no workers, only this process
        self._flights.clear()
        self._slots.clear()
        self._give_back([*gone, *waiting], outcome)
        self._endings.write()

    def _give_back(self, leases: list[Lease], outcome: Outcome) -> None:
        if leases:
            _LOG.info("handing back %d runs: %s", len(leases), outcome)
            self._endings.hand_back(leases, outcome)

    def _guarded(self, step: Callable[[], None], wait: Callable[[float], object]) -> None:
        """One step; where the database is away, a wait that grows."""
        try:
            step()
            self._back_off = 0.0
        except AWAY as error:
            # Until it is back and was asked, anything may have been cancelled.
            self._looked = float("-inf")
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
        self._attend()
        self._endings.write()
        workers = self._pool.workers()
        self._tell(workers)
        # Before anything is started: what waits for a worker may have been cancelled or paused meanwhile.
        if time.monotonic() - self._looked >= _LOOK_S:
            self._try("look", self._look)
        self._try("claim", lambda: self._fill(workers))
        # With every worker busy there is nothing to look for in the queue until one of them is done.
        busy = bool(workers) and not self._slots.free(workers)
        self._collect(_LOOK_S if busy else self._settings.poll_s)
        self._look_for_deaths()
        self._replace_stalled()
        self._endings.write()
        if self._is_due("reconcile", self._settings.reconcile_s):
            self._try("reconcile", self._reconcile)
        if self._is_due("upkeep", self._settings.reconcile_s):
            self._try("upkeep", self._keep_up)

    def _keep_up(self) -> None:
        if self._queue.upkeep.step():
            self._due["upkeep"] = 0.0  # there may be more, which waits for the next step and not for longer

    def _land_and_write(self) -> None:
        self._collect(0.1)
        self._attend()
        self._look_for_deaths()
        self._endings.write()

    def _tell(self, workers: list[Worker]) -> None:
        engines: Counter[str] = Counter()
        for worker in workers:
            engines[worker.engine] += worker.threads
        if engines != self._heartbeat.engines:
            self._heartbeat.engines = dict(engines)
        self._heartbeat.artefacts_away = self._holding.away is not None
        self._metrics.workers_unfit.set(len(self._pool.present() or ()) - len(workers))

    def _fill(self, workers: list[Worker]) -> None:
        """Claim and place as many runs as there is room for, a suspect first."""
        old = self._slots.outlived(workers, time.monotonic())
        self._pool.stop(old)
        engines = sorted({worker.engine for worker in workers})
        # Each first in its turn: what only one of them can have, a suspect or the last of the window, goes round.
        self._turn = (self._turn + 1) % max(len(engines), 1)
        for engine in engines[self._turn :] + engines[: self._turn]:
            mine = [worker for worker in workers if worker.engine == engine and worker.address not in old]
            self._fill_lane(engine, mine)
            free = len(self._slots.free(mine))
            # As many again as there are threads: all of them may end in the same moment.
            threads = free + (sum(worker.threads for worker in mine) if engine in self._brief else 0)
            wanted = min(threads * self._settings.batch - self._ahead.count(engine), self._room())
            if wanted > 0 and self._queue.waiting(engine):
                self._ahead.put(engine, self._queue.claim(self._generation, wanted, engine))
            self._place_ahead(engine, mine)

    def _place_ahead(self, engine: str, workers: list[Worker]) -> None:
        """Give free workers what was claimed for them, as long as it is known that nobody has cancelled it."""
        if time.monotonic() - self._looked > _SURE_S:
            return
        free = self._slots.free(workers)
        threads = sum(worker.threads for worker in workers)
        self._place(self._ahead.take(engine, len(free), threads, self._settings.batch), free)

    def _refill(self, tasks: list[str]) -> None:
        """Give workers that have just ended these tasks the next, before their answers are fetched and stored."""
        for flight in self._flights.values():
            if flight.future.key in tasks and flight.future.status == "finished":
                flight.answered = True
                self._slots.release(flight.worker, flight.future.key)
        workers = self._pool.workers() if len(self._ahead) else []
        old = self._slots.outlived(workers, time.monotonic())
        for engine in {worker.engine for worker in workers}:
            mine = [worker for worker in workers if worker.engine == engine and worker.address not in old]
            self._place_ahead(engine, mine)

    def _fill_lane(self, engine: str, workers: list[Worker]) -> None:
        """Give the next suspect a worker of its own."""
        if self._is_due(f"suspects {engine}", _LOOK_S):
            if self._queue.waiting(engine, suspects=True):
                self._suspects.add(engine)
            else:
                self._suspects.discard(engine)
                self._slots.no_suspects(engine)
        lane = self._slots.lane(engine, workers) if engine in self._suspects and self._room() else None
        if lane is not None:
            self._suspects.discard(engine)
            self._place(self._queue.claim(self._generation, 1, engine, suspects=True), [lane])

    def _room(self) -> int:
        """How many more runs may be claimed, whatever the workers have room for."""
        if self._holding.away is not None:
            return 0
        window = self._settings.window
        return max((window or _NO_WINDOW) - len(self._flights) - len(self._ahead), 0)

    def _place(self, leases: list[Lease], workers: list[Worker]) -> None:
        """Give each worker its part of the runs, as one task."""
        size = math.ceil(len(leases) / max(len(workers), 1))
        for start, worker in zip(range(0, len(leases), max(size, 1)), workers, strict=False):
            batch = leases[start : start + size]
            self._slots.take(worker.address, batch[0].key, alone=batch[0].suspect)
            future = self._pool.submit(batch, worker)
            now = time.monotonic()
            for place, lease in enumerate(batch):
                self._flights[lease.key] = Flight(
                    lease, worker.address, worker.engine, worker.memory, future, place, len(batch) - 1, now
                )
            future.add_done_callback(lambda done: self._done.put(done.key))

    def _remove(self, key: str) -> Flight:
        flight = self._flights.pop(key)
        self._slots.release(flight.worker, flight.future.key)
        return flight

    def _collect(self, wait_s: float) -> None:
        """Turn runs that Dask has ended into endings, waiting for the first of them; results make one ending."""
        results: list[tuple[Lease, ResultPayload]] = []
        tasks = self._ended(wait_s)
        while tasks:
            self._refill(tasks)
            for task in tasks:
                self._land(task, results)
            tasks = self._ended(0.0)
        self._endings.store(results)

    def _ended(self, wait_s: float) -> list[str]:
        """Dask tasks that have ended since the last look, after a wait for the first of them."""
        tasks: list[str] = []
        with suppress(queues.Empty):
            tasks.append(self._done.get(block=wait_s > 0.0, timeout=wait_s))
            while True:
                tasks.append(self._done.get_nowait())
        return tasks

    def _land(self, task: str, results: list[tuple[Lease, ResultPayload]]) -> None:
        """End the runs of a Dask task; what there is to store comes to ``results``."""
        flights = [flight for flight in self._flights.values() if flight.future.key == task]
        if not flights or is_lost(flights[0].future):
            return  # stopped by us, or for the reconciliation to look at
        future, answers = flights[0].future, None
        error: BaseException | None = None
        if future.status == "error":
            error = read_error(future.exception(timeout=GATHER_S))
            if isinstance(error, KilledWorker):
                self._bury(flights[0].worker)
                return
        else:
            try:
                said = flights[0].fetch()
                answers, flights[0].memory.latest = said.answers, said.memory
            except (OSError, TimeoutError, CancelledError):
                return  # the worker went before its answer was fetched: a later look finds out what is left
            except Exception as broken:  # noqa: BLE001 - the answer came from another process and may be anything
                error = broken
        if time.monotonic() - flights[0].started < _BRIEF_S:
            self._brief.add(flights[0].engine)
        else:
            self._brief.discard(flights[0].engine)
        for flight in flights:
            self._remove(flight.lease.key)
        if error is not None:
            flights[0].memory.latest = None  # nobody said what it left behind
        if error is not None and len(flights) > 1:
            self._blame.suspect(flights, f"one of {len(flights)} runs may be the cause: {read_exception(error).detail}")
            return
        for flight in flights:
            self._end(flight, answers if error is None else error, results)

    def _end(self, flight: Flight, answers: Any, results: list[tuple[Lease, ResultPayload]]) -> None:
        lease = flight.lease
        ending: ResultPayload | Failure | OtherEngine
        artefacts: dict[str, bytes] = {}
        try:
            broken = isinstance(answers, BaseException)
            ending = read_exception(answers) if broken else read_part(lease, answers, flight.place)
            if isinstance(ending, ResultPayload):
                artefacts = read_artefacts(ending, answers, flight.place)
        except Exception as error:  # noqa: BLE001 - the answer came from another process and may be anything
            ending = read_exception(error)
        if isinstance(ending, Failure):
            self._fail(lease, ending)
        elif isinstance(ending, OtherEngine):
            told = logs.fields_of(lease)
            _LOG.warning("run %s, attempt %d: engine %s", lease.run_id, lease.attempt, ending.digest, extra=told)
            self._endings.refuse_engine(lease, ending.digest)
        elif artefacts:
            self._hold(lease, ending, artefacts)
        else:
            results.append((lease, ending))

    def _fail(self, lease: Lease, failure: Failure) -> None:
        told = {**logs.fields_of(lease), "code": failure.code}
        _LOG.warning("run %s, attempt %d: %s", lease.run_id, lease.attempt, failure.detail, extra=told)
        self._endings.fail(lease, failure)

    def _hold(self, lease: Lease, payload: ResultPayload, artefacts: dict[str, bytes]) -> None:
        """Keep a result until the artefact store takes what came with it; without room for it the run goes back."""
        try:
            self._holding.add(lease, payload, artefacts)
        except NoRoomError as error:
            detail = f"the artefact store is away and no more results can be kept: {error}"
            _LOG.warning("run %s goes back: %s", lease.run_id, detail, extra=logs.fields_of(lease))
            self._endings.lose(lease, detail, Outcome.HANDED_BACK)

    def _attend(self) -> None:
        """Turn results that wait no more for the artefact store into endings."""
        results: list[tuple[Lease, ResultPayload]] = []
        for lease, ending in self._holding.attend():
            if isinstance(ending, Failure):
                self._fail(lease, ending)
            else:
                results.append((lease, ending))
        self._endings.store(results)

    def _bury(self, address: str) -> None:
        """A worker died with what it was at."""
        self._pool.forget(address)
        flights = self._take_flights(lambda flight: flight.worker == address)
        if self._pool.was_stopped(address) or self._pool.closed_on_purpose(address):
            self._blame.lose(flights, "the worker was stopped")
            return
        self._metrics.worker_deaths.inc()
        answered = [flight for flight in flights if flight.answered]
        under_way = [flight for flight in flights if not flight.answered]
        _LOG.warning("worker %s died with %d runs", address, len(under_way))
        # What had ended did not kill it, only its answer is lost.
        self._blame.lose(answered, "the worker died before its answer was fetched")
        for flight in answered:
            flight.memory.latest = None
        self._blame.deaths.add(under_way, time.monotonic())

    def _look_for_deaths(self) -> None:
        """Judge the dead, and give back what is on workers that are gone without Dask having blamed anyone."""
        present = self._pool.present()
        if present is not None and self._pool.running:
            now = time.monotonic()
            for key, flight in list(self._flights.items()):
                if flight.worker in present:
                    flight.missed = None
                elif flight.missed is None:
                    flight.missed = now
                elif now - flight.missed > _GONE_S and not flight.future.done():
                    # Long enough for Dask to have said that the worker died with this run, if it had.
                    self._blame.lose([self._remove(key)], "the worker is gone")
                    forget(flight.future)
        self._blame.judge(self._pool)

    def _replace_stalled(self) -> None:
        """Start workers anew that are alive and take no work; what had been sent there goes back."""
        busy: dict[str, float] = {}
        for flight in self._flights.values():
            busy[flight.worker] = min(busy.get(flight.worker, flight.started), flight.started)
        stopped: dict[str, list[Flight]] = {}
        for stall in self._pool.stalled(busy):
            flights = self._take_flights(lambda flight, address=stall.address: flight.worker == address)  # type: ignore[misc]
            self._metrics.workers_replaced.labels(stall.reason).inc()
            _LOG.warning("worker %s is alive and takes no work, so it is replaced: %s", stall.address, stall.reason)
            self._blame.replaced(stall, flights)
            stopped[stall.address] = flights
        self._pool.stop(stopped, [flight.future for flights in stopped.values() for flight in flights])

    def _look(self) -> None:
        """End what has been cancelled, and give back what waits for a worker while its grid is paused."""
        if self._flights or len(self._ahead) or self._holding.leases:
            cancelled = self._queue.to_cancel(self._generation)
            # Out of our hands before the database is asked again: should it be away, nothing of it is started for that.
            # What comes back from a worker now belongs to no flight, and its lease ends with the next write.
            stopped = self._take_flights(lambda flight: flight.lease.pair in cancelled)
            waiting = self._ahead.take_where(lambda lease: lease.pair in cancelled)
            waiting += self._holding.take_where(lambda lease: lease.pair in cancelled)
            for lease in [*(flight.lease for flight in stopped), *waiting]:
                self._endings.cancel(lease)
            self._stop_workers_of(stopped)
        if len(self._ahead):
            paused = self._queue.to_hold(self._generation)
            self._give_back(self._ahead.take_where(lambda lease: lease.pair in paused), Outcome.HANDED_BACK)
        self._looked = time.monotonic()
        self._endings.write()

    def _take_flights(self, wanted: Callable[[Flight], bool]) -> list[Flight]:
        return [self._remove(key) for key, flight in list(self._flights.items()) if wanted(flight)]

    def _stop_workers_of(self, flights: list[Flight]) -> None:
        """End what no longer has a lease; runs beside it on the same worker go back when the worker is gone."""
        if flights:
            self._pool.stop({flight.worker for flight in flights}, [flight.future for flight in flights])

    def _reconcile(self) -> None:
        """Compare what is in flight with what Dask and the database think."""
        now = time.monotonic()
        # Several looks in a row: workers that are away for a moment come back to what they were doing.
        self._empty_looks = 0 if self._pool.present() else self._empty_looks + 1
        stranded = self._empty_looks >= _EMPTY_LOOKS
        overdue_flights = []
        for key, flight in list(self._flights.items()):
            if stranded or is_lost(flight.future):
                self._blame.lose([self._remove(key)], "no workers" if stranded else "unknown to Dask")
                forget(flight.future)
            elif now - flight.started > self._settings.deadline_s:
                ending = overdue(self._settings.deadline_s)
                overdue_flights.append(self._remove(key))
                if flight.beside:
                    self._blame.suspect([flight], f"one of {flight.beside + 1} runs was {ending.detail}")
                else:
                    self._endings.fail(flight.lease, ending)
            elif flight.future.done():
                self._done.put(flight.future.key)  # in case the callback was lost
        self._stop_workers_of(overdue_flights)
        carried = set() if stranded else set(self._heartbeat.engines)
        # While all workers are being started anew nothing is carried for a moment: what was claimed for them waits.
        if carried or stranded:
            self._give_back(self._ahead.take_engines_but(carried), Outcome.FORGOTTEN)
        self._endings.write()
        self._drop_ended(self._queue.held(self._generation))
        known = [flight.lease for flight in (*self._flights.values(), *self._blame.deaths.waiting)]
        known += [*self._ahead, *self._holding.leases]
        self._queue.requeue_forgotten(self._generation, [lease.pair for lease in known])
        self._queue.release_postdated()

    def _drop_ended(self, held: set[Pair]) -> None:
        """Stop working at runs whose leases have ended without us; what came of them would be dropped."""
        dropped = self._take_flights(lambda flight: flight.lease.pair not in held)
        waiting = self._ahead.take_where(lambda lease: lease.pair not in held)
        waiting += self._holding.take_where(lambda lease: lease.pair not in held)
        for lease in [*(flight.lease for flight in dropped), *waiting]:
            told = logs.fields_of(lease)
            _LOG.warning("run %s, attempt %d: its lease has ended", lease.run_id, lease.attempt, extra=told)
        self._stop_workers_of(dropped)

    def _is_due(self, what: str, every_s: float) -> bool:
        if time.monotonic() < self._due.get(what, 0.0):
            return False
        self._due[what] = time.monotonic() + every_s
        return True
