"""Workers that hang, dispatchers that compete, runs that kill."""

from __future__ import annotations

import signal
import time
from collections import Counter
from contextlib import closing, suppress
from dataclasses import dataclass
from typing import ClassVar

import psutil

from service.store.database import Database
from service.store.leadership import Leadership, LeaderView
from service.store.migrate import upgrade
from tests.drills.drill import Drill, Ground, body
from tests.drills.installation import Installation, eventually, installation
from tests.drills.kills import identical, progress, stored_once, undisturbed
from tests.drills.report import Claim, Figure, Report
from tests.drills.stored import records
from tests.drills.tasks import POISON_EVERY


@dataclass(frozen=True)
class StoppedWorker(Drill):
    """SIGSTOP: a worker that is there and does nothing."""

    name: ClassVar[str] = "sigstop"
    what: ClassVar[str] = "SIGSTOP to a worker in the middle of a run, deadline of 6 s"
    claim: ClassVar[str] = "the run is done elsewhere and stored once; what the worker says later is dropped"
    small: ClassVar[dict[str, object]] = {"runs": 8}

    runs: int = 40
    deadline_s: float = 6.0
    sleep_s: float = 0.5

    def run(self, ground: Ground) -> Report:
        """Stop a worker that is at a run; wake it when the grid has ended, if it is still there."""
        calm = undisturbed(self.runs)
        settings = {"HOSTLENS_DRILL_SLEEP": str(self.sleep_s), "HOSTLENS_DEADLINE_S": str(self.deadline_s)}
        with installation(ground.folder / "drill", {**settings, **ground.settings}) as service:
            service.wait_ready(2)
            grid = service.client.submit(body(self.runs))
            progress(service, grid.id, 1)
            victim = service.workers()[0]
            victim.suspend()
            stopped = time.monotonic()
            service.watch(grid.id)
            took = time.monotonic() - stopped
            woken = False
            with suppress(psutil.Error):
                victim.resume()
                woken = victim.status() != psutil.STATUS_ZOMBIE
            service.wait_ready(2)
            back = time.monotonic() - stopped
            found = records(service, grid.id)
        return Report(
            self.name,
            f"{self.runs} runs of {self.sleep_s:g} s, two local workers, deadline {self.deadline_s:g} s, "
            f"{ground.backend}",
            (
                Figure("stored", found.stored),
                Figure("attempts past the deadline", found.outcomes.get("deadline", 0)),
                Figure("results that came late and were dropped", found.late),
                Figure("SIGSTOP to the end of the grid", took, "s"),
                Figure("SIGSTOP to two workers again", back, "s"),
                Figure("the stopped worker lived to the end", "yes" if woken else "no"),
            ),
            (
                stored_once(found, self.runs),
                identical(found, calm),
                Claim("the run was taken from the stopped worker", found.outcomes.get("deadline", 0) >= 1),
            ),
        )


