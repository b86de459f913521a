"""States of runs and grids, and the one table of what may become what."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sqlalchemy import ColumnElement, Connection, Update


class RunState(StrEnum):
    """Where a run stands."""

    QUEUED = "queued"
    PAUSED = "paused"
    LEASED = "leased"
    DONE = "done"
    FAILED = "failed"
    QUARANTINED = "quarantined"
    CANCELLED = "cancelled"


class GridState(StrEnum):
    """Where a grid stands.

    The first three are told apart by its runs and by whether somebody paused it, the others are stored with the end
    of its last run.
    """

    QUEUED = "queued"
    RUNNING = "running"
    PAUSED = "paused"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"


OPEN_STATES = frozenset({RunState.QUEUED, RunState.PAUSED, RunState.LEASED})
TERMINAL_STATES = frozenset(RunState) - OPEN_STATES


@dataclass(frozen=True)
class Transition:
    """A change of state: allowed from ``sources`` only."""

    sources: frozenset[RunState]
    target: RunState


def _from(*sources: RunState, to: RunState) -> Transition:
    return Transition(frozenset(sources), to)


CLAIM = _from(RunState.QUEUED, to=RunState.LEASED)
FINISH = _from(RunState.LEASED, to=RunState.DONE)
FAIL = _from(RunState.LEASED, to=RunState.FAILED)
QUARANTINE = _from(RunState.LEASED, to=RunState.QUARANTINED)
REQUEUE = _from(RunState.LEASED, to=RunState.QUEUED)
PAUSE = _from(RunState.QUEUED, to=RunState.PAUSED)
RESUME = _from(RunState.PAUSED, to=RunState.QUEUED)
CANCEL = _from(RunState.QUEUED, RunState.PAUSED, to=RunState.CANCELLED)
CANCEL_RUNNING = _from(RunState.LEASED, to=RunState.CANCELLED)
REVIVE = _from(RunState.FAILED, RunState.QUARANTINED, RunState.CANCELLED, to=RunState.QUEUED)

TRANSITIONS = {
    "claim": CLAIM,
    "finish": FINISH,
    "fail": FAIL,
    "quarantine": QUARANTINE,
    "requeue": REQUEUE,
    "pause": PAUSE,
    "resume": RESUME,
    "cancel": CANCEL,
    "cancel_running": CANCEL_RUNNING,
    "revive": REVIVE,
}


def move(connection: Connection, transition: Transition, *where: ColumnElement[bool], **values: Any) -> list[str]:
    """Carry out a transition on the runs that ``where`` picks and return the ids of those that it changed."""
    from service.store.tables import run  # noqa: PLC0415 - as below

    return list(connection.scalars(moving(transition, *where, **values).returning(run.c.id)))


def moving(transition: Transition, *where: ColumnElement[bool], **values: Any) -> Update:
    """What carries out a transition on the runs that ``where`` picks.

    Runs in a state that the transition does not allow are left alone: no row, no change. This is the only statement
    of the service that changes a run's state. The token is cleared unless ``values`` sets one, so a lease ends with
    the state that it belonged to.
    """
    # A client of the API needs the names of the states, and SQLAlchemy takes longer to load than all of the client.
    from sqlalchemy import update  # noqa: PLC0415

    from service.store.tables import run  # noqa: PLC0415

    return (
        update(run)
        .where(run.c.state.in_(sorted(transition.sources)), *where)
        .values(state=transition.target, **{"token": None, "generation": None, **values})
    )
