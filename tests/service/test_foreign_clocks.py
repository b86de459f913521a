"""Real dispatchers on machines whose clocks are hours apart: a leader that falls silent is replaced, and no other."""

from __future__ import annotations

import os
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest
from sqlalchemy import select

from service.dispatcher.dispatch import ENDED
from service.runtime.settings import Settings
from service.store.database import Database
from service.store.grids import GridStore
from service.store.leadership import Leadership, LeaderView
from service.store.tables import attempt
from tests.drills.installation import PATIENCE_S
from tests.service.plans import submit
from tests.service.service_process import ROOT, eventually

HEARTBEAT_S, TTL_S = 0.5, 6.0

Start = Callable[[float], "subprocess.Popen[bytes]"]


@pytest.fixture
def start(sqlite_url: str, tmp_path: Path) -> Iterator[Start]:
    """Start a dispatcher whose clock is so many hours ahead; all of them are gone afterwards."""
    started: list[subprocess.Popen[bytes]] = []
    environment = {
        **os.environ,
        "HOSTLENS_DATA_DIR": str(tmp_path),
        "HOSTLENS_DATABASE_URL": sqlite_url,
        "HOSTLENS_TASK": "tests.service.tasks:fast",
        "HOSTLENS_DRILL_SLEEP": "0.2",
        "HOSTLENS_WORKERS": "1",
        "HOSTLENS_HEARTBEAT_S": str(HEARTBEAT_S),
        "HOSTLENS_LEADER_TTL_S": str(TTL_S),
        "HOSTLENS_RECONCILE_S": "1",
    }

    def begin(hours: float) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "tests.service.foreign_dispatcher", str(hours)]
        log = (tmp_path / f"log-{len(started)}").open("wb")
        started.append(subprocess.Popen(command, cwd=ROOT, env=environment, stderr=log, start_new_session=True))
        return started[-1]

    yield begin
    for process in started:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def leads(process: subprocess.Popen[bytes], leadership: Leadership) -> LeaderView | None:
    """The leader's row, if it is of this process."""
    view = leadership.alive()
    return view if view is not None and f"|{process.pid}|" in view.holder else None


@pytest.mark.parametrize("hours", [-1.0, 1.0])
def test_a_leader_whose_clock_is_an_hour_off_is_replaced_when_it_dies(
    sqlite_url: str, start: Start, hours: float
) -> None:
    database = Database(sqlite_url)
    leadership = Leadership(database, Settings(heartbeat_s=HEARTBEAT_S, leader_ttl_s=TTL_S).leader_ttl_s)
    grids = GridStore(database)
    first = start(hours)
    eventually(lambda: leads(first, leadership), what="a leader")
    standby = start(0.0)
    grid_id = submit(grids, 12)
    # Twice the time-to-live with the standby watching: it hinders nobody that beats.
    # Who looks seldom has only the clocks to go by; this looks all the time.
    eventually(lambda: leads(first, leadership) and grids.grid(grid_id).counts.done >= 4, what="results")
    watched = time.monotonic() + 2 * TTL_S
    while time.monotonic() < watched:
        assert leads(first, leadership) is not None
        time.sleep(0.3)
    os.killpg(first.pid, signal.SIGKILL)
    killed = time.monotonic()
    eventually(lambda: leads(standby, leadership), what="the standby")
    print(f"the standby leads {time.monotonic() - killed:.1f} s after the kill, with a time-to-live of {TTL_S:g} s")
    eventually(lambda: grids.grid(grid_id).finished_at is not None, what="the end of the grid")
    assert grids.grid(grid_id).counts.done == 12
    database.close()


def is_stopped_without_lock(leader: subprocess.Popen[bytes], file: Path) -> bool:
    """Stop it; where it holds SQLite's lock, let it go on: whoever is stopped with that keeps all others waiting."""
    leader.send_signal(signal.SIGSTOP)
    with closing(sqlite3.connect(file, timeout=2.0, isolation_level=None)) as other:
        try:
            other.execute("BEGIN IMMEDIATE")
            other.execute("ROLLBACK")
        except sqlite3.OperationalError:
            leader.send_signal(signal.SIGCONT)
            return False
    return True


def test_a_leader_that_was_stopped_and_goes_on_is_fenced_and_ends(sqlite_url: str, start: Start) -> None:
    database = Database(sqlite_url)
    leadership, grids = Leadership(database, TTL_S), GridStore(database)
    first = start(1.0)
    eventually(lambda: leads(first, leadership), what="a leader")
    standby = start(-1.0)
    grid_id = submit(grids, 40)
    eventually(lambda: grids.grid(grid_id).counts.done >= 2, what="results")
    eventually(lambda: is_stopped_without_lock(first, Path(sqlite_url.removeprefix("sqlite:///"))), what="a moment")
    eventually(lambda: leadership.alive() is None or leads(standby, leadership), what="a leader that is silent")
    eventually(lambda: leads(standby, leadership), what="the standby")
    first.send_signal(signal.SIGCONT)
    assert first.wait(timeout=PATIENCE_S) == ENDED
    assert leads(standby, leadership) is not None
    eventually(lambda: grids.grid(grid_id).finished_at is not None, what="the end of the grid")
    assert grids.grid(grid_id).counts.done == 40
    with database.read() as connection:
        done = list(connection.scalars(select(attempt.c.run_id).where(attempt.c.outcome == "done")))
    assert len(done) == len(set(done)) == 40
    database.close()
