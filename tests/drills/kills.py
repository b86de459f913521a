"""Processes killed with -9: the dispatcher, workers, the scheduler."""

from __future__ import annotations

import os
import signal
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event, Thread
from typing import Any, ClassVar

import psutil

from tests.drills.cluster import Cluster, kept_running
from tests.drills.drill import Drill, Ground, body
from tests.drills.installation import Installation, eventually, free_port, installation
from tests.drills.report import Claim, Figure, Report, quantile
from tests.drills.stored import Records, records

Table = list[tuple[Any, ...]]
_SMALL = 40


def undisturbed(runs: int) -> Table:
    """The results of a grid that nothing happened to, from a service of its own on SQLite.

    Small drills in one process share one: the first runs of a grid are the same in a longer one.
    """
    return _undisturbed(max(runs, _SMALL))[:runs]


@cache
def _undisturbed(runs: int) -> Table:
    folder = TemporaryDirectory(prefix="hostlens-undisturbed-", ignore_cleanup_errors=True)
    with folder, installation(Path(folder.name), {"HOSTLENS_DRILL_SLEEP": "0"}) as calm:
        grid = calm.client.submit(body(runs))
        calm.watch(grid.id)
        return records(calm, grid.id).results


def stored_once(found: Records, runs: int) -> Claim:
    """The claim that most drills end with."""
    return Claim(f"{runs} runs done, each stored once", found.states == {"done": runs} and found.stored == runs)


def identical(found: Records, calm: Table) -> Claim:
    """That a disturbed grid's table is an undisturbed one's."""
    return Claim("table identical to an undisturbed grid's", found.results == calm)


def progress(service: Installation, grid_id: str, least: int) -> int:
    """Wait until so many runs of a grid are done; how many are."""

    def look() -> int:
        done = service.client.status(grid_id).counts.done
        return done if done >= least else 0

    return eventually(look, what=f"the result number {least}")


@dataclass(frozen=True)
class DispatcherKills(Drill):
    """kill -9 of the dispatcher, again and again, while a grid is under way."""

    name: ClassVar[str] = "dispatcher"
    what: ClassVar[str] = "kill -9 of the dispatcher, 20 times in a grid of 384 short runs"
    claim: ClassVar[str] = "384 stored, each once; the table is an undisturbed grid's"
    small: ClassVar[dict[str, object]] = {"runs": 40, "kills": 2}

    runs: int = 384
    kills: int = 20
    sleep_s: float = 0.2

    def run(self, ground: Ground) -> Report:
        """Kill whenever another share of the grid is done, so that every kill finds runs in flight."""
        calm = undisturbed(self.runs)
        gaps = []
        settings = {"HOSTLENS_DRILL_SLEEP": str(self.sleep_s), **ground.settings}
        with installation(ground.folder / "drill", settings) as service:
            began = time.monotonic()
            grid = service.client.submit(body(self.runs))
            for number in range(self.kills):
                least = (number * self.runs) // (self.kills + 1) + 1
                done = progress(service, grid.id, least)
                killed = self._kill(service)
                progress(service, grid.id, done + 1)
                gaps.append(time.monotonic() - killed)
            service.watch(grid.id)
            took = time.monotonic() - began
            found, executed = records(service, grid.id), Counter(service.executed())
            processes = len(service.processes())
            code = service.end()
            left = len(service.processes())
        repeats = executed.total() - len(executed)
        given_back = found.outcomes.get("dispatcher_lost", 0)
        return Report(
            self.name,
            f"{self.runs} runs of {self.sleep_s:g} s, two local workers, {ground.backend}",
            (
                Figure("kills", self.kills),
                Figure("stored", found.stored),
                Figure("executions that ended", executed.total()),
                Figure("repeats", repeats),
                Figure("attempts given back", given_back),
                Figure("kill to next result, median", quantile(gaps, 0.5), "s"),
                Figure("kill to next result, longest", max(gaps), "s"),
                Figure("wall time", took, "s"),
                Figure("processes at the end", processes),
            ),
            (
                stored_once(found, self.runs),
                identical(found, calm),
                # Two in flight, and two that were claimed for when these are done.
                Claim(
                    "four runs at most go back at a kill", found.outcomes.get("dispatcher_lost", 0) <= 4 * self.kills
                ),
                Claim("at most the work in flight is done again", repeats <= 2 * self.kills),
                Claim("the service then ends in order and leaves no process", code == 0 and left == 0),
            ),
        )

    @staticmethod
    def _kill(service: Installation) -> float:
        found = eventually(lambda: service.child("service.dispatcher"), what="a dispatcher")
        if found is not None:
            found.kill()
        return time.monotonic()


