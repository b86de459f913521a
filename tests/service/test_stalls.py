"""Workers that are alive and take no work: paused by Dask, closing for ever, silent, never greeted; real processes."""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path

from sqlalchemy import select

from service.store.database import Database
from service.store.tables import attempt
from tests.service.plans import body
from tests.service.service_process import Serving, eventually, serving

# The base of a worker with engine and Dask is 170 MiB.
_MEMORY = "600MiB"
_PATIENCE = {"HOSTLENS_WORKER_PATIENCE_S": "6"}
"""Instead of 20: three looks at the workers. Test_attribution has the time itself, by a clock of its own."""


def outcomes(folder: Path) -> Counter[str]:
    database = Database(f"sqlite:///{folder / 'data' / 'hostlens.sqlite'}")
    with database.read() as connection:
        found = Counter(connection.scalars(select(attempt.c.outcome)))
    database.close()
    return found


def ended(service: Serving, runs: int, timeout_s: float = 300.0) -> list[tuple[str, str | None]]:
    grid = service.client.submit(body(runs, seed=0))
    service.client.wait(grid.id, timeout_s=timeout_s)
    found = [service.client.run(one.id) for one in service.client.runs(grid.id)]
    return [(one.state, one.error and one.error.code) for one in found]


def test_a_worker_full_of_what_an_earlier_run_left_is_replaced_and_nobody_is_charged(tmp_path: Path) -> None:
    settings = {
        "HOSTLENS_TASK": "tests.service.hungry:leaking",
        "HOSTLENS_WORKER_MEMORY": _MEMORY,
        "HOSTLENS_WORKERS": "1",
        "HOSTLENS_DRILL_SLEEP": "0.2",
        **_PATIENCE,
    }
    with serving(tmp_path, **settings) as service:
        (first,) = service.workers()
        began = time.monotonic()
        assert set(ended(service, 6)) == {("done", None)}
        print(f"done after {time.monotonic() - began:.0f} s")
        assert first not in service.workers()
        assert "it is replaced: paused" in service.log.read_text()
    assert set(outcomes(tmp_path)) <= {"done", "stalled", "forgotten"}


def test_a_run_that_needs_more_memory_than_a_worker_has_is_charged_with_that_and_no_other_is(tmp_path: Path) -> None:
    settings = {
        "HOSTLENS_TASK": "tests.service.hungry:greedy",
        "HOSTLENS_WORKER_MEMORY": _MEMORY,
        "HOSTLENS_RETRY_DELAY_S": "0.1",
        "HOSTLENS_DRILL_SLEEP": "0.2",
        **_PATIENCE,
    }
    with serving(tmp_path, **settings) as service:
        told = ended(service, 8)
        assert told[1] == told[2] == ("quarantined", "memory")
        assert Counter(told)["done", None] == 6
    found = outcomes(tmp_path)
    assert found["worker_lost"] == 6, "each was tried three times, alone"
    assert found["done"] == 6


def test_a_worker_that_never_answers_its_greeting_is_replaced(tmp_path: Path) -> None:
    harm = tmp_path / "harm"
    harm.mkdir()
    (harm / "greeting-silence").touch()
    settings = {
        "HOSTLENS_TASK": "tests.service.hostile:answer",
        "HOSTLENS_DRILL_HARM": str(harm),
        "HOSTLENS_WORKERS": "1",
    }
    # It waits for a worker that computes.
    with serving(tmp_path, **settings) as service:
        assert "does not answer its greeting" in service.log.read_text()
        assert "it is replaced: greeting" in service.log.read_text()


def test_the_process_that_holds_the_local_cluster_is_killed_and_nobody_is_charged(tmp_path: Path) -> None:
    with serving(tmp_path, HOSTLENS_DRILL_SLEEP="0.5") as service:
        grid = service.client.submit(body(20))
        eventually(lambda: service.client.status(grid.id).counts.done >= 2, what="progress")
        dispatcher, host = service.child("service.dispatcher"), service.child("service.dispatcher.cluster_process")
        assert host is not None
        host.kill()
        assert service.client.wait(grid.id, timeout_s=300).counts.done == 20
        assert service.child("service.dispatcher") == dispatcher, "the dispatcher went with it"
    assert set(outcomes(tmp_path)) <= {"done", "scheduler_lost", "forgotten"}
