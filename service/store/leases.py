"""How a lease ends: the steps that every transaction which takes a run out of ``leased`` is made of.

Order of locks, everywhere: leader, then grids by id, then runs. A claim locks runs alone and skips locked ones.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from typing import Any, NamedTuple

from sqlalchemy import ColumnElement, Connection, Row, exists, func, literal_column, select, update

from service.domain.states import CANCEL, OPEN_STATES, PAUSE, QUARANTINE, REQUEUE, SPARE, GridState, RunState
from service.store.bulk import insert_rows
from service.store.faults import AWAY
from service.store.pace import recent
from service.store.tables import attempt, event, grid, point, run
from service.store.transitions import move

_LOG = logging.getLogger(__name__)
AT_ONCE = 5000
"""Runs that one statement may name: databases take so many parameters and no more."""
ENDING_REFUSED = "ending_refused"
"""Error code of a run whose end the database would not take."""

Pair = tuple[str, str]
"""A run and a token. Only together do they name a lease: all runs of one claim share a token."""

LeasedRow = Row[*tuple[Any, ...]]
"""A leased run, as :func:`leased` reads it."""


class Outcome(StrEnum):
    """How an attempt ended; only ``error``, ``worker_lost`` and ``deadline`` count against the run."""

    DONE = "done"
    ERROR = "error"
    WORKER_LOST = "worker_lost"
    SUSPECTED = "suspected"
    OTHER_ENGINE = "other_engine"
    DEADLINE = "deadline"
    CANCELLED = "cancelled"
    HANDED_BACK = "handed_back"
    DISPATCHER_LOST = "dispatcher_lost"
    FORGOTTEN = "forgotten"
    SCHEDULER_LOST = "scheduler_lost"
    REFUSED = "refused"
    STALLED = "stalled"


@dataclass(frozen=True)
class Lease:
    """The right to run a run once: whoever holds the token may store its result.

    ``engine`` is the digest of the engine whose results the grid takes (None: any); a ``suspect`` may have killed a
    worker, and has to be run alone. ``kind`` says what is to be done with the specification.
    """

    run_id: str
    grid_id: str
    attempt: int
    token: str
    generation: int
    digest: str
    spec: dict[str, Any]
    started_at: datetime
    engine: str | None = None
    suspect: bool = False
    kind: str = "realization"

    @property
    def pair(self) -> Pair:
        """What the database knows the lease by."""
        return self.run_id, self.token

    @property
    def key(self) -> str:
        """Name of the Dask task: never the same twice, so that Dask takes no old answer for a new one.

        All begin alike: Dask's scheduler keeps statistics for each beginning, and never drops them.
        """
        return f"run-{self.run_id}-{self.attempt}-{self.token}"


_LEASED = (
    run.c.id,
    run.c.grid_id,
    run.c.attempt,
    run.c.charged_from,
    run.c.token,
    run.c.generation,
    run.c.leased_at,
)


def lock_grids(connection: Connection, grid_ids: Iterable[str]) -> None:
    """Let one transaction at a time finish runs of a grid, or two could each take the other's run for unfinished."""
    wanted = select(grid.c.id).where(grid.c.id.in_(sorted(set(grid_ids)))).order_by(grid.c.id)
    connection.execute(wanted.with_for_update(key_share=True)).all()


def leased(connection: Connection, where: ColumnElement[bool]) -> list[LeasedRow]:
    """The leased runs that ``where`` picks, they and their grids locked to the end of the transaction."""
    # Spelt out, and the grids not made distinct there, or a take-over would go through all runs that ever were.
    condition = (run.c.state == literal_column(f"'{RunState.LEASED}'")) & where
    lock_grids(connection, connection.scalars(select(run.c.grid_id).where(condition)))
    return list(connection.execute(select(*_LEASED).where(condition).order_by(run.c.id).with_for_update()).all())


def leased_by(connection: Connection, leases: Sequence[Lease]) -> list[LeasedRow]:
    """The runs of those of the leases that are valid, each once, locked as :func:`leased` does; 5,000 at most."""
    # Found by their ids, which are the primary key, and compared as pairs: a run may be leased anew, and by the claim
    # of another run that is asked for beside it.
    pairs = {lease.pair for lease in leases}
    rows = leased(connection, run.c.id.in_({lease.run_id for lease in leases}))
    return [row for row in rows if (row.id, row.token) in pairs]


