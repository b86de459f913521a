"""What users do to a service: cancel a large grid, submit the same one fifty times at once."""

from __future__ import annotations

import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from threading import Barrier
from typing import ClassVar

import httpx

from tests.drills.drill import Drill, Ground, body
from tests.drills.installation import eventually, installation
from tests.drills.report import Claim, Figure, Report


@dataclass(frozen=True)
class Cancel(Drill):
    """A large grid of long runs is cancelled."""

    name: ClassVar[str] = "cancel"
    what: ClassVar[str] = "cancel of a grid of 10,000 runs, two of them running"
    claim: ClassVar[str] = "queued runs gone within 1 s, running ones within 15 s, workers free again"
    small: ClassVar[dict[str, object]] = {"runs": 2000}

    runs: int = 10_000

    def run(self, ground: Ground) -> Report:
        """Cancel while two runs are under way that would take ten minutes."""
        settings = {"HOSTLENS_DRILL_SLEEP": "600", **ground.settings}
        with installation(ground.folder / "drill", settings) as service:
            service.wait_ready(2)
            grid = service.client.submit(body(self.runs))
            eventually(lambda: service.client.status(grid.id).counts.leased == 2, what="two runs in flight")
            began = time.monotonic()
            answer = service.client.cancel(grid.id)
            queued = time.monotonic() - began
            ended = service.watch(grid.id, timeout_s=60)
            running = time.monotonic() - began
            service.wait_ready(2)
            free = time.monotonic() - began
        return Report(
            self.name,
            f"{self.runs} runs of 600 s, two local workers, {ground.backend}",
            (
                Figure("cancelled by the request itself", answer.counts.cancelled),
                Figure("queued runs gone after", queued, "s"),
                Figure("running ones after", running, "s"),
                Figure("two workers free after", free, "s"),
            ),
            (
                Claim("queued runs gone within 1 s", answer.counts.queued == 0 and queued < 1.0),
                Claim("running runs gone within 15 s", running < 15.0),
                Claim("every run cancelled", ended.counts.cancelled == self.runs),
            ),
        )


@dataclass(frozen=True)
class Idempotency(Drill):
    """The same submission many times at once."""

    name: ClassVar[str] = "idempotency"
    what: ClassVar[str] = "50 identical submissions at once with one Idempotency-Key"
    claim: ClassVar[str] = "one grid; every answer is it"

    clients: int = 50
    runs: int = 100

    def run(self, ground: Ground) -> Report:
        """Let all clients go at the same moment."""
        start = Barrier(self.clients)
        settings = {"HOSTLENS_DRILL_SLEEP": "600", **ground.settings}
        with installation(ground.folder / "drill", settings) as service:
            address = f"http://127.0.0.1:{service.port}/v1/grids"

            def submit(_: int) -> tuple[int, str, str, float]:
                with httpx.Client(timeout=60.0, trust_env=False) as client:
                    start.wait(30)
                    began = time.monotonic()
                    answer = client.post(address, json=body(self.runs), headers={"Idempotency-Key": "drill"})
                    took = time.monotonic() - began
                made = answer.json().get("id", "")
                return answer.status_code, made, answer.headers.get("Idempotency-Replayed", ""), took

            with ThreadPoolExecutor(self.clients) as pool:
                answers = list(pool.map(submit, range(self.clients)))
            grids = service.client.grids(1000).items
        statuses = Counter(answer[0] for answer in answers)
        return Report(
            self.name,
            f"{self.clients} clients, a grid of {self.runs} runs, {ground.backend}",
            (
                Figure("grids", len(grids)),
                Figure("answers 202", statuses[202]),
                Figure("of them replayed", sum(answer[2] == "true" for answer in answers)),
                Figure("slowest answer", max(answer[3] for answer in answers), "s"),
            ),
            (
                Claim("one grid", len(grids) == 1 and {answer[1] for answer in answers} == {grids[0].id}),
                Claim("every answer is 202", statuses == {202: self.clients}),
                Claim("all but one say that they are replays", [a[2] for a in answers].count("false") == 1),
            ),
        )
