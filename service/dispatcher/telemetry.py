"""What the dispatcher counts, for Prometheus: a port of its own, because no request ever reaches this process."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    ProcessCollector,
    start_http_server,
)

from service.dispatcher.stalls import REASONS
from service.domain.payload import Payload
from service.domain.states import RunState
from service.runtime import logs
from service.runtime.settings import Settings
from service.runtime.start import ConfigurationError
from service.store.database import AWAY
from service.store.leases import Lease, Outcome
from service.store.queue import Failure, RunQueue, Stored

_LOG = logging.getLogger(__name__)
_TRANSACTION_S = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 10.0, 30.0)
_RUN_S = (1, 5, 15, 30, 60, 120, 300, 600, 1200, 1800, 3600)


class DispatcherMetrics:
    """Counters, gauges and histograms of one dispatcher process, in a registry of their own."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self.generation = self._gauge("dispatcher_generation", "Generation that this process leads as, 0 on standby")
        self.in_flight = self._gauge("runs_in_flight", "Runs that Dask has been given and that have not ended")
        self.worker_threads = self._gauge("worker_threads", "Worker threads that are connected")
        self.worker_deaths = self._counter("worker_deaths", "Worker processes that died while they had a run")
        self.workers_unfit = self._gauge("workers_unfit", "Workers that are connected and get no runs")
        self.workers_replaced = self._counter(
            "workers_replaced", "Workers that were alive and took no work, by why", "reason"
        )
        self.claimed = self._counter("runs_claimed", "Runs taken from the queue")
        self.ended = self._counter("runs_ended", "Runs that ended for good, by their state", "state")
        self.requeued = self._counter("runs_requeued", "Attempts that gave the run back, by their outcome", "reason")
        self.stale = self._counter("results_stale", "Results that came too late, by how they compare", "digest")
        self.database_errors = self._counter("database_errors", "Transactions that the database could not carry out")
        self.refusals = self._counter(
            "database_refusals", "What the database refused for what it is: ends of runs, steps of the loop", "what"
        )
        self.artefact_store_up = self._gauge("artefact_store_up", "0 while the artefact store takes nothing")
        self.artefact_store_errors = self._counter("artefact_store_errors", "Refusals of the artefact store")
        self.artefacts_brought = self._counter("artefacts_brought", "Artefacts that workers could not put there")
        self.results_held = self._gauge("results_held", "Results that wait for the artefact store")
        self.transactions = self._histogram(
            "queue_transaction_duration_seconds", "Transactions of the queue by what they do", _TRANSACTION_S, "what"
        )
        self.loops = self._histogram(
            "dispatcher_loop_duration_seconds", "One turn of the loop, the wait for a result included", _TRANSACTION_S
        )
        self.run_duration = self._histogram("run_duration_seconds", "Wall time of stored runs on their worker", _RUN_S)
        ProcessCollector(registry=self.registry)
        # A series that appears with the first event hides that event from rate().
        for outcome in Outcome:
            if outcome not in {Outcome.DONE, Outcome.CANCELLED, Outcome.REFUSED}:
                self.requeued.labels(outcome)
        for state in (RunState.DONE, RunState.FAILED, RunState.QUARANTINED, RunState.CANCELLED):
            self.ended.labels(state)
        for reason in REASONS:
            self.workers_replaced.labels(reason)
        for digest in ("same", "other"):
            self.stale.labels(digest)
        for what in ("ending", "look", "claim", "reconcile", "upkeep"):
            self.refusals.labels(what)

    @contextmanager
    def serving(self, settings: Settings) -> Iterator[None]:
        """Answer on the metrics port while the context lasts; a ConfigurationError where another process has it."""
        if settings.metrics_port is None:
            yield
            return
        try:
            server, thread = start_http_server(settings.metrics_port, settings.metrics_host, self.registry)
        except OSError as error:
            raise ConfigurationError(
                f"HOSTLENS_METRICS_PORT: cannot listen on {settings.metrics_port}: {error}"
            ) from None
        try:
            yield
        finally:
            server.shutdown()
            server.server_close()
            thread.join()

    @contextmanager
    def transaction(self, what: str) -> Iterator[None]:
        """Time a transaction of the queue, and count it where the database is away."""
        try:
            with self.transactions.labels(what).time():
                yield
        except AWAY:
            self.database_errors.inc()
            raise

    def _counter(self, name: str, text: str, *labels: str) -> Counter:
        return Counter(f"hostlens_{name}", text, labels, registry=self.registry)

    def _gauge(self, name: str, text: str) -> Gauge:
        return Gauge(f"hostlens_{name}", text, registry=self.registry)

    def _histogram(self, name: str, text: str, buckets: tuple[float, ...], *labels: str) -> Histogram:
        return Histogram(f"hostlens_{name}", text, labels, buckets=buckets, registry=self.registry)


