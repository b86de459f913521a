"""Real processes that are stopped, killed and cancelled: nobody is left behind. More kills are in the drills."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path

from sqlalchemy import select

from service.store.database import Database
from service.store.tables import attempt
from tests.drills.installation import Installation
from tests.service.plans import body
from tests.service.service_process import ROOT, Serving, eventually, serving

FOR_EVER = {"HOSTLENS_DRILL_SLEEP": "3600", "HOSTLENS_DEADLINE_S": "7200"}
"""Runs that nobody can have waited for to end by themselves."""


def at_two_runs(service: Serving, runs: int) -> str:
    """A grid of which two runs are in flight."""
    grid = service.client.submit(body(runs))
    eventually(lambda: service.client.status(grid.id).counts.leased >= 2, what="two runs in flight")
    return grid.id


def test_cancel_frees_workers_and_ctrl_c_in_the_middle_of_a_grid_leaves_no_process_and_hands_runs_back(
    tmp_path: Path,
) -> None:
    """Within how many seconds a cancellation is done is measured by the drill of that name."""
    with serving(tmp_path, **FOR_EVER) as service:
        cancelled = at_two_runs(service, 20)
        assert service.client.cancel(cancelled).counts.cancelled == 18
        assert service.client.wait(cancelled, timeout_s=300).counts.cancelled == 20
        eventually(lambda: (now := service.readiness()) and now.workers == 2, what="two workers again")
        assert len(service.workers()) == 2
        at_two_runs(service, 4)
        assert service.end(signal.SIGINT) == 0
        eventually(lambda: service.processes() == [], what="the end of all processes")
        database = Database(service.database)
        with database.read() as connection:
            found = Counter(connection.scalars(select(attempt.c.outcome)))
        assert found == {"cancelled": 2, "handed_back": 2}
        database.close()


def test_a_killed_supervisor_takes_everything_with_it(tmp_path: Path) -> None:
    with serving(tmp_path, **FOR_EVER) as service:
        at_two_runs(service, 2)
        service.process.kill()
        eventually(lambda: service.processes() == [], what="the end of all processes")


def test_workers_of_a_dispatcher_without_supervisor_end_with_it(tmp_path: Path) -> None:
    service = Installation(tmp_path, {}, commands=())
    try:
        alone = subprocess.Popen(
            [sys.executable, "-m", "service.dispatcher"],
            cwd=ROOT,
            env=service.environment,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        eventually(lambda: len(service.workers()) == 2, what="a dispatcher with two workers")
        alone.kill()
        alone.wait()
        eventually(lambda: service.processes() == [], what="the end of the workers")
    finally:
        service.kill_all()
