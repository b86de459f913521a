"""Runs as the API sees them: those of a grid, and one with its result and its attempts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy import Connection, Row, Select, bindparam, false, func, literal_column, select

from service.domain.plan import IMAGE
from service.domain.states import RunState
from service.domain.views import CompactRunPage, RunDetail, RunPage
from service.store.database import Database
from service.store.rows import (
    ATTEMPT_COLUMNS,
    ESTIMATE_COLUMNS,
    RUN_COLUMNS,
    run_document,
    run_item,
    run_view,
)
from service.store.tables import attempt, estimate, grid, result, run

WHOLE = grid.c.storing == false()
"""What anybody may see: all but what is being stored."""
# Spelt out: a database takes a partial index only where it sees that the condition implies it.
IS_IMAGE = run.c.kind == literal_column(f"'{IMAGE}'")
"""Whether a run measures an uploaded image."""
_RUN = select(run).join(grid, grid.c.id == run.c.grid_id).where(run.c.id == bindparam("wanted"), WHOLE)
_VERSION_OF_RUN = ("state", "attempt", "suspect", "finished_at", "error_code", "error_detail")
_VERSION_OF_RESULT = ("payload_digest", "stored_at", "figure", "products")
_RUN_VERSION = (
    select(
        *(run.c[name] for name in _VERSION_OF_RUN),
        # They may be pruned.
        select(func.count()).where(attempt.c.run_id == run.c.id).correlate(run).scalar_subquery(),
        *(result.c[name] for name in _VERSION_OF_RESULT),
    )
    .join(grid, grid.c.id == run.c.grid_id)
    .outerjoin(result, result.c.run_id == run.c.id)
    .where(run.c.id == bindparam("wanted"), WHOLE)
)
_RESULT = select(result).where(result.c.run_id == bindparam("wanted"))
_ESTIMATES = select(*ESTIMATE_COLUMNS).where(estimate.c.run_id == bindparam("wanted"))
_ATTEMPTS = select(*ATTEMPT_COLUMNS).where(attempt.c.run_id == bindparam("wanted")).order_by(attempt.c.number)


class NotFoundError(LookupError):
    """There is no such thing in the database."""


def require_grid(connection: Connection, grid_id: str) -> None:
    """Pass where there is a grid; a NotFoundError where there is none."""
    if connection.scalar(select(grid.c.id).where(grid.c.id == grid_id, WHOLE)) is None:
        raise NotFoundError(f"there is no grid {grid_id}")


class RunStore:
    """Runs in the database."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def runs(self, grid_id: str, limit: int, after: int = -1, state: RunState | None = None) -> RunPage:
        """A page of a grid's runs; ``next`` holds the cursor."""
        rows, following = self._page(select(*RUN_COLUMNS), grid_id, limit, after, state)
        return RunPage(items=[run_view(row) for row in rows], next=following)

    def run_items(self, grid_id: str, limit: int, after: int = -1, state: RunState | None = None) -> CompactRunPage:
        """A page of a grid's runs in short; ``links`` of each has the keys of its artefacts."""
        columns = (run.c.id, run.c.ordinal, run.c.label, run.c.state, run.c.error_code, run.c.finished_at)
        wanted = select(*columns, result.c.figure, result.c.products).outerjoin(result, result.c.run_id == run.c.id)
        rows, following = self._page(wanted, grid_id, limit, after, state)
        return CompactRunPage(items=[run_item(row) for row in rows], next=following)

    def _page(
        self, wanted: Select[Any], grid_id: str, limit: int, after: int, state: RunState | None
    ) -> tuple[Sequence[Row[Any]], str | None]:
        """Rows of a grid's runs, of any columns, and the cursor behind them where there are more."""
        wanted = wanted.where(run.c.grid_id == grid_id, run.c.ordinal > after)
        if state is not None:
            wanted = wanted.where(run.c.state == state)
        with self._database.read() as connection:
            require_grid(connection, grid_id)
            rows = connection.execute(wanted.order_by(run.c.ordinal).limit(limit + 1)).all()
        return rows[:limit], str(rows[limit - 1].ordinal) if len(rows) > limit else None

    def run_version(self, wanted: str) -> tuple[Any, ...]:
        """What changes whenever a run's document does, without reading that."""
        with self._database.read() as connection:
            row = connection.execute(_RUN_VERSION, {"wanted": wanted}).one_or_none()
        if row is None:
            raise NotFoundError(f"there is no run {wanted}")
        return tuple(row)

    def run(self, wanted: str) -> RunDetail:
        """One run with result and attempts, checked."""
        return RunDetail.model_validate(self.run_document(wanted)[1])

    def run_document(self, wanted: str) -> tuple[tuple[Any, ...], dict[str, Any]]:
        """Its :meth:`run_version`, and the same as plain data: one picture of the database, whose parts fit."""
        parameters = {"wanted": wanted}
        with self._database.read() as connection:
            row = connection.execute(_RUN, parameters).one_or_none()
            if row is None:
                raise NotFoundError(f"there is no run {wanted}")
            found = connection.execute(_RESULT, parameters).one_or_none()
            estimates = [] if found is None else connection.execute(_ESTIMATES, parameters).all()
            attempts = connection.execute(_ATTEMPTS, parameters).all()
        version = [getattr(row, name) for name in _VERSION_OF_RUN]
        version += [len(attempts), *(None if found is None else getattr(found, name) for name in _VERSION_OF_RESULT)]
        return tuple(version), run_document(row, found, estimates, attempts)