class MeasuredQueue(RunQueue):
    """The queue, each of whose transactions is timed and counted by what came of it, after it was committed."""

    def __init__(self, metrics: DispatcherMetrics, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._metrics = metrics

    def claim(self, *arguments: Any, **options: Any) -> list[Lease]:
        """As the queue's."""
        with self._metrics.transaction("claim"):
            leases = super().claim(*arguments, **options)
        self._metrics.claimed.inc(len(leases))
        return leases

    def store_all(self, results: Sequence[tuple[Lease, Payload]]) -> list[Stored]:
        """As the queue's."""
        with self._metrics.transaction("store"):
            outcomes = super().store_all(results)
        for (lease, payload), stored in zip(results, outcomes, strict=True):
            if stored is Stored.STORED:
                self._metrics.ended.labels(RunState.DONE).inc()
                self._metrics.run_duration.observe(payload.wall_s)
                _LOG.info("stored", extra={**logs.fields_of(lease), "wall_s": round(payload.wall_s, 3)})
            else:
                self._metrics.stale.labels("same" if stored is Stored.STALE_SAME else "other").inc()
        return outcomes

    def fail(self, lease: Lease, failure: Failure) -> RunState | None:
        """As the queue's."""
        with self._metrics.transaction("fail"):
            state = super().fail(lease, failure)
        if state in {RunState.QUEUED, RunState.PAUSED}:
            self._metrics.requeued.labels(failure.outcome).inc()
        elif state is not None:
            self._metrics.ended.labels(state).inc()
        return state

    def hand_back(self, leases: Sequence[Lease], outcome: Outcome = Outcome.HANDED_BACK) -> int:
        """As the queue's."""
        with self._metrics.transaction("requeue"):
            runs = super().hand_back(leases, outcome)
        self._metrics.requeued.labels(outcome).inc(runs)
        return runs

    def suspect(self, leases: Sequence[Lease], detail: str) -> int:
        """As the queue's."""
        with self._metrics.transaction("requeue"):
            runs = super().suspect(leases, detail)
        self._metrics.requeued.labels(Outcome.SUSPECTED).inc(runs)
        return runs

    def refuse_engine(self, lease: Lease, engine: str) -> bool:
        """As the queue's."""
        with self._metrics.transaction("requeue"):
            moved = super().refuse_engine(lease, engine)
        self._metrics.requeued.labels(Outcome.OTHER_ENGINE).inc(moved)
        return moved

    def requeue_lost(self, lease: Lease, outcome: Outcome, detail: str) -> bool:
        """As the queue's."""
        with self._metrics.transaction("requeue"):
            moved = super().requeue_lost(lease, outcome, detail)
        self._metrics.requeued.labels(outcome).inc(moved)
        return moved

    def requeue_forgotten(self, *arguments: Any, **options: Any) -> list[str]:
        """As the queue's."""
        with self._metrics.transaction("reconcile"):
            runs = super().requeue_forgotten(*arguments, **options)
        self._metrics.requeued.labels(Outcome.FORGOTTEN).inc(len(runs))
        return runs

    def cancel_leased(self, lease: Lease) -> bool:
        """As the queue's."""
        with self._metrics.transaction("cancel"):
            moved = super().cancel_leased(lease)
        self._metrics.ended.labels(RunState.CANCELLED).inc(moved)
        return moved

    def set_aside(self, lease: Lease, reason: Exception) -> bool:
        """As the queue's."""
        with self._metrics.transaction("fail"):
            moved = super().set_aside(lease, reason)
        self._metrics.ended.labels(RunState.QUARANTINED).inc(moved)
        return moved

    def note_refused(self, runs: int) -> None:
        """As the queue's."""
        self._metrics.refusals.labels("ending").inc(runs)
        self._metrics.ended.labels(RunState.QUARANTINED).inc(runs)

    def note_spared(self, runs: int) -> None:
        """As the queue's."""
        self._metrics.ended.labels(RunState.NOT_NEEDED).inc(runs)
