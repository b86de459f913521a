"""The dispatcher as a process: becomes the leader or waits for it, dispatches, ends cleanly."""

from __future__ import annotations

import logging
import signal
import time
from contextlib import suppress
from threading import Event
from types import FrameType

from sqlalchemy.exc import DBAPIError

from service.dispatcher.cluster_process import end_prepared, prepare_host
from service.dispatcher.heartbeat import Heartbeat
from service.dispatcher.identity import is_dead, own_name
from service.dispatcher.loop import Dispatcher
from service.dispatcher.pool import Pool, open_pool
from service.dispatcher.telemetry import DispatcherMetrics, MeasuredQueue
from service.runtime import logs, preflight
from service.runtime.process import spare_collector, stop_with_parent
from service.runtime.settings import Settings
from service.store.database import Database
from service.store.leadership import Leadership, LeadershipLostError
from service.store.leases import Outcome

_LOG = logging.getLogger(__name__)
STOPPED, ENDED = 0, 75
"""Exit codes: stopped as asked; ended because the leadership or the database was lost."""
_FIRST_DELAY_S, _MAX_DELAY_S, _STEADY_S = 0.5, 30.0, 30.0


def dispatch(settings: Settings) -> int:
    """Dispatch until SIGINT or SIGTERM, or until this process no longer can; the exit code says which.

    Raises
    ------
    service.runtime.settings.ConfigurationError
        What the settings name is not there or cannot be used.
    """
    stop = Event()

    def on_signal(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    signal.signal(signal.SIGTERM, on_signal)
    signal.signal(signal.SIGINT, on_signal)
    stop_with_parent()
    logs.configure(settings, "dispatcher")
    # Dask says at INFO and WARNING what is normal here: workers that come and go with us.
    logging.getLogger("distributed").setLevel(logging.ERROR)
    preflight.for_dispatcher(settings)
    if settings.kind_of_cluster == "local":
        prepare_host()
    # Each result is a hundred objects, and Dask makes much that it would look through again and again.
    spare_collector()
    metrics = DispatcherMetrics()
    try:
        with metrics.serving(settings):
            return _dispatch(settings, metrics, stop)
    finally:
        end_prepared()


def _dispatch(settings: Settings, metrics: DispatcherMetrics, stop: Event) -> int:
    database = Database(settings.database, asked_first=False)
    try:
        generation = wait_to_lead(database, settings, stop)
        if generation is None:
            return STOPPED
        with logs.bound(generation=generation):
            _lead(settings, database, generation, metrics, stop)
        with suppress(DBAPIError):  # without it the row runs out by itself
            Leadership(database).resign(generation)
    finally:
        database.close()
    return STOPPED if stop.is_set() else ENDED


def wait_to_lead(database: Database, settings: Settings, stop: Event) -> int | None:
    """Stand by until this process leads; the generation, or None where it is stopped before.

    Nobody leads on a schema that this code was not written for.
    """
    leadership = Leadership(database, settings.leader_ttl_s)
    name = own_name()
    while not stop.is_set():
        try:
            database.require_schema()
            generation = leadership.take(name, is_dead)
        except DBAPIError as error:
            _LOG.warning("cannot ask for the leadership: %s", error)
            leadership.forget()
            generation = None
        if generation is not None:
            _LOG.info("leading as generation %d", generation)
            return generation
        stop.wait(min(settings.heartbeat_s, 1.0))
    return None


def _lead(settings: Settings, database: Database, generation: int, metrics: DispatcherMetrics, stop: Event) -> None:
    """Dispatch on one pool of workers after another, until stopped or deposed."""
    metrics.generation.set(generation)
    heartbeat = Heartbeat(settings, generation)
    heartbeat.start()
    queue = MeasuredQueue(metrics, database, retry_delay_s=settings.retry_delay_s)
    dispatcher = Dispatcher(settings, queue, heartbeat, generation, metrics)
    delay = _FIRST_DELAY_S
    try:
        while not (stop.is_set() or heartbeat.lost.is_set()):
            began = time.monotonic()
            try:
                with open_pool(settings) as pool:
                    _dispatch_on(pool, dispatcher, stop)
            except OSError as error:
                _LOG.error("no workers, next try in %.1f s: %s", delay, error)
            heartbeat.engines = {}
            if time.monotonic() - began > _STEADY_S:
                delay = _FIRST_DELAY_S
            stop.wait(delay)
            delay = min(2 * delay, _MAX_DELAY_S)
    except LeadershipLostError as error:
        _LOG.error("%s", error)
    finally:
        heartbeat.stop()


def _dispatch_on(pool: Pool, dispatcher: Dispatcher, stop: Event) -> None:
    try:
        dispatcher.run(pool, stop)
        if stop.is_set():
            dispatcher.drain()
    finally:
        # Without the database it is tried again on the next workers; the next leader voids what is left.
        with suppress(DBAPIError):
            dispatcher.hand_back(Outcome.HANDED_BACK if stop.is_set() else Outcome.SCHEDULER_LOST)
