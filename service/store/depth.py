"""How much waits, for a gauge that is read every few seconds however large the tables have grown."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import case, false, func, select, text

from service.domain.identifiers import utc_now
from service.domain.states import GridState, RunState
from service.store.database import Database
from service.store.leadership import LeaderView, leader_view
from service.store.settling import held_grids
from service.store.tables import grid, run


@dataclass(frozen=True)
class Depth:
    """The queue at one moment.

    ``queued`` runs may be claimed, ``delayed`` ones wait for a retry, ``leased`` ones are being worked on.
    ``waiting_s`` is how long the first of the queue could have been claimed for [s]. ``grids`` counts by stored state,
    in which a grid that runs is queued. Runs that have ended are not here: to count them would read all of them.
    """

    queued: int
    delayed: int
    leased: int
    waiting_s: float
    grids: dict[str, int]
    leader: LeaderView | None


class QueueDepth:
    """Looks at the queue's depth."""

    def __init__(self, database: Database, clock: Callable[[], datetime] = utc_now) -> None:
        self._database = database
        self._clock = clock

    def look(self) -> Depth:
        """Read nothing but the two partial indices of runs and the tables of grids and of the leader."""
        now = self._clock()
        later = run.c.not_before > now
        # Spelt out, since a database takes a partial index only where it sees that the condition implies it.
        queued = select(func.count().label("runs"), func.sum(case((later, 1), else_=0)), func.min(run.c.not_before))
        # By their token, which every leased run has: counted as rows SQLite would go through all that ever ran.
        leased = select(func.count(run.c.token)).where(text(f"state = '{RunState.LEASED}'"))
        with self._database.read() as connection:
            waits = (text(f"state = '{RunState.QUEUED}'"), run.c.grid_id.not_in(held_grids()))
            runs, delayed, first = connection.execute(queued.where(*waits)).one()
            busy = connection.scalar(leased) or 0
            whole = select(grid.c.state, func.count()).where(grid.c.storing == false())
            counted = connection.execute(whole.group_by(grid.c.state))
            grids = {str(state): number for state, number in counted}
            leading = leader_view(connection)
        return Depth(
            queued=runs - (delayed or 0),
            delayed=delayed or 0,
            leased=busy,
            waiting_s=0.0 if first is None else max((now - first).total_seconds(), 0.0),
            grids={state: grids.get(state, 0) for state in GridState if state is not GridState.RUNNING},
            leader=leading,
        )
