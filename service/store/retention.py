"""What may go of the rows that grow with time, and what is kept and why.

Results, runs and grids stay. Events, attempts, idempotency keys and what was measured in uploaded images go once their
grid has ended before a certain time and they are older than it themselves: attempts of an open grid count against its
runs, events of one are read on, and its key still has to find it. The newest event of each grid stays, so that numbers
go on from it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import Column, ColumnElement, Select, Table, and_, case, delete, func, literal_column, select, tuple_

from service.domain.states import OPEN_STATES, RunState
from service.store.database import Database
from service.store.leases import lock_grids
from service.store.pieces import PIECE, Turns
from service.store.tables import attempt, event, grid, idempotency, measurement, result, run

OPEN, YOUNGER, NEWEST = "its grid is open", "younger", "newest of its grid, which streams resume from"
_OLD = "old"


@dataclass(frozen=True)
class _Kind:
    """A table, the columns of its key, when a row is from, and how to come to its grid."""

    name: str
    table: Table
    key: tuple[Column[Any], ...]
    at: Column[datetime]
    source: Any
    newest: ColumnElement[bool] | None = None


_other = event.alias()
_KINDS = (
    _Kind(
        "events",
        event,
        (event.c.id,),
        event.c.created_at,
        event.join(grid, grid.c.id == event.c.grid_id),
        event.c.id == select(func.max(_other.c.id)).where(_other.c.grid_id == event.c.grid_id).scalar_subquery(),
    ),
    _Kind(
        "attempts",
        attempt,
        (attempt.c.run_id, attempt.c.number),
        attempt.c.ended_at,
        attempt.join(run, run.c.id == attempt.c.run_id).join(grid, grid.c.id == run.c.grid_id),
    ),
    _Kind(
        "idempotency keys",
        idempotency,
        (idempotency.c.key,),
        idempotency.c.created_at,
        idempotency.join(grid, grid.c.id == idempotency.c.grid_id),
    ),
    _Kind(
        "measurements",
        measurement,
        (measurement.c.run_id,),
        measurement.c.stored_at,
        measurement.join(run, run.c.id == measurement.c.run_id).join(grid, grid.c.id == run.c.grid_id),
    ),
)
KINDS = tuple(kind.name for kind in _KINDS)


@dataclass(frozen=True)
class Share:
    """Of one kind, how many rows are to go, and how many are kept for which reason."""

    kind: str
    going: int
    kept: dict[str, int]


class Retention:
    """Rows from before a certain time."""

    def __init__(self, database: Database, before: datetime) -> None:
        self._database = database
        self._before = before

    def shares(self) -> Iterator[Share]:
        """Count each kind, which reads all of its rows and changes nothing."""
        for kind in _KINDS:
            counted = select(self._verdict(kind).label("verdict"), func.count()).select_from(kind.source)
            with self._database.read() as connection:
                rows = connection.execute(counted.group_by("verdict")).all()
            found = {str(verdict): int(number) for verdict, number in rows}
            yield Share(kind.name, found.pop(_OLD, 0), found)

    def prune(self, name: str) -> Iterator[int]:
        """Delete what is to go of a kind, a piece at a time; how many rows were deleted by each.

        Each piece looks again under the locks of its grids, so that of one that is retried meanwhile nothing goes.
        """
        kind = next(kind for kind in _KINDS if kind.name == name)
        turns = Turns(self._database)
        last: Any = None
        while True:
            with self._database.read() as connection:
                rows = connection.execute(self._old(kind, last)).all()
            if not rows:
                return
            last = rows[-1][1:]
            turns.wait()
            with self._database.write() as connection:
                lock_grids(connection, {row.grid_id for row in rows})
                ended = select(grid.c.id).where(grid.c.id.in_({row.grid_id for row in rows}), self._ended())
                still = set(connection.scalars(ended))
                keys = [tuple(row[1:]) for row in rows if row.grid_id in still]
                gone = connection.execute(delete(kind.table).where(tuple_(*kind.key).in_(keys))).rowcount
            turns.ended()
            yield gone

    def _ended(self) -> ColumnElement[bool]:
        return grid.c.finished_at < self._before

    def _verdict(self, kind: _Kind) -> ColumnElement[str]:
        rules: list[tuple[ColumnElement[bool], str]] = [
            (grid.c.finished_at.is_(None), OPEN),
            (~and_(self._ended(), kind.at < self._before), YOUNGER),
        ]
        if kind.newest is not None:
            rules.append((kind.newest, NEWEST))
        return case(*rules, else_=_OLD)

    def _old(self, kind: _Kind, last: Any) -> Select[*tuple[Any, ...]]:
        """The next rows that are to go, in the order of their key."""
        wanted = select(grid.c.id.label("grid_id"), *kind.key).select_from(kind.source)
        wanted = wanted.where(self._ended(), kind.at < self._before)
        if kind.newest is not None:
            wanted = wanted.where(~kind.newest)
        if last is not None:
            wanted = wanted.where(tuple_(*kind.key) > tuple_(*last))
        return wanted.order_by(*kind.key).limit(PIECE)


def referred_artefacts(database: Database) -> set[str]:
    """Keys of all artefacts that results, measurements and uploads that wait to be measured refer to."""
    with database.read() as connection:
        rows = connection.execution_options(yield_per=10_000).execute(select(result.c.figure, result.c.products))
        referred = {key for row in rows for key in row if key is not None}
        # What was uploaded is kept as long as it may have to be measured, and then as what was found in it.
        wanted = run.c.state.in_(sorted(OPEN_STATES)) | measurement.c.run_id.is_not(None)
        source = run.outerjoin(measurement, measurement.c.run_id == run.c.id)
        images = select(run.c.spec, measurement.c.figure).select_from(source)
        for spec, figure in connection.execute(images.where(run.c.kind == literal_column("'image'"), wanted)):
            referred |= {*spec["uploads"].values(), *([] if figure is None else [figure])}
        return referred


def oldest_lease(database: Database) -> datetime | None:
    """When the first of the runs that are under way was claimed."""
    with database.read() as connection:
        leased = run.c.state == literal_column(f"'{RunState.LEASED}'")
        started: datetime | None = connection.scalar(select(func.min(run.c.leased_at)).where(leased))
    return started