@dataclass(frozen=True)
class TwoDispatchers(Drill):
    """Two dispatchers at once, and then the leader dies."""

    name: ClassVar[str] = "two-dispatchers"
    what: ClassVar[str] = "two dispatchers at once on one database; kill -9 of the leader in the middle of 120 runs"
    claim: ClassVar[str] = "one leads, each run is executed once until the kill; the standby takes over"
    small: ClassVar[dict[str, object]] = {"runs": 40}

    runs: int = 120
    sleep_s: float = 0.2

    def run(self, ground: Ground) -> Report:
        """Start both without a supervisor, so that nobody brings the dead one back."""
        calm = undisturbed(self.runs)
        folder = ground.folder / "drill"
        (folder / "data").mkdir(parents=True)
        upgrade(ground.database_url or f"sqlite:///{folder / 'data' / 'hostlens.sqlite'}")
        commands = (("service.api",), ("service.dispatcher",), ("service.dispatcher",))
        settings = {"HOSTLENS_DRILL_SLEEP": str(self.sleep_s), **ground.settings}
        with installation(folder, settings, commands=commands) as service:
            grid = service.client.submit(body(self.runs))
            progress(service, grid.id, self.runs // 3)
            first = _leader(service)
            before = Counter(service.executed())
            psutil.Process(int(first.holder.split("|")[1])).send_signal(signal.SIGKILL)
            killed = time.monotonic()
            eventually(lambda: _leader(service).generation > first.generation, what="a new leader")
            leads = time.monotonic() - killed
            done = service.client.status(grid.id).counts.done
            progress(service, grid.id, done + 1)
            resumed = time.monotonic() - killed
            service.watch(grid.id)
            found, executed = records(service, grid.id), Counter(service.executed())
        repeats = executed.total() - len(executed)
        return Report(
            self.name,
            f"{self.runs} runs of {self.sleep_s:g} s, two dispatchers with two workers each, {ground.backend}",
            (
                Figure("stored", found.stored),
                Figure("executions before the kill, most of one run", max(before.values())),
                Figure("repeats after it", repeats),
                Figure("kill to new leader", leads, "s"),
                Figure("kill to next result", resumed, "s"),
            ),
            (
                stored_once(found, self.runs),
                identical(found, calm),
                Claim("each run executed once while both were there", max(before.values()) == 1),
                # Of each worker what it is at, and what it has answered and nobody has stored yet.
                Claim("at most the work in flight is done again", repeats <= 4),
            ),
        )


def _leader(service: Installation) -> LeaderView:
    with closing(Database(service.database, pooled=False)) as database:
        return eventually(Leadership(database).view, what="a leader") or _never()


def _never() -> LeaderView:
    raise AssertionError("eventually gives what is true, or raises")


@dataclass(frozen=True)
class Poison(Drill):
    """Runs that kill whatever worker they are on."""

    name: ClassVar[str] = "poison"
    what: ClassVar[str] = "3 runs among 120 that kill their worker every time"
    claim: ClassVar[str] = "exactly these 3 quarantined, 117 done, no innocent charged"
    small: ClassVar[dict[str, object]] = {"runs": 40}

    runs: int = 120
    sleep_s: float = 0.2

    def run(self, ground: Ground) -> Report:
        """One run in forty is poison, by its seed."""
        settings = {
            "HOSTLENS_TASK": "tests.drills.tasks:poisonous",
            "HOSTLENS_DRILL_SLEEP": str(self.sleep_s),
            "HOSTLENS_RETRY_DELAY_S": "0.2",
        }
        guilty = {place for place in range(self.runs) if place % POISON_EVERY == 1}
        with installation(ground.folder / "drill", {**settings, **ground.settings}) as service:
            service.wait_ready(2)
            began = time.monotonic()
            grid = service.client.submit(body(self.runs))
            service.watch(grid.id)
            took = time.monotonic() - began
            quarantined = {run.ordinal for run in service.client.runs(grid.id) if run.state == "quarantined"}
            found = records(service, grid.id)
        charged = {
            place
            for place, ends in found.charged.items()
            if any(ends[kind] for kind in ("worker_lost", "error", "deadline"))
        }
        return Report(
            self.name,
            f"{self.runs} runs of {self.sleep_s:g} s, {len(guilty)} of them poison, two local workers, "
            f"{ground.backend}",
            (
                Figure("quarantined", len(quarantined)),
                Figure("done", found.states.get("done", 0)),
                Figure("attempts charged", found.outcomes.get("worker_lost", 0)),
                Figure("attempts of suspects, uncharged", found.outcomes.get("suspected", 0)),
                Figure("wall time", took, "s"),
            ),
            (
                Claim(f"exactly the {len(guilty)} poison runs quarantined", quarantined == guilty),
                Claim("all others done", found.stored == self.runs - len(guilty)),
                Claim("no innocent charged", charged == guilty),
            ),
        )
