"""Workers apart from the service: how much a second one adds."""

from __future__ import annotations

import os
from contextlib import closing
from dataclasses import dataclass
from datetime import datetime
from typing import Any, ClassVar

from sqlalchemy import select

from service.drills.cluster import Cluster, kept_running
from service.drills.drill import BODY, Drill, Ground, body
from service.drills.installation import Installation, free_port
from service.drills.kills import stored_once
from service.drills.records import Records, records
from service.drills.report import Claim, Figure, Report
from service.store.database import Database
from service.store.tables import attempt, run

SMALL_ANALYSIS = {"source_pixels": [12, 12], "subrays": 1, "walkers": 24, "max_steps": 200, "draws": 4}
"""An analysis that takes seconds and not minutes."""


@dataclass(frozen=True)
class TwoWorkers(Drill):
    """The same grid with one remote worker and with two.

    The runs take CPU time, so the figure is only as good as the machine is free. ``engine`` more than zero takes so
    many runs of the engine itself, with a small analysis, instead.
    """

    name: ClassVar[str] = "two-workers"
    what: ClassVar[str] = "40 runs of 1 s of CPU on one remote worker, then on two"
    claim: ClassVar[str] = "all done and stored once by either; >= 1.9 times the throughput"
    small: ClassVar[dict[str, object]] = {"runs": 8, "cpu_s": 0.3}

    runs: int = 40
    cpu_s: float = 1.0
    engine: int = 0

    def run(self, ground: Ground) -> Report:
        """Measure from the first start to the last end, as the attempts say."""
        runs = self.engine or self.runs
        (alone, by_one), (together, by_two) = (self._measure(ground, workers) for workers in (1, 2))
        ratio = alone / together
        kind = "engine runs with a small analysis" if self.engine else f"runs of {self.cpu_s:g} s of CPU"
        return Report(
            self.name,
            f"{runs} {kind}, dask scheduler and workers apart, {os.cpu_count()} cores, {ground.backend}",
            (
                Figure("one worker", alone, "s"),
                Figure("two workers", together, "s"),
                Figure("ratio", ratio),
                Figure("load of the machine at the end", os.getloadavg()[0]),
            ),
            (
                Claim(f"{runs} runs done, each stored once, by one worker", stored_once(by_one, runs).holds),
                Claim(f"{runs} runs done, each stored once, by two", stored_once(by_two, runs).holds),
                Claim("at least 1.9 times the throughput", ratio >= 1.9),
            ),
        )

    def _measure(self, ground: Ground, workers: int) -> tuple[float, Records]:
        folder = ground.folder / f"{workers}"
        folder.mkdir(parents=True)
        port = free_port()
        settings = {
            "HOSTLENS_TASK": "service.worker:execute" if self.engine else "service.drills.tasks:busy",
            "HOSTLENS_DRILL_SLEEP": str(self.cpu_s),
            "HOSTLENS_SCHEDULER_ADDRESS": f"tcp://127.0.0.1:{port}",
            **ground.settings,
        }
        service = Installation(folder, settings)
        try:
            with kept_running(Cluster(service, workers, port)):
                service.wait_ready(workers, timeout_s=180)
                grid = service.client.submit(self._request(workers))
                service.watch(grid.id, timeout_s=3600)
                return working_time(service, grid.id), records(service, grid.id)
        finally:
            service.kill_all()

    def _request(self, workers: int) -> dict[str, Any]:
        # Other seeds for the second time: where a database is given both grids lie in it.
        if not self.engine:
            return body(self.runs, seed=1000 * workers)
        return {**BODY, "replicates": self.engine, "analysis": SMALL_ANALYSIS, "seed": 0}


def working_time(service: Installation, grid_id: str) -> float:
    """Seconds from the start of a grid's first attempt to the end of its last."""
    with closing(Database(service.database, pooled=False)) as database, database.read() as connection:
        wanted = select(attempt.c.started_at, attempt.c.ended_at).join(run, run.c.id == attempt.c.run_id)
        rows = connection.execute(wanted.where(run.c.grid_id == grid_id)).all()
    began: datetime = min(row.started_at for row in rows)
    ended: datetime = max(row.ended_at for row in rows)
    return (ended - began).total_seconds()