@dataclass(frozen=True)
class WorkerKills(Drill):
    """kill -9 of a worker every two seconds.

    Only while another is there that computes, or with short intervals none would ever get ready. The runs are short
    against the interval: nobody can tell a run whose worker is killed three times from one that kills it.
    """

    name: ClassVar[str] = "worker"
    what: ClassVar[str] = "kill -9 of one of four workers every 2 s, in a grid of 600 runs of 0.2 s"
    claim: ClassVar[str] = "all done and stored once; no run, innocent all, quarantined"
    small: ClassVar[dict[str, object]] = {"runs": 60}

    runs: int = 600
    every_s: float = 2.0
    sleep_s: float = 0.2
    workers: int = 4
    most: int | None = None
    """Kills at most; where None, as long as the grid lasts."""

    def run(self, ground: Ground) -> Report:
        """Kill one worker after the other, oldest first, until the grid has ended."""
        calm = undisturbed(self.runs)
        kills: list[int] = []
        stop = Event()
        settings = {
            "HOSTLENS_DRILL_SLEEP": str(self.sleep_s),
            "HOSTLENS_WORKERS": str(self.workers),
            **ground.settings,
        }
        with installation(ground.folder / "drill", settings) as service:
            service.wait_ready(self.workers)
            grid = service.client.submit(body(self.runs))

            def kill() -> None:
                while len(kills) != self.most and not stop.wait(self.every_s):
                    while (ready := service.readiness()) is None or ready.workers < 2:
                        if stop.wait(0.1):
                            return
                    for worker in sorted(service.workers(), key=lambda found: found.pid)[:1]:
                        with suppress(psutil.Error):
                            worker.kill()
                            kills.append(worker.pid)

            killer = Thread(target=kill, name="killer")
            began = time.monotonic()
            killer.start()
            try:
                service.watch(grid.id)
            finally:
                stop.set()
                killer.join()
            took = time.monotonic() - began
            found = records(service, grid.id)
        worst = max((ends["worker_lost"] for ends in found.charged.values()), default=0)
        return Report(
            self.name,
            f"{self.runs} runs of {self.sleep_s:g} s, {self.workers} local workers, "
            f"one killed every {self.every_s:g} s, {ground.backend}",
            (
                Figure("kills", len(kills)),
                Figure("seconds a kill", took / max(len(kills), 1), "s"),
                Figure("stored", found.stored),
                Figure("attempts charged as worker_lost", found.outcomes.get("worker_lost", 0)),
                Figure("most charges of one run", worst),
                Figure("wall time", took, "s"),
            ),
            (
                stored_once(found, self.runs),
                identical(found, calm),
                Claim("no innocent run quarantined", not found.states.get("quarantined")),
                Claim("workers were killed", bool(kills)),
            ),
        )


@dataclass(frozen=True)
class SchedulerKills(Drill):
    """kill -9 of a scheduler that runs apart from the service."""

    name: ClassVar[str] = "scheduler"
    what: ClassVar[str] = "kill -9 of a remote Dask scheduler, 5 times in a grid of 120 runs"
    claim: ClassVar[str] = "all done and stored once, nobody charged"
    small: ClassVar[dict[str, object]] = {"runs": 20, "kills": 1}

    runs: int = 120
    kills: int = 5
    sleep_s: float = 0.2

    def run(self, ground: Ground) -> Report:
        """Kill the scheduler whenever another share of the grid is done; it and its workers are started again."""
        calm = undisturbed(self.runs)
        gaps = []
        folder = ground.folder / "drill"
        port = free_port()
        settings = {
            "HOSTLENS_DRILL_SLEEP": str(self.sleep_s),
            "HOSTLENS_SCHEDULER_ADDRESS": f"tcp://127.0.0.1:{port}",
            **ground.settings,
        }
        folder.mkdir(parents=True)
        service = Installation(folder, settings)
        try:
            with kept_running(Cluster(service, 2, port)) as running:
                service.wait_ready(2)
                began = time.monotonic()
                grid = service.client.submit(body(self.runs))
                for number in range(self.kills):
                    least = (number * self.runs) // (self.kills + 1) + 1
                    done = progress(service, grid.id, least)
                    os.kill(running[0].pid, signal.SIGKILL)
                    killed = time.monotonic()
                    progress(service, grid.id, done + 3)
                    gaps.append(time.monotonic() - killed)
                service.watch(grid.id)
                took = time.monotonic() - began
                found = records(service, grid.id)
        finally:
            service.kill_all()
        blamed = sum(found.outcomes.get(outcome, 0) for outcome in ("worker_lost", "error", "deadline"))
        return Report(
            self.name,
            f"{self.runs} runs of {self.sleep_s:g} s, dask scheduler and two dask workers apart, {ground.backend}",
            (
                Figure("kills", self.kills),
                Figure("stored", found.stored),
                Figure("attempts given back", sum(found.outcomes.values()) - found.outcomes["done"] - blamed),
                Figure("attempts charged", blamed),
                Figure("kill to next results, median", quantile(gaps, 0.5), "s"),
                Figure("kill to next results, longest", max(gaps), "s"),
                Figure("wall time", took, "s"),
            ),
            (stored_once(found, self.runs), identical(found, calm), Claim("nobody charged", blamed == 0)),
        )
