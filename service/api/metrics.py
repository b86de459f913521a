"""What the API counts for Prometheus: requests that it answered, and the queue as it is when somebody asks."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    ProcessCollector,
    generate_latest,
)
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector
from sqlalchemy.exc import SQLAlchemyError
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.identifiers import utc_now
from service.store.database import Database
from service.store.depth import Depth, QueueDepth

_LOG = logging.getLogger(__name__)
_REQUEST_S = (0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.2, 0.5, 1.0, 2.5, 10.0, 60.0)
_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})


class ApiMetrics:
    """What one API process counts, in a registry of its own."""

    def __init__(self, database: Database) -> None:
        self.registry = CollectorRegistry()
        self.requests = Counter(
            "hostlens_http_requests",
            "Requests that were answered, by the address as documented",
            ("method", "route", "status"),
            registry=self.registry,
        )
        self.durations = Histogram(
            "hostlens_http_request_duration_seconds",
            "From the request's head to the end of the answer",
            ("method", "route"),
            buckets=_REQUEST_S,
            registry=self.registry,
        )
        self.under_way = Gauge("hostlens_http_requests_in_progress", "Requests under way", registry=self.registry)
        if database.is_sqlite:
            log = Gauge("hostlens_database_log_bytes", "Size of SQLite's write-ahead log", registry=self.registry)
            log.set_function(database.log_bytes)
        ProcessCollector(registry=self.registry)
        self.registry.register(_DepthCollector(QueueDepth(database)))

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
        # What an exception that nobody handles becomes, further out.
        status = 500
        began = self._clock()

        async def watched(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
            await send(message)

        try:
            with self._metrics.under_way.track_inprogress():
                await self.app(scope, receive, watched)
        finally:
            # Neither a path nor a method as it was sent: whoever asks could make as many series as he likes.
            route = getattr(scope.get("route"), "path", "none")
            method = scope["method"] if scope["method"] in _METHODS else "other"
            self._metrics.requests.labels(method, route, str(status)).inc()
            self._metrics.durations.labels(method, route).observe(self._clock() - began)


class _DepthCollector(Collector):
    """The queue's depth, read at each scrape."""

    def __init__(self, depth: QueueDepth) -> None:
        self._depth = depth

    def describe(self) -> Iterator[Metric]:
        """Say nothing: to register is no reason to ask the database."""
        return iter(())

    def collect(self) -> Iterator[Metric]:
        """Look at the queue; without a database only that there is none."""
        try:
            depth = self._depth.look()
        except SQLAlchemyError as error:
            _LOG.warning("the queue's depth is not known: %s", error)
            yield GaugeMetricFamily("hostlens_database_up", _UP, value=0)
            return
        yield GaugeMetricFamily("hostlens_database_up", _UP, value=1)
        yield from _depth_metrics(depth)


_UP = "Whether the database answered this scrape"


def _depth_metrics(depth: Depth) -> Iterator[Metric]:
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
    now = utc_now()
    alive = leader is not None and leader.expires_at > now
    yield GaugeMetricFamily("hostlens_leader_alive", "Whether a dispatcher leads", value=alive)
    if leader is not None:
        age = max((now - leader.beat_at).total_seconds(), 0.0)
        threads = leader.workers if alive else 0
        yield GaugeMetricFamily("hostlens_leader_generation", "Generation of the last leader", value=leader.generation)
        yield GaugeMetricFamily("hostlens_leader_heartbeat_age_seconds", "Since its last heartbeat", value=age)
        yield GaugeMetricFamily("hostlens_leader_workers", "Worker threads that it last had", value=threads)
