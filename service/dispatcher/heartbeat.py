"""The leader's heartbeat: a thread with a connection of its own, so that slow work does not look like death."""

from __future__ import annotations

import logging
import threading
import time

from sqlalchemy.exc import DBAPIError

from service.runtime import logs
from service.runtime.settings import Settings
from service.store.database import Database
from service.store.leadership import Leadership

_LOG = logging.getLogger(__name__)


class Heartbeat:
    """Beats for one generation until it is stopped; ``lost`` is set once another leads.

    ``engines`` is what it tells: worker threads of each engine by its digest. It is replaced, never changed. So is
    ``artefacts_away``: that the dispatcher waits for the artefact store.
    """

    def __init__(self, settings: Settings, generation: int) -> None:
        self.lost = threading.Event()
        self.engines: dict[str, int] = {}
        self.artefacts_away = False
        self._settings = settings
        self._generation = generation
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._beat, name="heartbeat", daemon=True)

    def start(self) -> None:
        """Begin to beat."""
        self._thread.start()

    def stop(self) -> None:
        """End, and wait for a beat that is under way."""
        self._stop.set()
        self._thread.join(timeout=self._settings.leader_ttl_s)

    def _beat(self) -> None:
        logs.bind(generation=self._generation)
        database = Database(self._settings.database, pooled=False)
        leadership = Leadership(database, self._settings.leader_ttl_s)
        told: tuple[dict[str, int], bool] | None = None
        while not self._stop.is_set():
            try:
                told = (self.engines, self.artefacts_away)
                if not leadership.beat(self._generation, *told):
                    _LOG.error("another dispatcher leads")
                    self.lost.set()
                    return
                database.cut_log()
            except DBAPIError as error:
                # However long it takes: nobody can take over without the database either, and once it is back this
                # beat tells whether someone has. To give up would drop the results that wait to be stored.
                _LOG.warning("no heartbeat: %s", error)
            except Exception:  # noqa: BLE001 - a thread that ended here would leave a leader whom nobody sees
                _LOG.exception("no heartbeat")
            self._wait(told)
        database.close()

    def _wait(self, told: tuple[dict[str, int], bool] | None) -> None:
        """Sleep for a beat, or less where what it tells changes: readiness should not lag behind it."""
        until = time.monotonic() + self._settings.heartbeat_s
        while time.monotonic() < until and not self._stop.wait(0.2):
            if told != (self.engines, self.artefacts_away):
                return
