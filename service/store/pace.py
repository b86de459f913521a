"""How fast grids' runs end: measured on the latest of them."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import Connection, bindparam, func, literal_column, select

from service.store.tables import grid, run

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
    .where(run.c.grid_id == grid.c.id, run.c.finished_at.is_not(None), run.c.leased_at.is_not(None))
    .order_by(run.c.finished_at.desc())
    .limit(_RUNS)
    .correlate(grid)
    .subquery()
)
_MEASURES = (func.count(), func.min(_LATEST.c.leased_at), func.max(_LATEST.c.finished_at))
# Made once: to make it takes longer than to carry it out.
_MEASURED = select(grid.c.id, *(select(measure).select_from(_LATEST).scalar_subquery() for measure in _MEASURES)).where(
    grid.c.id.in_(bindparam("ids", expanding=True))
)


_OWN = (
    select(run.c.finished_at, run.c.leased_at)
    .where(run.c.grid_id == bindparam("wanted"), run.c.finished_at.is_not(None), run.c.leased_at.is_not(None))
    .order_by(run.c.finished_at.desc())
    .limit(literal_column(str(_RUNS)))
    .subquery()
)
_OF_ONE = select(func.count(), func.min(_OWN.c.leased_at), func.max(_OWN.c.finished_at))


def recent_of(connection: Connection, grid_id: str) -> Recent | None:
    """The latest runs of one grid, which costs a third of :func:`recent`; None before the first has ended."""
    runs, began_at, ended_at = connection.execute(_OF_ONE, {"wanted": grid_id}).one()
    return Recent(runs, began_at, ended_at) if runs else None


def recent(connection: Connection, grid_ids: Collection[str]) -> dict[str, Recent]:
    """The latest runs of each grid of which any has ended."""
    rows = connection.execute(_MEASURED, {"ids": sorted(grid_ids)})
    return {grid_id: Recent(runs, began_at, ended_at) for grid_id, runs, began_at, ended_at in rows if runs}
