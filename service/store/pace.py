"""How far grids are, and how fast their runs end: measured on the latest of them."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import Connection, Select, bindparam, func, select

from service.domain.states import RunState
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


def _progress() -> Select[Any]:
    """All that the view of one open grid needs of its runs, in one statement: each costs more than what it reads."""
    mine = run.c.grid_id == bindparam("wanted")
    latest = (
        select(run.c.finished_at, run.c.leased_at)
        .where(mine, run.c.finished_at.is_not(None), run.c.leased_at.is_not(None))
        .order_by(run.c.finished_at.desc())
        .limit(_RUNS)
        .subquery()
    )
    counts = (
        select(func.count()).select_from(run).where(mine, run.c.state == state).scalar_subquery() for state in RunState
    )
    return select(func.count(), func.min(latest.c.leased_at), func.max(latest.c.finished_at), *counts)


_PROGRESS = _progress()


def progress(connection: Connection, grid_id: str) -> tuple[dict[str, int], Recent | None]:
    """Runs of one grid by state, and the latest of them."""
    runs, began_at, ended_at, *counts = connection.execute(_PROGRESS, {"wanted": grid_id}).one()
    latest = Recent(runs, began_at, ended_at) if runs else None
    return dict(zip(RunState, counts, strict=True)), latest


def recent(connection: Connection, grid_ids: Collection[str]) -> dict[str, Recent]:
    """The latest runs of each grid of which any has ended."""
    rows = connection.execute(_MEASURED, {"ids": sorted(grid_ids)})
    return {grid_id: Recent(runs, began_at, ended_at) for grid_id, runs, began_at, ended_at in rows if runs}
