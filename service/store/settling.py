"""A grid's marks say where its runs belong, and pieces bring them there.

A cancelled grid has no run that waits, a paused one none that is queued, any other none that is paused; in one that is
retried, the runs from place ``revive_from`` on that ended without a result are queued again. A mark is set at once,
and from then on nothing of a cancelled or paused grid is claimed. Whoever comes by may go on with the pieces: the
request that set the mark does, and after a crash the dispatcher (:mod:`service.store.upkeep`).
"""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import ColumnElement, Connection, Select, exists, literal_column, select, true, update

from service.domain.states import CANCEL, PAUSE, RESUME, REVIVE, GridState, RunState, Transition
from service.store.leases import close_grids, spare_queued
from service.store.pieces import PIECE, places
from service.store.tables import grid, run
from service.store.transitions import move

# Spelt out: a database takes a partial index only where it sees that the condition implies it.
IS_OPEN = grid.c.state == literal_column(f"'{GridState.QUEUED}'")
_CANCELLED, _PAUSED = grid.c.cancelled_at.is_not(None), grid.c.paused_at.is_not(None)


def held_grids(other_engine: ColumnElement[bool] | None = None) -> Select[tuple[str]]:
    """Grids of which nothing may be claimed, though runs may be queued still: few, since only open ones count."""
    held = (grid.c.storing == true()) | _CANCELLED | _PAUSED
    return select(grid.c.id).where(IS_OPEN, held if other_engine is None else held | other_engine)


def settle(connection: Connection, grid_id: str, now: datetime) -> bool:
    """Bring one piece of a grid's runs to where its marks want them; the caller holds the grid's lock.

    Returns whether there may be more.
    """
    marks = connection.execute(
        select(grid.c.state, grid.c.n_runs, grid.c.cancelled_at, grid.c.paused_at, grid.c.revive_from).where(
            grid.c.id == grid_id
        )
    ).one()
    if marks.state != GridState.QUEUED:
        return False
    if marks.revive_from is not None:
        revive_runs(connection, places(grid_id, marks.revive_from), now)
        if marks.paused_at is not None:
            move(connection, PAUSE, places(grid_id, marks.revive_from))
        after = marks.revive_from + PIECE
        more = bool(after < marks.n_runs)
        connection.execute(update(grid).where(grid.c.id == grid_id).values(revive_from=after if more else None))
    else:
        more = _move(connection, grid_id, _wanted(marks.cancelled_at, marks.paused_at), now)
    if not more:
        close_grids(connection, [grid_id], now)
    return more


def _wanted(cancelled_at: datetime | None, paused_at: datetime | None) -> Transition:
    return CANCEL if cancelled_at is not None else RESUME if paused_at is None else PAUSE


def revive_runs(connection: Connection, where: ColumnElement[bool], now: datetime) -> list[str]:
    """Queue runs again that ended without a result, as if they had not been tried; the caller holds the grid's lock.

    Those whose point has been reached since are not needed any more.
    """
    fresh = {"not_before": now, "charged_from": run.c.attempt, "finished_at": None, "suspect": False}
    revived = move(connection, REVIVE, where, error_code=None, error_detail=None, **fresh)
    spare_queued(connection, where, now)
    return revived


def _move(connection: Connection, grid_id: str, transition: Transition, now: datetime) -> bool:
    first = _first_place(connection, grid_id, transition)
    if first is None:
        return False
    values = {"finished_at": now} if transition is CANCEL else {}
    move(connection, transition, places(grid_id, first), **values)
    return _first_place(connection, grid_id, transition) is not None


def _first_place(connection: Connection, grid_id: str, transition: Transition) -> int | None:
    """Place of a grid's first run that a transition is allowed for."""
    found: list[int] = []
    for state in transition.sources:
        # State by state, each is one look into the index.
        mine = (run.c.grid_id == grid_id) & (run.c.state == state)
        found += connection.scalars(select(run.c.ordinal).where(mine).order_by(run.c.ordinal).limit(1))
    return min(found, default=None)


def unsettled() -> Select[tuple[str]]:
    """Grids some of whose runs are not where the marks want them."""

    def has(*states: RunState) -> ColumnElement[bool]:
        return exists().where(run.c.grid_id == grid.c.id, run.c.state.in_(states))

    return select(grid.c.id).where(
        IS_OPEN,
        grid.c.storing != true(),
        grid.c.revive_from.is_not(None)
        | (_CANCELLED & has(RunState.QUEUED, RunState.PAUSED))
        | (~_CANCELLED & _PAUSED & has(RunState.QUEUED))
        | (~_CANCELLED & ~_PAUSED & has(RunState.PAUSED)),
    )
