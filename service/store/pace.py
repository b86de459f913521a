"""How fast a grid's runs end: measured on the latest of them."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import Connection, bindparam, func, select

from service.store.tables import run

_RUNS = 100


@dataclass(frozen=True)
class Recent:
    """The latest runs that ended after they had been worked on: how many, when the first began, when the last ended."""

    runs: int
    began_at: datetime
    ended_at: datetime

    def rate(self, until: datetime | None = None) -> float:
        """Runs per second, up to the last end or to a later time."""
        return self.runs / max(((until or self.ended_at) - self.began_at).total_seconds(), 1e-3)


_LATEST = (
    select(run.c.finished_at, run.c.leased_at)
    .where(run.c.grid_id == bindparam("wanted"), run.c.finished_at.is_not(None), run.c.leased_at.is_not(None))
    .order_by(run.c.finished_at.desc())
    .limit(_RUNS)
    .subquery()
)
# Made once: to make it takes longer than to carry it out.
_MEASURED = select(func.count(), func.min(_LATEST.c.leased_at), func.max(_LATEST.c.finished_at))


def recent(connection: Connection, grid_id: str) -> Recent | None:
    """The latest runs of a grid, None where none has ended."""
    runs, began_at, ended_at = connection.execute(_MEASURED, {"wanted": grid_id}).one()
    return None if not runs else Recent(runs, began_at, ended_at)
