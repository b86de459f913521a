"""What requests that came to no end leave behind: grids half stored, and runs that are not where marks want them."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import datetime

from service.domain.identifiers import utc_now
from service.store.database import Database
from service.store.leases import lock_grids
from service.store.settling import settle, unsettled
from service.store.submission import being_stored, give_up, stored_runs, take_away

PATIENCE_S = 60.0
"""So long nothing may be stored of a grid before it is given up: twice what a write waits for its turn."""


class Upkeep:
    """Carries on with what is left, a piece at a time.

    Whether a submission goes on is judged by whether its pieces become more, on the observer's own ``monotonic`` clock.
    """

    def __init__(
        self,
        database: Database,
        clock: Callable[[], datetime] = utc_now,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._database = database
        self._clock = clock
        self._monotonic = monotonic
        self._seen: dict[str, tuple[int, float]] = {}
        """Of each grid that is being stored, how many runs it had, and when that was first seen."""

    def step(self) -> bool:
        """Do a piece of each thing that is to be done, a transaction each; whether there was anything.

        A look that finds nothing, which is the rule, needs no lock.
        """
        dead, left = self._look()
        for grid_id in dead:
            with self._database.write() as connection:
                give_up(connection, grid_id, self._clock())
                take_away(connection, grid_id)
        for grid_id in left:
            with self._database.write() as connection:
                lock_grids(connection, [grid_id])
                settle(connection, grid_id, self._clock())
        return bool(dead or left)

    def _look(self) -> tuple[list[str], list[str]]:
        with self._database.read() as connection:
            unfinished = connection.execute(being_stored()).all()
            stored = {row.id: stored_runs(connection, row.id) for row in unfinished}
            left = [row.id for row in connection.execute(unsettled())]
        now = self._monotonic()
        before = self._seen
        self._seen = {
            grid_id: before[grid_id] if grid_id in before and before[grid_id][0] == runs else (runs, now)
            for grid_id, runs in stored.items()
        }
        dead = [
            row.id for row in unfinished if row.cancelled_at is not None or now - self._seen[row.id][1] > PATIENCE_S
        ]
        return dead, left
