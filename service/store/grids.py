"""Grids and runs as the API sees them: created, looked at, paused, resumed, cancelled, tried again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import islice
from typing import Any, TypeVar

from sqlalchemy import Connection, Row, bindparam, func, insert, select, update
from sqlalchemy.exc import IntegrityError

from service.identifiers import new_grid_id, run_id, utc_now
from service.schemas import GridPage, GridView, RunDetail, RunPage
from service.store.bulk import insert_rows
from service.store.database import Database
from service.store.leases import add_event, close_grids, lock_grids, pause_queued
from service.store.pace import recent
from service.store.states import CANCEL, RESUME, REVIVE, GridState, RunState, move
from service.store.summary import summarise
from service.store.tables import attempt, event, grid, idempotency, result, run
from service.store.views import RUN_COLUMNS, ended_grid_view, grid_view, run_detail, run_view

_T = TypeVar("_T")
_BATCH = 5000
# Made once: to make a statement takes as long as to carry it out.
_GRID = select(grid).where(grid.c.id == bindparam("wanted"))
_COUNTS = (
    select(run.c.grid_id, run.c.state, func.count().label("runs"))
    .where(run.c.grid_id.in_(bindparam("ids", expanding=True)))
    .group_by(run.c.grid_id, run.c.state)
)
_RUN = select(run).where(run.c.id == bindparam("wanted"))
_RESULT = select(result).where(result.c.run_id == bindparam("wanted"))
_ATTEMPTS = select(attempt).where(attempt.c.run_id == bindparam("wanted")).order_by(attempt.c.number)


class NotFoundError(LookupError):
    """There is no such thing in the database."""


class KeyReusedError(ValueError):
    """An idempotency key came back with another request."""


@dataclass(frozen=True)
class PlannedRun:
    """One run of a grid that is about to be stored."""

    label: str
    paper_run: int | None
    spec: dict[str, Any]
    inputs: dict[str, Any]
    digest: str


@dataclass(frozen=True)
class Created:
    """A grid that a request led to; ``replayed`` where an earlier request with the same key had made it."""

    grid: GridView
    replayed: bool


class GridStore:
    """Grids and runs in the database."""

    def __init__(self, database: Database, clock: Callable[[], datetime] = utc_now) -> None:
        self._database = database
        self._clock = clock

    def create(
        self,
        request: dict[str, Any],
        plan: Callable[[], Sequence[PlannedRun]],
        name: str | None = None,
        key: str | None = None,
        engine: str | None = None,
    ) -> Created:
        """Store a grid with all its runs, or give back the one that the same key made.

        Grid, runs and key are one transaction: after a crash there is the whole grid or none of it. ``plan`` is
        called only where there is something to create. ``engine`` is the digest of the engine whose results the grid
        takes, any where None.

        Raises
        ------
        KeyReusedError
            The key belongs to another request.
        """
        canonical = hashlib.sha256(json.dumps(request, sort_keys=True).encode()).hexdigest()
        known = self._by_key(key, canonical)
        if known is not None:
            return Created(known, replayed=True)
        runs = plan()
        try:
            return Created(self._insert(request, runs, name, key, canonical, engine), replayed=False)
        except IntegrityError:
            # Someone came first with the same key, between our look and our insert.
            known = self._by_key(key, canonical)
            if known is None:
                raise
            return Created(known, replayed=True)

    def _insert(
        self,
        request: dict[str, Any],
        runs: Sequence[PlannedRun],
        name: str | None,
        key: str | None,
        canonical: str,
        engine: str | None,
    ) -> GridView:
        now = self._clock()
        grid_id = new_grid_id(now)
        with self._database.write() as connection:
            row = {"id": grid_id, "name": name, "request": request, "n_runs": len(runs), "created_at": now}
            connection.execute(insert(grid).values(state=GridState.QUEUED, engine_digest=engine, **row))
            if key is not None:
                made = {"key": key, "request_digest": canonical, "grid_id": grid_id, "created_at": now}
                connection.execute(insert(idempotency), made)
            for batch in _batches(enumerate(runs), _BATCH):
                rows = [_run_row(grid_id, ordinal, planned, now) for ordinal, planned in batch]
                insert_rows(connection, run, rows)
            add_event(connection, grid_id, "grid_submitted", now, n_runs=len(runs))
            return self._grid(connection, grid_id)

    def _by_key(self, key: str | None, canonical: str) -> GridView | None:
        if key is None:
            return None
        with self._database.read() as connection:
            wanted = select(idempotency.c.grid_id, idempotency.c.request_digest).where(idempotency.c.key == key)
            row = connection.execute(wanted).one_or_none()
            if row is None:
                return None
            if row.request_digest != canonical:
                raise KeyReusedError(key)
            return self._grid(connection, row.grid_id)

    def grid(self, grid_id: str) -> GridView:
        """One grid; a NotFoundError where there is none."""
        with self._database.read() as connection:
            return self._grid(connection, grid_id)

    def summary(self, grid_id: str, limit: int, offset: int = 0) -> dict[str, Any]:
        """What a grid recovered, by :func:`service.store.summary.summarise`; one picture with its state."""
        with self._database.read() as connection:
            return summarise(connection, self._grid(connection, grid_id), limit, offset)

    def grids(self, limit: int, before: str | None = None) -> GridPage:
        """A page of grids, newest first, all from one picture of the database; ``next`` holds the cursor."""
        wanted = select(grid).order_by(grid.c.id.desc()).limit(limit + 1)
        if before is not None:
            wanted = wanted.where(grid.c.id < before)
        with self._database.read() as connection:
            rows = connection.execute(wanted).all()
            items = self._views(connection, rows[:limit])
        return GridPage(items=items, next=items[-1].id if len(rows) > limit else None)

    def runs(self, grid_id: str, limit: int, after: int = -1, state: RunState | None = None) -> RunPage:
        """A page of a grid's runs; ``next`` holds the cursor."""
        wanted = select(*RUN_COLUMNS).where(run.c.grid_id == grid_id, run.c.ordinal > after)
        if state is not None:
            wanted = wanted.where(run.c.state == state)
        with self._database.read() as connection:
            self._require(connection, grid_id)
            rows = connection.execute(wanted.order_by(run.c.ordinal).limit(limit + 1)).all()
        items = [run_view(row) for row in rows[:limit]]
        return RunPage(items=items, next=str(items[-1].ordinal) if len(rows) > limit else None)

    def run(self, wanted: str) -> RunDetail:
        """One run with result and attempts, from one picture of the database, so that they fit each other."""
        with self._database.read() as connection:
            row = connection.execute(_RUN, {"wanted": wanted}).one_or_none()
            if row is None:
                raise NotFoundError(f"there is no run {wanted}")
            found = connection.execute(_RESULT, {"wanted": wanted}).one_or_none()
            return run_detail(row, found, connection.execute(_ATTEMPTS, {"wanted": wanted}).all())

    def cancel(self, grid_id: str) -> GridView:
        """Cancel what is queued at once and mark the grid, so that the dispatcher stops what is running.

        A grid that has ended stays as it is.
        """
        now = self._clock()
        with self._database.write() as connection:
            self._require(connection, grid_id)
            lock_grids(connection, [grid_id])
            open_grid = (grid.c.id == grid_id) & (grid.c.state == GridState.QUEUED) & grid.c.cancelled_at.is_(None)
            marked = connection.execute(update(grid).where(open_grid).values(cancelled_at=now, paused_at=None))
            if marked.rowcount:
                dropped = move(connection, CANCEL, run.c.grid_id == grid_id, finished_at=now)
                add_event(connection, grid_id, "grid_cancelled", now, queued=len(dropped))
                close_grids(connection, [grid_id], now)
            return self._grid(connection, grid_id)

    def pause(self, grid_id: str) -> GridView:
        """Take the queued runs of a grid out of the queue; what is running goes on to its end.

        A grid that has ended, is being cancelled or is paused already stays as it is.
        """
        now = self._clock()
        with self._database.write() as connection:
            self._require(connection, grid_id)
            lock_grids(connection, [grid_id])
            open_grid = (grid.c.id == grid_id) & (grid.c.state == GridState.QUEUED) & grid.c.cancelled_at.is_(None)
            marked = connection.execute(update(grid).where(open_grid, grid.c.paused_at.is_(None)).values(paused_at=now))
            if marked.rowcount:
                held = pause_queued(connection, run.c.grid_id == grid_id)
                add_event(connection, grid_id, "grid_paused", now, runs=len(held))
            return self._grid(connection, grid_id)

    def resume(self, grid_id: str) -> GridView:
        """Put the paused runs of a grid back to their places in the queue; one that is not paused stays as it is."""
        now = self._clock()
        with self._database.write() as connection:
            self._require(connection, grid_id)
            lock_grids(connection, [grid_id])
            paused = (grid.c.id == grid_id) & grid.c.paused_at.is_not(None)
            if connection.execute(update(grid).where(paused).values(paused_at=None)).rowcount:
                freed = move(connection, RESUME, run.c.grid_id == grid_id)
                add_event(connection, grid_id, "grid_resumed", now, runs=len(freed))
            return self._grid(connection, grid_id)

    def revive(self, grid_id: str) -> int:
        """Queue again every run of a grid that ended without a result; how many.

        Earlier attempts stay on record but are no longer counted against the run. In a paused grid they wait with the
        others.
        """
        now = self._clock()
        with self._database.write() as connection:
            self._require(connection, grid_id)
            lock_grids(connection, [grid_id])
            fresh = {"not_before": now, "charged_from": run.c.attempt, "finished_at": None, "suspect": False}
            mine = run.c.grid_id == grid_id
            moved = move(connection, REVIVE, mine, error_code=None, error_detail=None, **fresh)
            if moved:
                values = {"state": GridState.QUEUED, "finished_at": None, "cancelled_at": None, "ending": None}
                connection.execute(update(grid).where(grid.c.id == grid_id).values(**values))
                add_event(connection, grid_id, "grid_revived", now, runs=len(moved))
                pause_queued(connection, mine)
            return len(moved)

    def stale_results(self) -> int:
        """How many results came too late so far, over all grids."""
        with self._database.read() as connection:
            counted = select(func.count()).select_from(event).where(event.c.kind == "stale_result")
            return connection.scalar(counted) or 0

    def _grid(self, connection: Connection, grid_id: str) -> GridView:
        row = connection.execute(_GRID, {"wanted": grid_id}).one_or_none()
        if row is None:
            raise NotFoundError(f"there is no grid {grid_id}")
        return self._views(connection, [row])[0]

    def _views(self, connection: Connection, rows: Sequence[Row[Any]]) -> list[GridView]:
        now = self._clock()
        # What has ended does not change, and was counted when it ended.
        ids = [row.id for row in rows if row.ending is None]
        counts: dict[str, dict[str, int]] = {grid_id: {} for grid_id in ids}
        for row in connection.execute(_COUNTS, {"ids": ids}) if ids else ():
            counts[row.grid_id][row.state] = row.runs
        return [
            grid_view(row, counts[row.id], recent(connection, row.id), now)
            if row.ending is None
            else ended_grid_view(row)
            for row in rows
        ]

    @staticmethod
    def _require(connection: Connection, grid_id: str) -> None:
        if connection.scalar(select(grid.c.id).where(grid.c.id == grid_id)) is None:
            raise NotFoundError(f"there is no grid {grid_id}")


def _run_row(grid_id: str, ordinal: int, planned: PlannedRun, now: datetime) -> dict[str, Any]:
    return {
        "id": run_id(grid_id, ordinal),
        "grid_id": grid_id,
        "ordinal": ordinal,
        "label": planned.label,
        "paper_run": planned.paper_run,
        "spec": planned.spec,
        "inputs": planned.inputs,
        "digest": planned.digest,
        "state": RunState.QUEUED,
        "attempt": 0,
        "charged_from": 0,
        "not_before": now,
    }


def _batches(items: Iterator[_T], size: int) -> Iterator[list[_T]]:
    while batch := list(islice(items, size)):
        yield batch
