"""A grid is stored in pieces, and seen by nobody before the last of them.

Until then its row says ``storing``: it is in no list and no count, and nothing of it is claimed. A plan gives the same
runs each time, so that whoever repeats a request by its idempotency key goes on where the first one stands, dead or
alive. What nobody goes on with is taken away again (:mod:`service.store.upkeep`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from itertools import islice
from typing import Any

from sqlalchemy import Connection, Select, delete, func, insert, select, true, update

from service.domain.identifiers import new_grid_id, run_id
from service.domain.plan import Plan, PlannedRun
from service.domain.precision import Until
from service.domain.states import GridState, RunState
from service.store.bulk import insert_rows
from service.store.database import Database
from service.store.leases import add_event, lock_grids
from service.store.pieces import PIECE, Turns, places
from service.store.settling import IS_OPEN
from service.store.tables import grid, idempotency, run


class SubmissionLostError(RuntimeError):
    """Of a grid nothing had been stored for so long that it was given up; the request may be repeated."""


@dataclass(frozen=True)
class Submission:
    """A grid that is about to be stored: all of its row that comes from outside."""

    request: dict[str, Any]
    request_digest: str
    name: str | None
    key: str | None
    engine: str | None
    created_at: datetime
    owner: str | None = None
    expected_wall_s: float | None = None
    until: Until | None = None


def store(database: Database, submission: Submission, plan: Plan, begun: str | None = None) -> str:
    """Store a grid, or go on with the one that has been ``begun``; its id, once all of it is in the database.

    Grid, key and the first piece are one transaction, the last piece and the grid's appearance another; where one
    piece is all, they are one.

    Raises
    ------
    SubmissionLostError
        Somebody has given the grid up meanwhile.
    sqlalchemy.exc.IntegrityError
        There is a grid with this key already.
    """
    turns = Turns(database)
    stored = 0
    source: Iterator[PlannedRun] = iter(plan)
    place = 0
    grid_id = begun or new_grid_id(submission.created_at)
    while True:
        if stored < place:  # pragma: no cover - somebody else's pieces are smaller
            source, place = iter(plan), 0
        planned = list(islice(source, stored - place, stored - place + PIECE))
        place = stored + len(planned)
        rows = [_run_row(grid_id, stored + nth, one, submission.created_at) for nth, one in enumerate(planned)]
        turns.wait()
        with database.write() as connection:
            if begun is None and stored == 0:
                _begin(connection, grid_id, submission, len(plan))
            elif _accepted(connection, grid_id):
                return grid_id
            found = stored_runs(connection, grid_id)
            if found == stored and rows:
                insert_rows(connection, run, rows)
                found += len(rows)
            if found == len(plan):
                _accept(connection, grid_id, submission.created_at, found)
                return grid_id
        turns.ended()
        if found == stored:
            raise ValueError(f"the plan has {place} runs, and said {len(plan)}")
        stored = found


def _begin(connection: Connection, grid_id: str, submission: Submission, n_runs: int) -> None:
    until = submission.until
    connection.execute(
        insert(grid).values(
            id=grid_id,
            name=submission.name,
            request=submission.request,
            n_runs=n_runs,
            state=GridState.QUEUED,
            created_at=submission.created_at,
            engine_digest=submission.engine,
            owner=submission.owner,
            expected_wall_s=submission.expected_wall_s,
            until=None if until is None else until.model_dump(),
            points=None if until is None else n_runs // until.at_most,
            storing=True,
        )
    )
    if submission.key is not None:
        made = {"key": submission.key, "request_digest": submission.request_digest, "grid_id": grid_id}
        connection.execute(insert(idempotency).values(created_at=submission.created_at, **made))


def _accepted(connection: Connection, grid_id: str) -> bool:
    """Whether another process has stored the last piece; locks the grid, so that pieces come one after the other."""
    lock_grids(connection, [grid_id])
    row = connection.execute(select(grid.c.storing, grid.c.cancelled_at).where(grid.c.id == grid_id)).one_or_none()
    if row is None or (row.storing and row.cancelled_at is not None):
        raise SubmissionLostError(f"nothing was stored of grid {grid_id} for too long; repeat the request")
    return not row.storing


def _accept(connection: Connection, grid_id: str, now: datetime, n_runs: int) -> None:
    connection.execute(update(grid).where(grid.c.id == grid_id).values(storing=False))
    add_event(connection, grid_id, "grid_submitted", now, n_runs=n_runs)


def stored_runs(connection: Connection, grid_id: str) -> int:
    """How many runs of a grid are stored, the first ones of its plan."""
    last: int | None = connection.scalar(select(func.max(run.c.ordinal)).where(run.c.grid_id == grid_id))
    return 0 if last is None else last + 1


def being_stored() -> Select[tuple[str, datetime | None]]:
    """Grids that are not whole, and since when each is given up."""
    return select(grid.c.id, grid.c.cancelled_at).where(IS_OPEN, grid.c.storing == true())


def give_up(connection: Connection, grid_id: str, now: datetime) -> None:
    """Let nobody go on with a grid that is not whole, and its key be used anew; one that is whole stays as it is."""
    lock_grids(connection, [grid_id])
    unfinished = (grid.c.id == grid_id) & (grid.c.storing == true())
    if connection.execute(update(grid).where(unfinished).values(cancelled_at=now)).rowcount:
        connection.execute(delete(idempotency).where(idempotency.c.grid_id == grid_id))


def take_away(connection: Connection, grid_id: str) -> None:
    """Delete a piece of a grid that was given up, at last the grid; any other stays as it is."""
    lock_grids(connection, [grid_id])
    given_up = (grid.c.id == grid_id) & (grid.c.storing == true()) & grid.c.cancelled_at.is_not(None)
    if connection.scalar(select(grid.c.id).where(given_up)) is None:
        return
    first = connection.scalar(select(func.min(run.c.ordinal)).where(run.c.grid_id == grid_id))
    if first is None:
        connection.execute(delete(grid).where(given_up))
    else:
        connection.execute(delete(run).where(places(grid_id, first)))


def _run_row(grid_id: str, ordinal: int, planned: PlannedRun, now: datetime) -> dict[str, Any]:
    return {
        "id": run_id(grid_id, ordinal),
        "grid_id": grid_id,
        "ordinal": ordinal,
        "label": planned.label,
        "paper_run": planned.paper_run,
        "kind": planned.kind,
        "spec": planned.spec,
        "inputs": planned.inputs,
        "digest": planned.digest,
        "state": RunState.QUEUED,
        "attempt": 0,
        "charged_from": 0,
        "not_before": now,
    }
