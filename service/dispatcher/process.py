"""The dispatcher as a process: becomes the leader or waits for it, dispatches, ends cleanly."""

from __future__ import annotations

import logging
import signal
from contextlib import suppress
from threading import Event
from types import FrameType

from sqlalchemy.exc import DBAPIError

from service.dispatcher.heartbeat import Heartbeat
from service.dispatcher.holder import is_dead, own_name
from service.dispatcher.loop import Dispatcher
from service.dispatcher.pool import open_pool
from service.process import stop_with_parent
from service.settings import Settings
from service.store.database import Database
from service.store.leadership import Leadership, LeadershipLostError
from service.store.queue import RunQueue

_LOG = logging.getLogger(__name__)
STOPPED, ENDED = 0, 75
"""Exit codes: stopped as asked; ended because the leadership, the scheduler or the database was lost."""


def dispatch(settings: Settings) -> int:
    """Dispatch until SIGINT or SIGTERM, or until this process no longer can; the exit code says which."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s %(levelname)s %(message)s")
    # Dask says at INFO and WARNING what is normal here: workers that come and go with us.
    logging.getLogger("distributed").setLevel(logging.ERROR)
    stop = Event()

    def on_signal(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    signal.signal(signal.SIGTERM, on_signal)
    signal.signal(signal.SIGINT, on_signal)
    stop_with_parent()
    settings.make_folders()
    database = Database(settings.database)
    leadership = Leadership(database, settings.leader_ttl_s)
    try:
        generation = wait_to_lead(leadership, settings, stop)
        if generation is None:
            return STOPPED
        try:
            _lead(settings, database, generation, stop)
        except OSError as error:
            _LOG.error("no workers: %s", error)
        with suppress(DBAPIError):  # without it the row runs out by itself
            leadership.resign(generation)
    finally:
        database.close()
    return STOPPED if stop.is_set() else ENDED


def wait_to_lead(leadership: Leadership, settings: Settings, stop: Event) -> int | None:
    """Stand by until this process leads; the generation, or None where it is stopped before."""
    name = own_name()
    while not stop.is_set():
        try:
            generation = leadership.take(name, is_dead)
        except DBAPIError as error:
            _LOG.warning("cannot ask for the leadership: %s", error.orig)
            generation = None
        if generation is not None:
            _LOG.info("leading as generation %d", generation)
            return generation
        stop.wait(min(settings.heartbeat_s, 1.0))
    return None


def _lead(settings: Settings, database: Database, generation: int, stop: Event) -> None:
    heartbeat = Heartbeat(settings, generation)
    heartbeat.start()
    try:
        queue = RunQueue(database, retry_delay_s=settings.retry_delay_s)
        with open_pool(settings) as pool:
            dispatcher = Dispatcher(settings, queue, pool, heartbeat, generation)
            try:
                dispatcher.run(stop)
            except LeadershipLostError as error:
                _LOG.error("%s", error)
            finally:
                # Without the database they are voided by the next leader instead.
                with suppress(DBAPIError):
                    dispatcher.hand_back()
    finally:
        heartbeat.stop()