def end_attempts(
    connection: Connection,
    rows: Sequence[LeasedRow],
    outcome: Outcome,
    now: datetime,
    code: str | None = None,
    detail: str | None = None,
) -> None:
    """Write down how the attempts of leased runs ended; rows are only ever added."""
    if rows:
        insert_rows(
            connection,
            attempt,
            [
                {
                    "run_id": row.id,
                    "number": row.attempt,
                    "token": row.token,
                    "generation": row.generation,
                    "started_at": row.leased_at,
                    "ended_at": now,
                    "outcome": outcome,
                    "code": code,
                    "detail": detail,
                }
                for row in rows
            ],
        )


class Requeued(NamedTuple):
    """Ids of the runs that went back and are still wanted, and of those that had to be set aside."""

    given: list[str]
    refused: list[str]


def requeue(
    connection: Connection,
    rows: Sequence[LeasedRow],
    outcome: Outcome,
    now: datetime,
    detail: str | None = None,
    not_before: datetime | None = None,
    suspect: bool = False,
) -> Requeued:
    """Give leased runs back to the queue, or cancel or pause those whose grid was cancelled or paused meanwhile.

    One whose point was reached meanwhile is not needed any more.
    Without ``not_before`` they keep their place at the head of the queue; as a ``suspect`` they wait in a lane of
    their own. One that the database refuses keeps no other from going back: it is set aside.
    """
    values: dict[str, Any] = {} if not_before is None else {"not_before": not_before}
    if suspect:
        values["suspect"] = True
    done = Requeued([], [])
    for first in range(0, len(rows), AT_ONCE):
        some = rows[first : first + AT_ONCE]
        try:
            with connection.begin_nested():
                done.given.extend(_requeue(connection, some, outcome, now, values, detail))
        except AWAY:
            raise
        except Exception as error:  # noqa: BLE001 - whatever is wrong with one of them, the others have to go back
            if len(some) > 1:
                for row in some:
                    one = requeue(connection, [row], outcome, now, detail, not_before, suspect)
                    done.given.extend(one.given)
                    done.refused.extend(one.refused)
            else:
                set_aside(connection, some[0], now, error)
                done.refused.append(some[0].id)
    return done


def _requeue(
    connection: Connection,
    rows: Sequence[LeasedRow],
    outcome: Outcome,
    now: datetime,
    values: dict[str, Any],
    detail: str | None,
) -> list[str]:
    end_attempts(connection, rows, outcome, now, detail=detail)
    ids = [row.id for row in rows]
    moved = move(connection, REQUEUE, run.c.id.in_(ids), **values)
    told = {"outcome": outcome}
    add_events(
        connection,
        [new_event(row.grid_id, "run_requeued", now, row.id, **told, attempt=row.attempt) for row in rows],
    )
    cancelled_grids = select(grid.c.id).where(grid.c.cancelled_at.is_not(None))
    dropped = set(move(connection, CANCEL, run.c.id.in_(ids), run.c.grid_id.in_(cancelled_grids), finished_at=now))
    dropped.update(spare_queued(connection, run.c.id.in_(ids), now))
    if dropped:
        close_grids(connection, {row.grid_id for row in rows}, now)
    pause_queued(connection, run.c.id.in_(ids))
    return [run_id for run_id in moved if run_id not in dropped]


