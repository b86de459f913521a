"""Workers that fall silent, and workers that are started anew because they are old."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import ClassVar

import psutil

from tests.drills.drill import Drill, Ground, body
from tests.drills.installation import installation
from tests.drills.kills import identical, progress, stored_once, undisturbed
from tests.drills.report import Claim, Figure, Report
from tests.drills.stored import records


@dataclass(frozen=True)
class SilentWorker(Drill):
    """SIGSTOP where the deadline is far off: the scheduler misses the worker's heartbeat."""

    name: ClassVar[str] = "worker-ttl"
    what: ClassVar[str] = "SIGSTOP to a worker in the middle of a run, deadline of an hour, HOSTLENS_WORKER_TTL_S of 10"
    claim: ClassVar[str] = "noticed and started anew within 4 times that; the run is done elsewhere and stored once"
    small: ClassVar[dict[str, object]] = {"runs": 8}

    runs: int = 40
    ttl_s: float = 10.0
    sleep_s: float = 0.5

    def run(self, ground: Ground) -> Report:
        """Stop a worker that is at a run, and leave it so."""
        calm = undisturbed(self.runs)
        settings = {"HOSTLENS_DRILL_SLEEP": str(self.sleep_s), "HOSTLENS_WORKER_TTL_S": str(self.ttl_s)}
        with installation(ground.folder / "drill", {**settings, **ground.settings}) as service:
            service.wait_ready(2)
            grid = service.client.submit(body(self.runs))
            progress(service, grid.id, 1)
            victim = service.workers()[0]
            victim.suspend()
            stopped = time.monotonic()
            service.watch(grid.id)
            took = time.monotonic() - stopped
            service.wait_ready(2)
            back = time.monotonic() - stopped
            found = records(service, grid.id)
            ended = not victim.is_running() or victim.status() == psutil.STATUS_ZOMBIE
        return Report(
            self.name,
            f"{self.runs} runs of {self.sleep_s:g} s, two local workers, heard of at least every {self.ttl_s:g} s, "
            f"{ground.backend}",
            (
                Figure("stored", found.stored),
                Figure("attempts charged as worker_lost", found.outcomes.get("worker_lost", 0)),
                Figure("attempts given back", found.outcomes.get("forgotten", 0)),
                Figure("SIGSTOP to the end of the grid", took, "s"),
                Figure("SIGSTOP to two workers again", back, "s"),
            ),
            (
                stored_once(found, self.runs),
                identical(found, calm),
                Claim("the run was taken from the stopped worker", sum(found.outcomes.values()) > self.runs),
                Claim("the stopped worker was ended and another is there", ended),
                Claim(f"all within {4 * self.ttl_s:g} s of the last run's", max(took, back) < self._bound()),
            ),
        )

    def _bound(self) -> float:
        """The scheduler looks once in each time to live, and the nanny waits for an answer before it kills."""
        return 4 * self.ttl_s + self.runs * self.sleep_s
