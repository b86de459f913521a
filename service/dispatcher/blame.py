"""What becomes of runs whose worker died or took no work: who is charged, who is a suspect, who goes back."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Iterable, Sequence

from service.dispatcher.attribution import Deaths
from service.dispatcher.flights import Flight, Flights
from service.dispatcher.outcomes import memory_exceeded, worker_lost
from service.dispatcher.pool import Pool
from service.dispatcher.stalls import Stall
from service.dispatcher.telemetry import DispatcherMetrics
from service.dispatcher.writer import Writer
from service.runtime import logs
from service.store.leases import Outcome

_LOG = logging.getLogger(__name__)


class Blame:
    """Turns runs that are on no worker any more into endings; ``deaths`` are those that are not judged yet."""

    def __init__(self, flights: Flights, endings: Writer, metrics: DispatcherMetrics) -> None:
        self.deaths: Deaths[Flight] = Deaths()
        self._flights = flights
        self._endings = endings
        self._metrics = metrics

    def bury(self, address: str, pool: Pool) -> None:
        """A worker died with what it was at."""
        pool.forget(address)
        flights = self._flights.take_on(address)
        if pool.was_stopped(address) or pool.closed_on_purpose(address):
            self.lose(flights, "the worker was stopped")
            return
        self._metrics.worker_deaths.inc()
        answered = [flight for flight in flights if flight.answered]
        under_way = [flight for flight in flights if not flight.answered]
        _LOG.warning("worker %s died with %d runs", address, len(under_way))
        # What had ended did not kill it, only its answer is lost.
        self.lose(answered, "the worker died before its answer was fetched")
        for flight in answered:
            flight.memory.latest = None
        self.deaths.add(under_way, time.monotonic())

    def look_for_deaths(self, pool: Pool) -> None:
        """Judge the dead, and give back what is on workers that are gone without Dask having blamed anyone."""
        present = pool.present()
        if present is not None and pool.running:
            gone = self._flights.take_missing(present)
            self.lose(gone, "the worker is gone")
            for flight in gone:
                flight.drop()
        self.judge(pool)

    def replace_stalled(self, pool: Pool) -> None:
        """Start workers anew that are alive and take no work; what had been sent there goes back."""
        stopped: dict[str, list[Flight]] = {}
        for stall in pool.stalled(self._flights.oldest()):
            flights = stopped[stall.address] = self._flights.take_on(stall.address)
            self._metrics.workers_replaced.labels(stall.reason).inc()
            _LOG.warning("worker %s is alive and takes no work, so it is replaced: %s", stall.address, stall.reason)
            self._end_stalled(stall, flights)
        pool.stop(stopped, [flight.future for flights in stopped.values() for flight in flights])

    def suspect(self, flights: Sequence[Flight], detail: str) -> None:
        """Runs one of which is to blame go back uncharged, to be tried one at a time."""
        self._endings.suspect([flight.lease for flight in flights], detail)

    def lose(self, flights: Iterable[Flight], detail: str, outcome: Outcome = Outcome.FORGOTTEN) -> None:
        """Runs that are not to blame go back uncharged."""
        for flight in flights:
            lease = flight.lease
            told = logs.fields_of(lease)
            _LOG.info("run %s, attempt %d goes back: %s", lease.run_id, lease.attempt, detail, extra=told)
            self._endings.lose(lease, detail, outcome)

    def judge(self, pool: Pool) -> None:
        """End the runs of workers that died, once enough time has passed to tell which of them did it."""
        verdict = self.deaths.judge(time.monotonic())
        if verdict is None:
            return
        if verdict.guilty is not None and not self._ended_by_memory(verdict.guilty, pool):
            self._endings.fail(verdict.guilty.lease, worker_lost())
        homes = Counter(id(flight.memory) for flight in verdict.suspects)
        alone = [
            flight
            for flight in verdict.suspects
            if homes[id(flight.memory)] == 1 and self._ended_by_memory(flight, pool)
        ]
        suspects = [flight for flight in verdict.suspects if flight not in alone]
        if suspects:
            self.suspect(suspects, f"one of {len(suspects)} runs may have killed a worker")

    def _end_stalled(self, stall: Stall, flights: Sequence[Flight]) -> None:
        """End the runs of a worker that was alive and took no work: uncharged, but for one that made it so."""
        begun = [flight for flight in flights if stall.begun and not flight.answered]
        if stall.reason == "silent":
            self.deaths.add(begun, time.monotonic())
        elif stall.reason == "paused" and len(begun) == len(flights) == 1:
            self._blame_memory(begun[0], stall.memory)
        elif stall.reason == "paused" and begun:
            self.suspect(begun, f"one of {len(begun)} runs may have filled a worker's memory")
        else:
            begun = []
        rest = [flight for flight in flights if flight not in begun]
        self.lose(rest, f"its worker took no work: {stall.reason}", Outcome.STALLED)

    def _ended_by_memory(self, flight: Flight, pool: Pool) -> bool:
        """End a run whose worker's nanny has ended that for its memory; False where it has not."""
        reached = pool.memory_kill(flight.memory)
        if reached is not None:
            self._blame_memory(flight, reached)
        return reached is not None

    def _blame_memory(self, flight: Flight, reached: int) -> None:
        """Charge the run that was alone on a worker whose memory is full, if it would have filled a fresh one."""
        if flight.memory.would_fill_a_fresh_one(reached):
            ending = memory_exceeded(reached, flight.memory.limit or reached)
            told = {**logs.fields_of(flight.lease), "code": ending.code}
            _LOG.warning("run %s: %s", flight.lease.run_id, ending.detail, extra=told)
            self._endings.fail(flight.lease, ending)
        else:
            self.lose([flight], "its worker's memory was full of what others had left behind", Outcome.STALLED)
