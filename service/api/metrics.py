"""What the API counts for Prometheus: requests that it answered, and the queue as it is when somebody asks."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterator

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    ProcessCollector,
    generate_latest,
    values,
)
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.multiprocess import MultiProcessCollector
from prometheus_client.registry import Collector
from sqlalchemy.exc import SQLAlchemyError
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.runtime.process import API_NUMBER, METRICS_DIR
from service.store.database import Database
from service.store.depth import Depth, QueueDepth
from service.store.leadership import Leadership

_LOG = logging.getLogger(__name__)
_REQUEST_S = (0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.2, 0.5, 1.0, 2.5, 10.0, 60.0)
_GONE = 499
"""Counted for a client that was gone before its request or the answer was whole; nobody is ever sent it."""
_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})


class ApiMetrics:
    """What the API counts, in a registry of its own.

    Of several API processes each keeps its metrics in files, and tells the sum over all: whoever scrapes reaches one of
    them. Memory, CPU and descriptors are those of a process, and not told there.
    """

    def __init__(self, database: Database, leadership: Leadership) -> None:
        self._files = os.environ.get(METRICS_DIR)
        self.registry = CollectorRegistry()
        if self._files is not None:
            # By the process's place and not by its id: a counter goes on where the one before it was killed.
            values.ValueClass = values.MultiProcessValue(lambda: os.environ[API_NUMBER])  # type: ignore[no-untyped-call]
        own = CollectorRegistry() if self._files is not None else self.registry
        self.requests = Counter(
            "hostlens_http_requests",
            "Requests that were answered, by the address as documented",
            ("method", "route", "status"),
            registry=own,
        )
        self.durations = Histogram(
            "hostlens_http_request_duration_seconds",
            "From the request's head to the end of the answer",
            ("method", "route"),
            buckets=_REQUEST_S,
            registry=own,
        )
        self.under_way = Gauge(
            "hostlens_http_requests_in_progress", "Requests under way", registry=own, multiprocess_mode="sum"
        )
        self.under_way.set(0)
        if self._files is None:
            ProcessCollector(registry=self.registry)
        else:
            MultiProcessCollector(self.registry, self._files)  # type: ignore[no-untyped-call]
        self.registry.register(_DatabaseCollector(database, leadership))

    def text(self) -> bytes:
        """Everything, in Prometheus's text format."""
        return generate_latest(self.registry)


class Measured:
    """Counts and times every request that the application inside answers."""

    def __init__(self, app: ASGIApp, metrics: ApiMetrics, clock: Callable[[], float] = time.perf_counter) -> None:
        self.app = app
        self._metrics = metrics
        self._clock = clock

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        status = _GONE
        began = self._clock()

        async def watched(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
            await send(message)

        try:
            with self._metrics.under_way.track_inprogress():
                await self.app(scope, receive, watched)
        except Exception:
            if status == _GONE:
                status = 500  # what becomes of it, further out
            raise
        finally:
            # Neither a path nor a method as it was sent: whoever asks could make as many series as he likes.
            route = getattr(scope.get("route"), "path", "none")
            method = scope["method"] if scope["method"] in _METHODS else "other"
            self._metrics.requests.labels(method, route, str(status)).inc()
            self._metrics.durations.labels(method, route).observe(self._clock() - began)


class _DatabaseCollector(Collector):
    """The queue's depth, and the length of SQLite's log, read at each scrape."""

    def __init__(self, database: Database, leadership: Leadership) -> None:
        self._database = database
        self._depth = QueueDepth(database)
        self._leadership = leadership

    def describe(self) -> Iterator[Metric]:
        """Say nothing: to register is no reason to ask the database."""
        return iter(())

    def collect(self) -> Iterator[Metric]:
        """Look at the queue; without a database only that there is none."""
        if self._database.is_sqlite:
            text = "Size of SQLite's write-ahead log"
            yield GaugeMetricFamily("hostlens_database_log_bytes", text, value=self._database.log_bytes())
        try:
            depth = self._depth.look()
        except SQLAlchemyError as error:
            _LOG.warning("the queue's depth is not known: %s", error)
            yield GaugeMetricFamily("hostlens_database_up", _UP, value=0)
            return
        yield GaugeMetricFamily("hostlens_database_up", _UP, value=1)
        yield from _depth_metrics(depth, self._leadership)


_UP = "Whether the database answered this scrape"


def _depth_metrics(depth: Depth, leadership: Leadership) -> Iterator[Metric]:
    runs = GaugeMetricFamily("hostlens_runs", "Runs that have not ended, by state", labels=("state",))
    for state in ("queued", "delayed", "leased"):
        runs.add_metric((state,), getattr(depth, state))
    yield runs
    grids = GaugeMetricFamily("hostlens_grids", "Grids by stored state; queued until the last run", labels=("state",))
    for name, number in depth.grids.items():
        grids.add_metric((name,), number)
    yield grids
    waiting = "How long the first run of the queue has been waiting"
    yield GaugeMetricFamily("hostlens_queue_waiting_seconds", waiting, value=depth.waiting_s)
    leader = depth.leader
    alive = leader is not None and leadership.beats(leader)
    yield GaugeMetricFamily("hostlens_leader_alive", "Whether a dispatcher leads", value=alive)
    if leader is not None:
        age = leadership.silent_s(leader)
        threads = leader.workers if alive else 0
        yield GaugeMetricFamily("hostlens_leader_generation", "Generation of the last leader", value=leader.generation)
        yield GaugeMetricFamily(
            "hostlens_leader_heartbeat_age_seconds", "Since its last heartbeat, as seen from here", value=age
        )
        yield GaugeMetricFamily("hostlens_leader_workers", "Worker threads that it last had", value=threads)
