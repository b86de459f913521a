"""Measurements of uploaded images: grids of one run of the kind ``image``, and what was found."""

from __future__ import annotations

from typing import Any

from sqlalchemy import Row, select

from service.domain.states import RunState
from service.domain.views import UWS_PHASES, MeasurementPage, MeasurementView, RunError
from service.store.database import Database
from service.store.runs import IS_IMAGE, WHOLE, NotFoundError
from service.store.tables import grid, measurement, run

_SHORT = (
    grid.c.id,
    run.c.id.label("run_id"),
    grid.c.name,
    grid.c.owner,
    run.c.state,
    run.c.error_code,
    run.c.error_detail,
    grid.c.created_at,
    grid.c.finished_at,
    run.c.spec,
    measurement.c.figure,
)
_SOURCE = run.join(grid, grid.c.id == run.c.grid_id).outerjoin(measurement, measurement.c.run_id == run.c.id)


class MeasurementStore:
    """Measurements in the database."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def page(self, limit: int, before: str | None = None) -> MeasurementPage:
        """A page of measurements without what they found, newest first; ``next`` holds the cursor."""
        wanted = select(*_SHORT).select_from(_SOURCE).where(IS_IMAGE, WHOLE)
        if before is not None:
            wanted = wanted.where(run.c.grid_id < before)
        with self._database.read() as connection:
            rows = connection.execute(wanted.order_by(run.c.grid_id.desc()).limit(limit + 1)).all()
        items = [_view(row, None) for row in rows[:limit]]
        return MeasurementPage(items=items, next=items[-1].id if len(rows) > limit else None)

    def one(self, grid_id: str) -> MeasurementView:
        """One with what it found; a NotFoundError where there is none."""
        wanted = select(*_SHORT, measurement.c.document).select_from(_SOURCE)
        with self._database.read() as connection:
            row = connection.execute(wanted.where(run.c.grid_id == grid_id, IS_IMAGE, WHOLE)).one_or_none()
        if row is None:
            raise NotFoundError(f"there is no measurement {grid_id}")
        return _view(row, row.document)


def _view(row: Row[*tuple[Any, ...]], document: dict[str, Any] | None) -> MeasurementView:
    error = None if row.error_code is None else RunError(code=row.error_code, detail=row.error_detail)
    plain = ("id", "run_id", "name", "owner", "created_at", "finished_at")
    return MeasurementView(
        **{name: getattr(row, name) for name in plain},
        state=RunState(row.state),
        uws_phase=UWS_PHASES[row.state],
        error=error,
        uploads=row.spec["uploads"],
        options=row.spec["options"],
        measurement=document,
        links={} if row.figure is None else {"figure": row.figure},
    )
