"""Real processes, killed for real: nothing is lost, nothing is stored twice, nobody is left behind."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest
from sqlalchemy import func, select

from service.store.database import Database
from service.store.leadership import Leadership
from service.store.tables import attempt, result
from tests.service.conftest import new_database
from tests.service.plans import body
from tests.service.service_process import ROOT, Serving, eventually, serving


def stored_once(database: Database, grid_id: str) -> int:
    """How many runs of a grid have a result; the primary key allows one each."""
    with database.read() as connection:
        ids = list(connection.scalars(select(result.c.run_id).where(result.c.grid_id == grid_id)))
    assert len(ids) == len(set(ids))
    return len(ids)


def handles(pid: int, number: int) -> bool:
    """Whether a process has a handler of its own for a signal: before that it simply dies of it."""
    status = Path(f"/proc/{pid}/status").read_text(encoding="utf-8")
    caught = int(re.findall(r"^SigCgt:\s*(\w+)$", status, re.MULTILINE)[0], 16)
    return bool(caught >> (number - 1) & 1)


def kill_dispatcher(service: Serving) -> float:
    found = eventually(lambda: service.child("service.dispatcher"), what="a dispatcher")
    os.kill(found.pid, signal.SIGKILL)
    eventually(lambda: (now := service.child("service.dispatcher")) and now.pid != found.pid, what="its restart")
    return time.monotonic()


@pytest.mark.parametrize("backend", ["sqlite", pytest.param("postgresql", marks=pytest.mark.postgres)])
def test_every_run_is_stored_once_through_kills_of_the_dispatcher(
    tmp_path: Path, request: pytest.FixtureRequest, backend: str
) -> None:
    url = f"sqlite:///{tmp_path / 'kills.sqlite'}"
    if backend == "postgresql":
        url = new_database(request.getfixturevalue("postgres_server"), f"kills_{os.getpid()}")
    kills = 2 if backend == "sqlite" else 1
    with serving(tmp_path, HOSTLENS_DRILL_SLEEP="0.4", HOSTLENS_DATABASE_URL=url) as service:
        before = {process.pid for process in service.processes()}
        grid = service.client.submit(body(24))
        for number in range(kills):
            done = eventually(
                lambda least=6 * (number + 1): (now := service.client.status(grid.id).counts.done) >= least and now,
                what="progress",
            )
            killed = kill_dispatcher(service)
            eventually(lambda done=done: service.client.status(grid.id).counts.done > done + 1, what="a new result")
            print(f"{backend}: first new results {time.monotonic() - killed:.1f} s after the restart")
        ended = service.client.wait(grid.id, timeout_s=60)
        assert ended.counts.done == 24
        database = Database(url)
        assert stored_once(database, grid.id) == 24
        executed = Counter(service.executed())
        assert len(executed) == 24
        # At most the work in flight is done again: two workers, each kill.
        assert sum(executed.values()) <= 24 + 2 * kills
        with database.read() as connection:
            counted = select(attempt.c.outcome, func.count().label("runs")).group_by(attempt.c.outcome)
            outcomes = {row.outcome: row.runs for row in connection.execute(counted)}
        assert outcomes["done"] == 24
        # Those in flight, and as many that were claimed for when they are done.
        assert outcomes.get("dispatcher_lost", 0) <= 4 * kills
        database.close()
        # Supervisor, API, dispatcher, two workers and what multiprocessing keeps for them: no more than before.
        assert len(service.processes()) == len(before)
        assert service.end() == 0
        assert service.processes() == []


def test_ctrl_c_in_the_middle_of_a_grid_leaves_no_process_and_hands_runs_back(tmp_path: Path) -> None:
    with serving(tmp_path, HOSTLENS_DRILL_SLEEP="30") as service:
        grid = service.client.submit(body(4))
        eventually(lambda: service.client.status(grid.id).counts.leased >= 2, what="two runs in flight")
        started = time.monotonic()
        assert service.end(signal.SIGINT) == 0
        assert time.monotonic() - started < 12
        assert service.processes() == []
        database = Database(f"sqlite:///{tmp_path / 'data' / 'hostlens.sqlite'}")
        with database.read() as connection:
            assert list(connection.scalars(select(attempt.c.outcome))) == ["handed_back", "handed_back"]
        database.close()


def test_a_killed_supervisor_takes_everything_with_it(tmp_path: Path) -> None:
    with serving(tmp_path, HOSTLENS_DRILL_SLEEP="30") as service:
        grid = service.client.submit(body(2))
        eventually(lambda: service.client.status(grid.id).counts.leased >= 2, what="two runs in flight")
        service.process.kill()
        eventually(lambda: service.processes() == [], 25, what="the end of all processes")


def test_workers_of_a_dispatcher_without_supervisor_end_with_it(tmp_path: Path) -> None:
    with serving(tmp_path, HOSTLENS_DRILL_SLEEP="0.1") as service:
        service.end()
        alone = subprocess.Popen(
            [sys.executable, "-m", "service.dispatcher"],
            cwd=ROOT,
            env=service.environment,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        eventually(lambda: len(service.processes()) >= 3, what="a dispatcher with two workers")
        time.sleep(1)
        alone.kill()
        alone.wait()
        eventually(lambda: service.processes() == [], 10, what="the end of the workers")


def test_each_failure_ends_as_promised_and_cancel_stops_running_runs(tmp_path: Path) -> None:
    settings = {"HOSTLENS_TASK": "tests.service.tasks:moody", "HOSTLENS_RETRY_DELAY_S": "0.1"}
    with serving(tmp_path, HOSTLENS_DRILL_SLEEP="0.1", **settings) as service:
        grid = service.client.submit(body(6))
        ended = service.client.wait(grid.id, timeout_s=90)
        assert (ended.state, ended.counts.done) == ("failed", 2)
        runs = [service.client.run(found.id) for found in service.client.runs(grid.id)]
        database = Database(f"sqlite:///{tmp_path / 'data' / 'hostlens.sqlite'}")
        with database.read() as connection:
            charged = select(attempt.c.run_id).where(attempt.c.outcome.in_(["done", "error", "worker_lost"]))
            tried = Counter(connection.scalars(charged))
        database.close()
        # What was given back without charge, its answer lost with a worker that the next run killed, does not count.
        told = [(found.state, found.error and found.error.code, tried[found.id]) for found in runs]
        assert told[0] == ("done", None, 1)
        assert told[1] == ("failed", "error", 3)
        assert told[2] == ("failed", "invalid_result", 1)
        assert told[3] == ("failed", "invalid_spec", 1)
        assert told[4] == ("quarantined", "worker_lost", 3)
        assert told[5][0] == "done"
        assert service.readiness() is not None


def test_cancel_stops_running_runs_within_fifteen_seconds(tmp_path: Path) -> None:
    with serving(tmp_path, HOSTLENS_DRILL_SLEEP="60", HOSTLENS_DEADLINE_S="3600") as service:
        grid = service.client.submit(body(20))
        eventually(lambda: service.client.status(grid.id).counts.leased >= 2, what="two runs in flight")
        started = time.monotonic()
        at_once = service.client.cancel(grid.id)
        assert at_once.counts.cancelled == 18
        ended = service.client.wait(grid.id, timeout_s=15)
        print(f"cancelled after {time.monotonic() - started:.1f} s")
        assert ended.counts.cancelled == 20
        # The workers are free again, not asleep for the rest of the minute.
        service.environment["HOSTLENS_DRILL_SLEEP"] = "0"
        eventually(lambda: (now := service.readiness()) and now.workers == 2, 30, what="two workers again")


def test_a_second_service_on_the_same_port_says_so_and_starts_nothing(tmp_path: Path) -> None:
    with serving(tmp_path) as service:
        second = subprocess.run(
            [sys.executable, "-m", "service", "serve"],
            cwd=tmp_path,
            env=service.environment,
            capture_output=True,
            text=True,
            timeout=30,
            check=False,
        )
        assert second.returncode == 2
        assert "HOSTLENS_PORT: cannot listen" in second.stderr


def test_a_second_dispatcher_stands_by_and_claims_nothing(tmp_path: Path) -> None:
    with serving(tmp_path, HOSTLENS_DRILL_SLEEP="0.2") as service:
        standby = subprocess.Popen(
            [sys.executable, "-m", "service.dispatcher"],
            cwd=ROOT,
            env=service.environment,
            stderr=subprocess.PIPE,
            text=True,
        )
        grid = service.client.submit(body(30))
        eventually(lambda: service.client.status(grid.id).counts.done > 4, what="progress")
        assert service.client.wait(grid.id, timeout_s=60).counts.done == 30
        executed = Counter(service.executed())
        assert sorted(executed.values()) == [1] * 30
        standby.send_signal(signal.SIGTERM)
        _, said = standby.communicate(timeout=20)
        assert standby.returncode == 0
        assert "leading" not in said


def test_a_standby_takes_over_from_a_leader_that_is_killed(tmp_path: Path) -> None:
    with serving(tmp_path, HOSTLENS_DRILL_SLEEP="0.2") as service:
        standby = subprocess.Popen(
            [sys.executable, "-m", "service.dispatcher"],
            cwd=ROOT,
            env=service.environment,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        database = Database(f"sqlite:///{tmp_path / 'data' / 'hostlens.sqlite'}")
        leadership = Leadership(database)
        # Time to stand by: it asks every second, the supervisor starts another only after the first has ended.
        time.sleep(3)
        grid = service.client.submit(body(30))
        eventually(lambda: service.client.status(grid.id).counts.done > 2, what="progress")
        first = leadership.view()
        leader = service.child("service.dispatcher")
        assert first is not None
        assert leader is not None
        if f"|{standby.pid}|" in first.holder:
            os.kill(standby.pid, signal.SIGKILL)
        else:
            leader.kill()
        view = eventually(
            lambda: (now := leadership.alive()) and now.generation > first.generation and now, 10, "a new leader"
        )
        assert view.holder != first.holder
        ended = service.client.wait(grid.id, timeout_s=60)
        assert ended.counts.done == 30
        assert stored_once(database, grid.id) == 30
        database.close()
        if standby.poll() is None:
            standby.terminate()
        standby.wait(timeout=20)
