"""Runs that fail in every way, in real processes: a grid of them, and what API, database, metrics and logs say."""

from __future__ import annotations

import json
import urllib.request
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import pytest
from sqlalchemy import select

from service.domain.views import GridView, RunDetail
from service.store.database import Database
from service.store.tables import attempt
from tests.service.plans import body
from tests.service.service_process import free_port, serving
from tests.service.test_metrics import Samples

CHARGED = ["done", "error", "worker_lost"]
"""What was given back without charge, its answer lost with a worker that the next run killed, does not count."""


@dataclass
class Told:
    """All that a service says of a grid whose runs each do as their place says, after its end."""

    grid: GridView
    runs: list[RunDetail]
    tried: Counter[str]
    dispatcher: Samples
    api: Samples
    code: int
    lines: list[dict[str, Any]] = field(default_factory=list)

    def found(self, **wanted: Any) -> list[dict[str, Any]]:
        """Lines of the log that have all of these."""
        return [line for line in self.lines if wanted.items() <= line.items()]


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> Told:
    port = free_port()
    settings = {
        "HOSTLENS_TASK": "tests.service.tasks:moody",
        "HOSTLENS_RETRY_DELAY_S": "0.1",
        "HOSTLENS_DRILL_SLEEP": "0",
        "HOSTLENS_METRICS_PORT": str(port),
        "HOSTLENS_LOG_FORMAT": "json",
    }

    def scrape(where: int) -> Samples:
        with urllib.request.urlopen(f"http://127.0.0.1:{where}/metrics", timeout=60) as answer:
            return Samples(answer.read().decode())

    with serving(tmp_path_factory.mktemp("failures"), **settings) as service:
        grid = service.client.wait(service.client.submit(body(6)).id, timeout_s=300)
        runs = [service.client.run(found.id) for found in service.client.runs(grid.id)]
        assert service.readiness() is not None
        database = Database(service.database)
        with database.read() as connection:
            tried = Counter(connection.scalars(select(attempt.c.run_id).where(attempt.c.outcome.in_(CHARGED))))
        database.close()
        found = Told(grid, runs, tried, scrape(port), scrape(service.port), service.end())
        # What is no line of JSON the supervisor says to whoever started it.
        found.lines = [json.loads(line) for line in service.log.read_text().splitlines() if line.startswith("{")]
    return found


def test_each_failure_ends_as_promised(told: Told) -> None:
    assert (told.grid.state, told.grid.counts.done) == ("failed", 2)
    ends = [(run.state, run.error and run.error.code, told.tried[run.id]) for run in told.runs]
    assert ends == [
        ("done", None, 1),
        ("failed", "error", 3),
        ("failed", "invalid_result", 1),
        ("failed", "invalid_spec", 1),
        ("quarantined", "worker_lost", 3),
        ("done", None, 1),
    ]
    assert told.code == 0


def test_the_counters_of_both_processes_have_moved(told: Told) -> None:
    ends = ("done", "failed", "quarantined")
    ended = {state: told.dispatcher("hostlens_runs_ended_total", state=state) for state in ends}
    assert ended == {"done": 2, "failed": 3, "quarantined": 1}
    assert told.dispatcher("hostlens_worker_deaths_total") == 3
    assert told.dispatcher("hostlens_runs_requeued_total", reason="error") == 2
    assert told.dispatcher("hostlens_runs_claimed_total") >= 10
    assert told.dispatcher("hostlens_dispatcher_generation") == 1
    assert told.dispatcher("hostlens_dispatcher_loop_duration_seconds_count") > 0
    assert told.dispatcher("hostlens_runs_in_flight") == 0
    assert told.dispatcher("process_resident_memory_bytes") > 0
    assert told.api("process_resident_memory_bytes") > 0
    assert told.api("hostlens_http_requests_total", method="POST", route="/v1/grids", status="202") == 1
    assert told.api("hostlens_grids", state="failed") == 1


def test_every_process_tells_of_a_run_with_its_grid_attempt_and_generation(told: Told) -> None:
    grid, ids = told.grid.id, [run.id for run in told.runs]
    stored = told.found(process="dispatcher", event="stored", run=ids[0])
    assert [(line["grid"], line["attempt"], line["generation"]) for line in stored] == [(grid, 1, 1)]
    failed = told.found(process="worker", logger="service.worker.tasks", run=ids[1])
    assert [line["attempt"] for line in failed] == [1, 2, 3]
    assert all(line["grid"] == grid and "the dice fell" in line["exception"] for line in failed)
    assert {line["code"] for line in told.found(process="dispatcher", run=ids[2], level="warning")} == {
        "invalid_result"
    }
    assert told.found(process="api", event="accepted", grid=grid)
    assert told.found(process="api", logger="uvicorn.access", grid=grid, method="GET", status=200)
    assert {line["process"] for line in told.lines} == {
        "supervisor",
        "api",
        "dispatcher",
        "cluster",
        "worker",
    }
