"""Grids as the API sees them: created, looked at, paused, resumed, cancelled, tried again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Any

from sqlalchemy import (
    ColumnElement,
    Connection,
    Row,
    bindparam,
    case,
    func,
    literal_column,
    select,
    update,
)
from sqlalchemy.exc import IntegrityError

from service.domain.identifiers import utc_now
from service.domain.plan import Plan
from service.domain.precision import Until
from service.domain.states import CANCEL, PAUSE, RESUME, REVIVE, GridState, RunState
from service.domain.views import GridKind, GridPage, GridView
from service.store.database import Database
from service.store.leadership import leader_view
from service.store.leases import add_event, lock_grids
from service.store.pace import recent, recent_of
from service.store.pieces import PIECE, Turns
from service.store.points import progress
from service.store.rows import (
    ended_grid_view,
    grid_view,
)
from service.store.run_filter import RunFilter
from service.store.runs import IS_IMAGE, WHOLE, NotFoundError, RunStore, require_grid
from service.store.settling import IS_OPEN, revive_runs, settle
from service.store.submission import Submission, give_up, store
from service.store.summary import summarise
from service.store.tables import grid, idempotency, run

_REOPENED = {"state": GridState.QUEUED, "finished_at": None, "cancelled_at": None, "ending": None}
_BEGUN = (grid.c.id, grid.c.storing, grid.c.engine_digest, grid.c.created_at)


def _run_counts() -> Iterator[ColumnElement[int]]:
    """Runs of a grid in each state, by a look at the index alone; none where they were written down at its end."""
    for state in RunState:
        mine = (run.c.grid_id == grid.c.id) & (run.c.state == literal_column(f"'{state}'"))
        counted = select(func.count()).select_from(run).where(mine).correlate(grid).scalar_subquery()
        yield case((grid.c.ending.is_(None), counted)).label(f"{state}_runs")


# Made once: to make a statement takes as long as to carry it out.
_GRID = select(grid, *_run_counts()).where(grid.c.id == bindparam("wanted"), WHOLE)
_COUNTS = (
    select(run.c.grid_id, run.c.state, func.count().label("runs"))
    .where(run.c.grid_id.in_(bindparam("ids", expanding=True)))
    .group_by(run.c.grid_id, run.c.state)
)


class KeyReusedError(ValueError):
    """An idempotency key came back with another request."""


@dataclass(frozen=True)
class Created:
    """A grid that a request led to; ``replayed`` where an earlier request with the same key had made it."""

    grid: GridView
    replayed: bool


class GridStore(RunStore):
    """Grids and runs in the database."""

    def __init__(self, database: Database, clock: Callable[[], datetime] = utc_now) -> None:
        super().__init__(database)
        self._clock = clock

    def create(
        self,
        request: dict[str, Any],
        plan: Callable[[], Plan],
        name: str | None = None,
        key: str | None = None,
        engine: str | None = None,
        owner: str | None = None,
        expected_wall_s: Callable[[], float | None] = lambda: None,
        until: Until | None = None,
    ) -> Created:
        """Store a grid with all its runs, or give back the one that the same key made.

        After a crash there is the whole grid or none of it: what has been stored in part nobody sees, and it is gone on
        with where the key comes again, else taken away. ``plan`` is called only where there is something to create.
        ``engine`` is the digest of the engine whose results the grid takes, any where None; a key is its
        ``owner``'s: of another one it is another request. ``expected_wall_s`` is what its runs should take on one
        worker, asked as ``plan`` is. ``until`` ends replicates: the plan has ``at_most`` of each point, the first
        of all points before the second of any.

        Raises
        ------
        KeyReusedError
            The key belongs to another request.
        SubmissionLostError
            Storing took so long that the grid was given up.
        """
        asked = request if owner is None else [owner, request]
        canonical = hashlib.sha256(json.dumps(asked, sort_keys=True).encode()).hexdigest()
        known = self._by_key(key, canonical)
        if known is not None and not known.storing:
            return Created(self.grid(known.id), replayed=True)
        runs = plan()
        if known is not None and known.engine_digest != engine:
            # Another engine may have meant other runs by the same request.
            with self._database.write() as connection:
                give_up(connection, known.id, self._clock())
            known = None
        new = Submission(request, canonical, name, key, engine, self._clock(), owner, until=until)
        if known is None:
            new = replace(new, expected_wall_s=expected_wall_s())
            try:
                return Created(self.grid(store(self._database, new, runs)), replayed=False)
            except IntegrityError:
                # Someone came first with the same key, between our look and our insert.
                known = self._by_key(key, canonical)
                if known is None:
                    raise
        begun = replace(new, created_at=known.created_at)
        return Created(self.grid(store(self._database, begun, runs, known.id)), replayed=True)

    def _by_key(self, key: str | None, canonical: str) -> Row[*tuple[Any, ...]] | None:
        """Row of the grid that a key made, whole or not."""
        if key is None:
            return None
        with self._database.read() as connection:
            found = select(idempotency.c.request_digest, *_BEGUN).join(grid, grid.c.id == idempotency.c.grid_id)
            row = connection.execute(found.where(idempotency.c.key == key)).one_or_none()
        if row is not None and row.request_digest != canonical:
            raise KeyReusedError(key)
        return row

    def grid(self, grid_id: str) -> GridView:
        """One grid; a NotFoundError where there is none."""
        with self._database.read() as connection:
            return self._grid(connection, grid_id)

    def summary(self, grid_id: str, limit: int, offset: int = 0) -> dict[str, Any]:
        """What a grid recovered, by :func:`service.store.summary.summarise`; one picture with its state."""
        with self._database.read() as connection:
            return summarise(connection, self._grid(connection, grid_id), limit, offset)

    def grids(
        self,
        limit: int,
        before: str | None = None,
        *,
        with_requests: bool = True,
        kind: GridKind = "simulation",
    ) -> GridPage:
        """A page of grids, newest first, all from one picture of the database; ``next`` holds the cursor.

        Without their requests, which may have a megabyte each, that of every grid is empty.
        """
        columns = [column for column in grid.c if with_requests or column is not grid.c.request]
        wanted = select(*columns).where(WHOLE).order_by(grid.c.id.desc()).limit(limit + 1)
        if before is not None:
            wanted = wanted.where(grid.c.id < before)
        if kind != "all":
            # A look into their own small index for each grid.
            is_measured = select(run.c.id).where(run.c.grid_id == grid.c.id, IS_IMAGE).exists()
            wanted = wanted.where(is_measured if kind == "measurement" else ~is_measured)
        with self._database.read() as connection:
            rows = connection.execute(wanted).all()
            items = self._views(connection, rows[:limit])
        return GridPage(items=items, next=items[-1].id if len(rows) > limit else None)

    def owner(self, grid_id: str) -> str | None:
        """Whose grid it is; a NotFoundError where there is none."""
        with self._database.read() as connection:
            row = connection.execute(select(grid.c.owner).where(grid.c.id == grid_id, WHOLE)).one_or_none()
        if row is None:
            raise NotFoundError(f"there is no grid {grid_id}")
        owner: str | None = row.owner
        return owner

    def cancel(self, grid_id: str) -> GridView:
        """Mark the grid, so that nothing of it is started and the dispatcher stops what is running; end what is queued.

        A grid that has ended stays as it is.
        """
        now = self._clock()

        def mark(connection: Connection) -> None:
            open_grid = (grid.c.id == grid_id) & IS_OPEN & grid.c.cancelled_at.is_(None)
            values = {"cancelled_at": now, "paused_at": None, "revive_from": None}
            if connection.execute(update(grid).where(open_grid).values(**values)).rowcount:
                queued = _count(connection, grid_id, CANCEL.sources)
                add_event(connection, grid_id, "grid_cancelled", now, queued=queued)

        return self._marked(grid_id, mark)

    def pause(self, grid_id: str) -> GridView:
        """Take the queued runs of a grid out of the queue; what is running goes on to its end.

        A grid that has ended, is being cancelled or is paused already stays as it is.
        """
        now = self._clock()

        def mark(connection: Connection) -> None:
            open_grid = (grid.c.id == grid_id) & IS_OPEN & grid.c.cancelled_at.is_(None) & grid.c.paused_at.is_(None)
            if connection.execute(update(grid).where(open_grid).values(paused_at=now)).rowcount:
                add_event(connection, grid_id, "grid_paused", now, runs=_count(connection, grid_id, PAUSE.sources))

        return self._marked(grid_id, mark)

    def resume(self, grid_id: str) -> GridView:
        """Put the paused runs of a grid back to their places in the queue; one that is not paused stays as it is."""
        now = self._clock()

        def mark(connection: Connection) -> None:
            paused = (grid.c.id == grid_id) & grid.c.paused_at.is_not(None)
            if connection.execute(update(grid).where(paused).values(paused_at=None)).rowcount:
                add_event(connection, grid_id, "grid_resumed", now, runs=_count(connection, grid_id, RESUME.sources))

        return self._marked(grid_id, mark)

    def revive(self, grid_id: str, wanted: RunFilter | None = None) -> int:
        """Queue again the runs of a grid that ended without a result, all or those that are ``wanted``; how many.

        Earlier attempts stay on record but are no longer counted against the run. In a paused grid they wait with the
        others. Should this process die halfway through some that are wanted, the rest stays as it is until somebody
        asks for the same again.
        """
        if wanted is not None:
            return self._revive_some(grid_id, wanted)
        now = self._clock()
        runs = 0

        def mark(connection: Connection) -> None:
            nonlocal runs
            runs = _count(connection, grid_id, REVIVE.sources)
            if runs:
                connection.execute(update(grid).where(grid.c.id == grid_id).values(revive_from=0, **_REOPENED))
                add_event(connection, grid_id, "grid_revived", now, runs=runs)

        self._marked(grid_id, mark)
        return runs

    def _revive_some(self, grid_id: str, wanted: RunFilter) -> int:
        with self._database.read() as connection:
            require_grid(connection, grid_id)
            found = wanted.runs(connection, grid_id, REVIVE.sources)
        revived = 0
        for first in range(0, len(found), PIECE):
            ids, now = found[first : first + PIECE], self._clock()

            def mark(connection: Connection, ids: Sequence[str] = ids, now: datetime = now) -> None:
                nonlocal revived
                # Those that have ended without a result still: somebody else may have been faster.
                runs = len(revive_runs(connection, run.c.id.in_(ids), now))
                if runs:
                    connection.execute(update(grid).where(grid.c.id == grid_id).values(**_REOPENED))
                    add_event(connection, grid_id, "grid_revived", now, runs=runs)
                revived += runs

            self._marked(grid_id, mark)
        return revived

    def _marked(self, grid_id: str, mark: Callable[[Connection], None]) -> GridView:
        """Set a mark and bring the runs to where it wants them, the first of them in the same transaction.

        Should this process die in between, the dispatcher goes on, and so does whoever asks for the same again.
        """
        turns = Turns(self._database)
        with self._database.write() as connection:
            require_grid(connection, grid_id)
            lock_grids(connection, [grid_id])
            mark(connection)
            more = settle(connection, grid_id, self._clock())
        while more:
            turns.ended()
            turns.wait()
            with self._database.write() as connection:
                lock_grids(connection, [grid_id])
                more = settle(connection, grid_id, self._clock())
        return self.grid(grid_id)

    def _grid(self, connection: Connection, grid_id: str) -> GridView:
        row = connection.execute(_GRID, {"wanted": grid_id}).one_or_none()
        if row is None:
            raise NotFoundError(f"there is no grid {grid_id}")
        if row.ending is not None:
            return ended_grid_view(row)
        counts = {str(state): row._mapping[f"{state}_runs"] for state in RunState}
        latest = recent_of(connection, grid_id)
        workers = _workers(connection) if latest is None and row.expected_wall_s is not None else 0
        far = progress(connection, _with_rule([row])).get(row.id)
        return grid_view(row, counts, latest, self._clock(), workers, far)

    def _views(self, connection: Connection, rows: Sequence[Row[Any]]) -> list[GridView]:
        now = self._clock()
        # What has ended does not change, and was counted when it ended.
        ids = [row.id for row in rows if row.ending is None]
        counts: dict[str, dict[str, int]] = {grid_id: {} for grid_id in ids}
        for row in connection.execute(_COUNTS, {"ids": ids}) if ids else ():
            counts[row.grid_id][row.state] = row.runs
        latest = recent(connection, ids) if ids else {}
        workers = _workers(connection) if len(latest) < len(ids) else 0
        far = progress(connection, _with_rule([row for row in rows if row.ending is None]))
        return [
            grid_view(row, counts[row.id], latest.get(row.id), now, workers, far.get(row.id))
            if row.ending is None
            else ended_grid_view(row)
            for row in rows
        ]


def _with_rule(rows: Sequence[Row[Any]]) -> dict[str, tuple[int, int]]:
    """Points and most replicates of those grids that end replicates."""
    return {row.id: (row.points, row.until["at_most"]) for row in rows if row.until is not None}


def _workers(connection: Connection) -> int:
    leader = leader_view(connection)
    return 0 if leader is None else leader.workers


def _count(connection: Connection, grid_id: str, states: Collection[RunState]) -> int:
    counted = select(func.count()).where(run.c.grid_id == grid_id, run.c.state.in_(sorted(states)))
    return connection.scalar(counted) or 0
