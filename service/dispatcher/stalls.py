"""Workers that are alive and take no work, and whose memory it was.

Dask itself waits for them: it pauses a worker for ever at 80 % of its memory limit, and neither misses a task that was
sent and is never started nor a greeting that is never answered.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from service.worker.answers import RUNNING

LOOK_S = 2.0
GREETING_S, BUSY_GREETING_S = 40.0, 600.0
"""How long a greeting may take where the worker's processor idles, and where it works: cold kernels take minutes on a
machine that is busy with other things."""
_BUSY_PERCENT = 20.0
_PAUSE_FRACTION = 0.8


@dataclass
class WorkerMemory:
    """Memory of one worker process [bytes]: ``fresh`` when it was greeted, ``latest`` when it had ended its last run.

    ``latest`` is None where nobody knows: then nobody is to blame.
    """

    pid: int | None = None
    fresh: int = 0
    latest: int | None = 0
    limit: int | None = None
    pause_fraction: float | None = None

    def would_fill_a_fresh_one(self, reached: int) -> bool:
        """Whether a worker that has reached so much would be paused without what earlier runs have left behind.

        Then the run that it is at needs more than there is; else nobody is to blame, and it has another worker.
        """
        if self.limit is None or self.latest is None:
            return False
        left_behind = max(self.latest - self.fresh, 0)
        return reached - left_behind > (self.pause_fraction or _PAUSE_FRACTION) * self.limit


@dataclass(frozen=True)
class Condition:
    """What the scheduler knows of a worker.

    ``heard`` changes with each heartbeat; ``executing`` counts tasks (None: not told, as before the greeting).
    """

    status: str
    heard: float
    executing: int | None
    cpu: float
    memory: int

    @property
    def takes_work(self) -> bool:
        """Whether it would start a run."""
        return self.status == "running"


def read_conditions(identity: Any) -> dict[str, Condition]:
    """Conditions of all workers from the scheduler's account of itself; what is not as expected is left out.

    Most of it comes from the workers, and may be anything.
    """
    found = {}
    workers = identity.get("workers") if isinstance(identity, dict) else None
    for address, told in (workers if isinstance(workers, dict) else {}).items():
        try:
            metrics = told["metrics"]
            running = metrics.get(RUNNING)
            executing = None if running is None else int(running)
            cpu, memory = float(metrics.get("cpu", 0.0)), int(metrics.get("memory", 0))
            found[str(address)] = Condition(str(told["status"]), float(told["last_seen"]), executing, cpu, memory)
        except (AttributeError, KeyError, TypeError, ValueError, OverflowError):
            continue
    return found


@dataclass(frozen=True)
class Stall:
    """A worker that is to be replaced: why, whether it had begun what it was given, and its memory [bytes]."""

    address: str
    reason: str
    begun: bool
    memory: int


REASONS = ("paused", "closing", "not_started", "silent", "greeting")


@dataclass
class _Watched:
    heard: float
    silent_s: float = 0.0
    unfit_s: float = 0.0
    idle_s: float = 0.0


class Stalls:
    """Finds the workers that take no work.

    Time is counted in looks: while this process or the scheduler stood still, nobody waited for a worker. For
    ``patience_s`` one may take no work: Dask pauses and closes workers for moments, and a run may be about to end.
    """

    def __init__(self, silent_s: float, patience_s: float) -> None:
        self._silent_s, self._patience_s = silent_s, patience_s
        self._watched: dict[str, _Watched] = {}
        self._looked: float | None = None

    def look(self, conditions: Mapping[str, Condition], busy: Mapping[str, float], now: float) -> list[Stall]:
        """Workers to replace; ``busy`` says since when each that was given runs has had the oldest of them."""
        passed = 0.0 if self._looked is None else min(now - self._looked, 2 * LOOK_S)
        self._looked = now
        self._watched = {address: watched for address, watched in self._watched.items() if address in conditions}
        stalls = []
        for address, condition in conditions.items():
            watched = self._watched.setdefault(address, _Watched(condition.heard))
            reason = self._judge(watched, condition, passed, now - busy.get(address, now))
            if reason is not None:
                begun = address in busy and condition.executing != 0
                stalls.append(Stall(address, reason, begun, condition.memory))
                del self._watched[address]
        return stalls

    def _judge(self, watched: _Watched, condition: Condition, passed: float, given_s: float) -> str | None:
        """Why a worker is to be replaced, None where it is not."""
        heard, unheard_s = condition.heard != watched.heard, watched.silent_s + passed
        watched.heard = condition.heard
        watched.silent_s = 0.0 if heard else unheard_s
        closing = not condition.takes_work and condition.status != "paused"
        # One that closes may end what it is at. What it is at when it is paused may end it.
        unfit = not condition.takes_work and not (closing and condition.executing)
        watched.unfit_s = watched.unfit_s + passed if unfit else 0.0
        # Only a heartbeat tells that nothing is executed: a run that lets no other thread work keeps it from beating.
        idle = condition.executing == 0 and given_s > 0.0
        watched.idle_s = 0.0 if not idle else watched.idle_s + (unheard_s if heard else 0.0)
        if watched.unfit_s >= self._patience_s:
            return "closing" if closing else "paused"
        if min(watched.idle_s, given_s) >= self._patience_s:
            return "not_started"
        return "silent" if watched.silent_s >= self._silent_s else None


@dataclass
class Asked:
    """A greeting that a worker has not answered yet; seconds counted in looks."""

    future: Any
    since: float
    idle_s: float = 0.0

    def has_stalled(self, condition: Condition | None, passed: float, now: float) -> bool:
        """Whether it is no longer waited for."""
        if condition is None or condition.cpu < _BUSY_PERCENT:
            self.idle_s += passed
        return self.idle_s >= GREETING_S or now - self.since >= BUSY_GREETING_S
