"""A process dies between any two statements: everything is as before its transaction or as after it, and goes on."""

from __future__ import annotations

import os
import traceback
from typing import Any

import pytest
from sqlalchemy import func, select

from service.domain.states import OPEN_STATES, RunState
from service.store.tables import attempt, event, grid, idempotency, leader, point, result, run
from tests.service.conftest import empty
from tests.service.crashes import DEAD, OPERATIONS, Scene, Stores, die_at, stores
from tests.service.plans import body, planned, result_of


def picture(mine: Stores) -> Any:
    """What is in the database, but for times and tokens."""
    reached = (point.c.place, point.c.runs, point.c.reached_at.is_(None))
    runs = (run.c.ordinal, run.c.state, run.c.attempt, run.c.suspect, run.c.charged_from, run.c.token.is_(None))
    grids = (grid.c.n_runs, grid.c.state, grid.c.paused_at.is_(None), grid.c.cancelled_at.is_(None))
    with mine.database.read() as connection:
        counts = [
            connection.scalar(select(func.count()).select_from(table))
            for table in (result, attempt, event, idempotency, point)
        ]
        return (
            sorted(map(tuple, connection.execute(select(*runs)))),
            sorted(map(tuple, connection.execute(select(*grids)))),
            sorted(map(tuple, connection.execute(select(*reached)))),
            counts,
            connection.scalar(select(leader.c.generation)),
        )


def assert_whole(mine: Stores) -> None:
    """What must be true of a database at any moment."""
    with mine.database.read() as connection:
        runs = connection.execute(select(run)).all()
        results = sorted(connection.scalars(select(result.c.run_id)))
        ended = list(connection.scalars(select(attempt.c.run_id)))
        done = sorted(connection.scalars(select(event.c.run_id).where(event.c.kind == "run_done")))
        grids = {row.id: row for row in connection.execute(select(grid))}
        reached = connection.execute(select(point).where(point.c.reached_at.is_not(None))).all()
    assert sorted(row.id for row in runs if row.state == RunState.DONE) == results == done
    for row in runs:
        assert ended.count(row.id) == row.attempt - (row.state == RunState.LEASED)
        assert (row.state == RunState.PAUSED) <= (grids[row.grid_id].paused_at is not None)
        assert (row.state == RunState.QUEUED) <= (grids[row.grid_id].paused_at is None)
    for place in reached:
        waiting = {other.state for other in runs if other.grid_id == place.grid_id} & {"queued", "paused"}
        assert not waiting, "it has one point"
    for grid_id, row in grids.items():
        mine_runs = [other for other in runs if other.grid_id == grid_id]
        assert len(mine_runs) == row.n_runs
        assert (row.finished_at is None) == any(other.state in OPEN_STATES for other in mine_runs)


def go_on(mine: Stores) -> None:
    """The next dispatcher and the client do what they would: everything ends, each run once."""
    assert mine.grids.create(body(3, 99), lambda: planned(3, 99), key="once").grid.n_runs == 3
    generation = mine.lead()
    for page in mine.grids.grids(10).items:
        mine.grids.resume(page.id)
    for suspects in (False, True):
        while leases := mine.queue.claim(generation, 3, suspects=suspects):
            for lease in leases:
                mine.queue.store(lease, result_of(lease))
    for found in mine.grids.grids(10).items:
        assert found.finished_at is not None, found
        assert found.counts.ended == found.n_runs
    assert_whole(mine)


def crash(url: str, name: str, scene: Scene, boundary: int, **which: bool) -> int:
    """Exit code of a process that has died: forked, since a new one would load for longer than it lives."""
    child = os.fork()
    if child == 0:
        try:
            die_at(url, name, scene, boundary, **which)
            os._exit(0)
        except BaseException:  # noqa: BLE001 - it must not go on as a second test process, whatever happened
            traceback.print_exc()
            os._exit(1)
    _, status = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(status)


@pytest.mark.parametrize("commits", [True, pytest.param(False, marks=pytest.mark.long)], ids=["commits", "any"])
@pytest.mark.parametrize("name", list(OPERATIONS))
def test_a_crash_at_any_boundary_loses_nothing_and_stores_nothing_twice(url: str, name: str, commits: bool) -> None:
    """Before and after each commit; between any two statements, where the database keeps the promise, when asked to."""
    operation = OPERATIONS[name]
    with stores(url) as mine:
        operation.act(mine, operation.prepare(mine))
        after = picture(mine)
        empty(url)
        scene = operation.prepare(mine)
        before = found = picture(mine)
        assert before != after
        crashes = 0
        # As long as nothing has changed the next crash can be one boundary later in the same database.
        while found == before:
            crashes += 1
            assert crash(url, name, scene, crashes, commits=commits) == DEAD, "it came to its end and changed nothing"
            found = picture(mine)
        # The first crash that changes anything lies behind the commit, and leaves all that the operation does.
        assert found == after
        assert_whole(mine)
        go_on(mine)
        print(f"{name}: {crashes} crashes")
        assert crashes >= 2 if commits else crashes > 3


def test_what_a_crashed_process_leaves_can_be_gone_on_from(url: str) -> None:
    """A crash before the commit leaves the picture of before, so one of each scene stands for all its boundaries."""
    for name in ("store", "hand back paused", "cancel running", "fail"):
        empty(url)
        with stores(url) as mine:
            scene = OPERATIONS[name].prepare(mine)
            before = picture(mine)
            assert crash(url, name, scene, 3) == DEAD
            assert picture(mine) == before
            assert_whole(mine)
            go_on(mine)
