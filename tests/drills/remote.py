"""Workers apart from the service: how much a second one adds."""

from __future__ import annotations

import os
from contextlib import closing, suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, ClassVar

import psutil
from sqlalchemy import select

from service.store.database import Database
from service.store.tables import attempt, run
from tests.drills.cluster import Cluster, kept_running
from tests.drills.drill import Drill, Ground, body
from tests.drills.installation import Installation, free_port, is_worker
from tests.drills.kills import stored_once
from tests.drills.report import Claim, Figure, Report
from tests.drills.stored import Records, records

DRAFT = {"profile": "draft"}
"""The engine's shortest analysis that is one: seconds and not minutes."""


@dataclass(frozen=True)
class Worked:
    """A grid that has been worked off: seconds from the first start to the last end, and where CPU seconds went.

    ``waited`` is for how long a worker, on average, was ready to go on and had no core to do it on.
    """

    took: float
    spent: dict[str, float]
    waited: float
    found: Records

    @property
    def with_a_core_each(self) -> float:
        """How long it would have taken had a core been free whenever a worker wanted one."""
        return self.took - self.waited


@dataclass(frozen=True)
class TwoWorkers(Drill):
    """The same grid with one remote worker and with two.

    The runs take CPU time, so the figure is only as good as the machine is free: hence also the figure without the time
    in which a worker waited for a core. ``engine`` more than zero takes so many runs of the engine itself instead, with
    the profile draft.
    """

    name: ClassVar[str] = "two-workers"
    what: ClassVar[str] = "40 runs of 1 s of CPU (or engine=12 of the engine) on one remote worker, then on two"
    claim: ClassVar[str] = "all done and stored once by either; >= 1.9 times the throughput"
    small: ClassVar[dict[str, object]] = {"runs": 8, "cpu_s": 0.3}

    runs: int = 40
    cpu_s: float = 1.0
    engine: int = 0

    def run(self, ground: Ground) -> Report:
        """Measure from the first start to the last end, as the attempts say."""
        runs = self.engine or self.runs
        one, two = (self._measure(ground, workers) for workers in (1, 2))
        ratio = one.took / two.took
        kind = "engine runs of HE0435, profile draft" if self.engine else f"runs of {self.cpu_s:g} s of CPU"
        return Report(
            self.name,
            f"{runs} {kind}, dask scheduler and workers apart, {os.cpu_count()} cores, {ground.backend}",
            (
                Figure("one worker", one.took, "s"),
                Figure("two workers", two.took, "s"),
                Figure("ratio", ratio),
                Figure("a worker waited for a core: one / each of two", f"{one.waited:.1f} / {two.waited:.1f}", "s"),
                Figure("ratio without these waits", one.with_a_core_each / two.with_a_core_each),
                *(
                    Figure(f"CPU of {name}: with one / with two", f"{one.spent[name]:.2f} / {spent:.2f}", "s")
                    for name, spent in two.spent.items()
                ),
                Figure("load of the machine at the end", os.getloadavg()[0]),
            ),
            (
                Claim(f"{runs} runs done, each stored once, by one worker", stored_once(one.found, runs).holds),
                Claim(f"{runs} runs done, each stored once, by two", stored_once(two.found, runs).holds),
                Claim("at least 1.9 times the throughput", ratio >= 1.9),
            ),
        )

    def _measure(self, ground: Ground, workers: int) -> Worked:
        folder = ground.folder / f"{workers}"
        folder.mkdir(parents=True)
        port = free_port()
        settings = {
            "HOSTLENS_TASK": "service.worker:execute" if self.engine else "tests.drills.tasks:busy",
            "HOSTLENS_DRILL_SLEEP": str(self.cpu_s),
            "HOSTLENS_SCHEDULER_ADDRESS": f"tcp://127.0.0.1:{port}",
            **ground.settings,
        }
        service = Installation(folder, settings)
        try:
            with kept_running(Cluster(service, workers, port)):
                service.wait_ready(workers, timeout_s=180)
                # One run each beforehand: the very first on a machine compiles the engine's kernels.
                warm = service.client.submit(self._request(workers, seed=5000 * workers))
                service.watch(warm.id, timeout_s=3600, every_s=1.0)
                spent, waited = _spent(service), _waited(service)
                grid = service.client.submit(self._request(self.engine or self.runs, seed=1000 * workers))
                service.watch(grid.id, timeout_s=3600, every_s=1.0)
                spent = {name: seconds - spent[name] for name, seconds in _spent(service).items()}
                waited = (_waited(service) - waited) / workers
                return Worked(working_time(service, grid.id), spent, waited, records(service, grid.id))
        finally:
            service.kill_all()

    def _request(self, runs: int, seed: int) -> dict[str, Any]:
        # Other seeds for the second time: where a database is given both grids lie in it.
        return {**body(runs, seed), "analysis": DRAFT} if self.engine else body(runs, seed)


def _spent(service: Installation) -> dict[str, float]:
    """CPU seconds so far of the processes by what they are."""
    spent = dict.fromkeys(("workers", "nannies", "scheduler", "dispatcher", "API", "supervisor"), 0.0)
    kinds = {
        ("service.dispatcher.dask_command", "worker"): "nannies",
        ("service.dispatcher.dask_command", "scheduler"): "scheduler",
        ("service.dispatcher",): "dispatcher",
        ("service.api",): "API",
        ("service", "serve"): "supervisor",
    }
    for process in service.processes():
        with suppress(psutil.Error):
            command = tuple(process.cmdline()[2:4])
            kind = "workers" if is_worker(process) else kinds.get(command, kinds.get(command[:1]))
            if kind is not None:
                times = process.cpu_times()
                spent[kind] += times.user + times.system
    return spent


def _waited(service: Installation) -> float:
    """Seconds so far in which the threads that compute were ready and had no core, as the kernel counts them."""
    total = 0.0
    for process in service.workers():
        threads = [path.read_text().split() for path in Path(f"/proc/{process.pid}/task").glob("*/schedstat")]
        # Of a worker's threads the one that computes has run for longest.
        total += max(((int(ran), int(waited)) for ran, waited, _ in threads), default=(0, 0))[1] / 1e9
    return total


def working_time(service: Installation, grid_id: str) -> float:
    """Seconds from the start of a grid's first attempt to the end of its last."""
    with closing(Database(service.database, pooled=False)) as database, database.read() as connection:
        wanted = select(attempt.c.started_at, attempt.c.ended_at).join(run, run.c.id == attempt.c.run_id)
        rows = connection.execute(wanted.where(run.c.grid_id == grid_id)).all()
    began: datetime = min(row.started_at for row in rows)
    ended: datetime = max(row.ended_at for row in rows)
    return (ended - began).total_seconds()