def set_aside(connection: Connection, row: LeasedRow, now: datetime, reason: Exception) -> None:
    """Quarantine a leased run whose end the database refuses for what it is; the caller holds the locks.

    Its state is what has to change, or it would be in the way of every dispatcher to come. What else belongs to an end
    is written as far as the database takes it: an attempt may be what it refuses.
    """
    _LOG.error("run %s cannot be ended, and is set aside", row.id, exc_info=reason)
    # The kind alone: the text quotes what was refused, and that may be what the database cannot hold.
    detail = f"the database refused how this run ended: {type(reason).__name__}"
    why = {"error_code": ENDING_REFUSED, "error_detail": detail}
    told = {"attempt": row.attempt, "code": ENDING_REFUSED}
    parts: tuple[Callable[[], object], ...] = (
        lambda: move(connection, QUARANTINE, run.c.id == row.id, finished_at=now, **why),
        lambda: end_attempts(connection, [row], Outcome.REFUSED, now, ENDING_REFUSED, detail),
        lambda: add_event(connection, row.grid_id, "run_quarantined", now, row.id, **told),
        lambda: close_grids(connection, [row.grid_id], now),
    )
    for write in parts:
        try:
            with connection.begin_nested():
                write()
        except AWAY:
            raise
        except Exception:  # noqa: BLE001 - what it refuses of this either must not keep the others
            _LOG.exception("a part of the end of run %s is not on record", row.id)


def pause_queued(connection: Connection, where: ColumnElement[bool]) -> list[str]:
    """Take queued runs of paused grids out of the queue; the caller holds the grids' locks."""
    paused_grids = select(grid.c.id).where(grid.c.paused_at.is_not(None))
    return move(connection, PAUSE, where, run.c.grid_id.in_(paused_grids))


def spare_queued(connection: Connection, where: ColumnElement[bool], now: datetime) -> list[str]:
    """Take waiting runs of points that were reached out of the queue; the caller holds the grids' locks."""
    points = select(grid.c.points).where(grid.c.id == run.c.grid_id).correlate(run).scalar_subquery()
    mine = (point.c.grid_id == run.c.grid_id) & (point.c.place == run.c.ordinal % points)
    reached = exists().where(mine, point.c.reached_at.is_not(None)).correlate(run)
    return move(connection, SPARE, where, reached, finished_at=now)


def close_grids(connection: Connection, grid_ids: Iterable[str], now: datetime) -> None:
    """Store the final state of each grid whose last run has just ended; the caller holds the grids' locks."""
    for grid_id in sorted(set(grid_ids)):
        mine = run.c.grid_id == grid_id
        is_open = exists().where(mine, run.c.state.in_(sorted(OPEN_STATES)))
        being_retried = exists().where(grid.c.id == grid_id, grid.c.revive_from.is_not(None))
        if connection.scalar(select(is_open | being_retried)):
            continue
        counted = select(run.c.state, func.count().label("runs")).where(mine).group_by(run.c.state)
        runs = {row.state: row.runs for row in connection.execute(counted)}
        state, latest = final_state(runs), recent(connection, [grid_id]).get(grid_id)
        reached = connection.scalar(select(func.count(point.c.reached_at)).where(point.c.grid_id == grid_id))
        ending = {"counts": runs, "rate_per_s": latest and latest.rate(), "reached": reached}
        values = {"state": state, "finished_at": now, "paused_at": None, "ending": ending}
        connection.execute(update(grid).where(grid.c.id == grid_id).values(**values))
        add_event(connection, grid_id, "grid_finished", now, state=state, runs=runs)


def final_state(runs: dict[str, int]) -> GridState:
    """State of a grid none of whose runs is open."""
    if runs.get(RunState.CANCELLED):
        return GridState.CANCELLED
    if runs.get(RunState.FAILED) or runs.get(RunState.QUARANTINED):
        return GridState.FAILED
    return GridState.DONE


def new_event(grid_id: str, kind: str, now: datetime, run_id: str | None = None, **detail: Any) -> dict[str, Any]:
    """A row of the outbox."""
    return {"grid_id": grid_id, "run_id": run_id, "kind": kind, "detail": detail, "created_at": now}


def add_events(connection: Connection, rows: Sequence[dict[str, Any]]) -> None:
    """Add to the outbox, in the transaction of the changes that the events report."""
    insert_rows(connection, event, rows)


def add_event(
    connection: Connection, grid_id: str, kind: str, now: datetime, run_id: str | None = None, **detail: Any
) -> None:
    """Add one event to the outbox, in the transaction of the change that it reports."""
    add_events(connection, [new_event(grid_id, kind, now, run_id, **detail)])
