"""The outbox: what has happened to a grid, in order."""

from __future__ import annotations

from sqlalchemy import Integer, String, bindparam, func, select

from service.domain.views import EventPage, EventView
from service.store.database import Database
from service.store.runs import WHOLE, NotFoundError
from service.store.tables import event, grid

_WANTED = bindparam("wanted", type_=String)
_ENDED = select(grid.c.finished_at).where(grid.c.id == _WANTED, WHOLE)
_EVENTS = (
    select(event)
    .where(event.c.grid_id == _WANTED, event.c.id > bindparam("after"))
    .order_by(event.c.id)
    .limit(bindparam("most", type_=Integer))
)
_LATEST = select(func.max(event.c.id)).where(event.c.grid_id == _WANTED)


class EventStore:
    """Events of grids.

    Whoever reads on from the last number that was seen misses nothing of what becomes of runs: all of that is written
    under the lock of the grid, so numbers are committed in their order. Only a ``stale_result``, which changes
    nothing, and a ``run_started``, whose run has still to end, may come in behind, and then be missed.
    """

    def __init__(self, database: Database) -> None:
        self._database = database

    def page(self, grid_id: str, after: int, limit: int) -> EventPage:
        """Up to ``limit`` events with numbers above ``after``; ``next`` holds the cursor where there are more.

        Raises
        ------
        service.store.grids.NotFoundError
            There is no such grid.
        """
        asked = {"wanted": grid_id, "after": after, "most": limit + 1}
        with self._database.read() as connection:
            ended = connection.execute(_ENDED, {"wanted": grid_id}).one_or_none()
            if ended is None:
                raise NotFoundError(f"there is no grid {grid_id}")
            rows = connection.execute(_EVENTS, asked).all()
        items = [EventView(**{name: getattr(row, name) for name in EventView.model_fields}) for row in rows[:limit]]
        cursor = items[-1].id if items else after
        more = len(rows) > limit
        return EventPage(
            items=items, cursor=cursor, ended=ended.finished_at is not None, next=str(cursor) if more else None
        )

    def latest(self, grid_id: str) -> int:
        """Number of the newest event of a grid, 0 where there is none."""
        with self._database.read() as connection:
            return connection.scalar(_LATEST, {"wanted": grid_id}) or 0

    def lacks(self, grid_id: str, after: int) -> bool:
        """Whether events above ``after`` have been pruned, so that whoever saw ``after`` last cannot read on from it.

        The first event of a grid tells of its submission, unless it was pruned.
        """
        first = select(event.c.id, event.c.kind).where(event.c.grid_id == grid_id).order_by(event.c.id).limit(1)
        with self._database.read() as connection:
            oldest = connection.execute(first).one_or_none()
        return oldest is not None and oldest.kind != "grid_submitted" and oldest.id > after
