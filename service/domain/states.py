"""States of runs and grids, and the one table of what may become what."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class RunState(StrEnum):
    """Where a run stands."""

    QUEUED = "queued"
    PAUSED = "paused"
    LEASED = "leased"
    DONE = "done"
    FAILED = "failed"
    QUARANTINED = "quarantined"
    CANCELLED = "cancelled"
    NOT_NEEDED = "not_needed"
    """Its point's mean bias is known well enough without it."""


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
SPARE = _from(RunState.QUEUED, RunState.PAUSED, to=RunState.NOT_NEEDED)
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
    "spare": SPARE,
    "revive": REVIVE,
}
