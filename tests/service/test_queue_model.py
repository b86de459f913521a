"""A Hypothesis state machine over the queue: whatever happens in whatever order, nothing is lost or stored twice."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    Bundle,
    RuleBasedStateMachine,
    consumes,
    invariant,
    multiple,
    rule,
    run_state_machine_as_test,
)
from sqlalchemy import func, select

from service.store.database import Database
from service.store.grids import GridStore
from service.store.leadership import Leadership, LeadershipLostError
from service.store.leases import Lease, Outcome
from service.store.queue import Failure, RunQueue, Stored
from service.store.states import RunState
from service.store.tables import attempt, grid, result, run
from tests.service.conftest import Clock, empty
from tests.service.plans import result_of, submit

EXAMPLES = int(os.environ.get("HOSTLENS_MODEL_EXAMPLES", "15"))


class Queue(RuleBasedStateMachine):
    """Rules are what processes do; a crash is a lease that nobody ends."""

    url: str

    grids = Bundle("grids")
    leases = Bundle("leases")
    dead = Bundle("dead")

    def __init__(self) -> None:
        super().__init__()
        self.clock = Clock()
        self.database = Database(self.url)
        self.grid_store = GridStore(self.database, self.clock)
        self.queue = RunQueue(self.database, self.clock, retry_delay_s=1.0)
        self.leadership = Leadership(self.database, 30.0, self.clock)
        self.generation = self.leadership.take("0") or 0
        self.submitted = 0
        self.stored: set[str] = set()
        self.valid: dict[str, Lease] = {}
        self.cancelled: set[str] = set()

    def teardown(self) -> None:
        self.database.close()
        empty(self.url)

    @rule(target=grids, runs=st.integers(1, 4))
    def submit(self, runs: int) -> str:
        self.submitted += runs
        self.clock.advance(0.001)
        return submit(self.grid_store, runs)

    @rule(target=leases, limit=st.integers(1, 3))
    def claim(self, limit: int) -> Any:
        leases = self.queue.claim(self.generation, limit)
        for lease in leases:
            assert lease.run_id not in self.valid
            assert lease.run_id not in self.stored
            self.valid[lease.run_id] = lease
        return multiple(*leases)

    def is_valid(self, lease: Lease) -> bool:
        return self.valid.get(lease.run_id) == lease

    @rule(target=dead, lease=consumes(leases))
    def finish(self, lease: Lease) -> Lease:
        stored = self.queue.store(lease, result_of(lease))
        assert (stored is Stored.STORED) == self.is_valid(lease)
        assert stored is not Stored.STALE_OTHER
        if self.is_valid(lease):
            del self.valid[lease.run_id]
            self.stored.add(lease.run_id)
        return lease

    @rule(lease=dead)
    def a_late_result(self, lease: Lease) -> None:
        assert self.queue.store(lease, result_of(lease)) is Stored.STALE_SAME

    @rule(target=dead, lease=consumes(leases), outcome=st.sampled_from([Outcome.ERROR, Outcome.WORKER_LOST]))
    def fail(self, lease: Lease, outcome: Outcome) -> Lease:
        failure = Failure(outcome, "error", "broken", retries=1, suspect=outcome is Outcome.WORKER_LOST)
        state = self.queue.fail(lease, failure)
        assert (state is not None) == self.is_valid(lease)
        if self.is_valid(lease):
            del self.valid[lease.run_id]
        return lease

    @rule(target=dead, lease=consumes(leases))
    def hand_back(self, lease: Lease) -> Lease:
        given = self.queue.hand_back([lease])
        assert given <= self.is_valid(lease)
        if self.is_valid(lease):
            del self.valid[lease.run_id]
        return lease

    @rule()
    def a_new_leader(self) -> None:
        deposed = self.generation
        self.clock.advance(31)
        taken = self.leadership.take("next")
        assert taken == deposed + 1
        self.generation = taken
        self.valid.clear()
        with pytest.raises(LeadershipLostError):
            self.queue.claim(deposed, 1)

    @rule()
    def the_dispatcher_forgets_everything(self) -> None:
        self.queue.requeue_forgotten(self.generation, [])
        self.valid.clear()

    @rule(seconds=st.floats(0.1, 20.0))
    def time_passes(self, seconds: float) -> None:
        self.clock.advance(seconds)
        assert self.leadership.beat(self.generation, {"e": 2})

    @rule(grid_id=grids)
    def cancel(self, grid_id: str) -> None:
        self.grid_store.cancel(grid_id)
        wanted = set(self.queue.to_cancel(self.generation))
        for lease in list(self.valid.values()):
            if lease.run_id in wanted:
                assert self.queue.cancel_leased(lease)
                del self.valid[lease.run_id]
        assert self.grid_store.grid(grid_id).finished_at is not None

    @rule(grid_id=grids)
    def retry(self, grid_id: str) -> None:
        self.grid_store.revive(grid_id)

    @invariant()
    def what_is_accepted_is_there(self) -> None:
        with self.database.read() as connection:
            assert connection.scalar(select(func.count()).select_from(run)) == self.submitted

    @invariant()
    def a_run_has_a_result_if_and_only_if_it_is_done(self) -> None:
        with self.database.read() as connection:
            done = list(connection.scalars(select(run.c.id).where(run.c.state == RunState.DONE)))
            results = list(connection.scalars(select(result.c.run_id)))
        assert Counter(done) == Counter(results)
        assert set(done) == self.stored

    @invariant()
    def leased_runs_are_those_of_the_valid_leases(self) -> None:
        with self.database.read() as connection:
            leased = connection.execute(select(run.c.id, run.c.token).where(run.c.state == RunState.LEASED)).all()
        assert {row.id: row.token for row in leased} == {key: lease.token for key, lease in self.valid.items()}

    @invariant()
    def every_attempt_ends_once(self) -> None:
        with self.database.read() as connection:
            ended = select(attempt.c.run_id, func.count().label("ended")).group_by(attempt.c.run_id)
            ends = {row.run_id: row.ended for row in connection.execute(ended)}
            for row in connection.execute(select(run.c.id, run.c.attempt, run.c.state)):
                assert ends.get(row.id, 0) == row.attempt - (row.state == RunState.LEASED)

    @invariant()
    def a_grid_has_ended_if_and_only_if_all_its_runs_have(self) -> None:
        with self.database.read() as connection:
            for row in connection.execute(select(grid)):
                left = select(func.count()).where(run.c.grid_id == row.id, run.c.state.in_(["queued", "leased"]))
                assert (connection.scalar(left) == 0) == (row.finished_at is not None) == (row.state != "queued")


CI = settings(
    max_examples=EXAMPLES, stateful_step_count=40, deadline=None, database=None, suppress_health_check=list(HealthCheck)
)  # fmt: skip


def test_the_queue_holds_its_promises_on_sqlite(migrated_sqlite: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = shutil.copy(migrated_sqlite, Path(folder) / "model.sqlite")
        run_state_machine_as_test(type("Model", (Queue,), {"url": f"sqlite:///{file}"}), settings=CI)


@pytest.mark.postgres
def test_the_queue_holds_its_promises_on_postgresql(migrated_postgres: str) -> None:
    empty(migrated_postgres)
    run_state_machine_as_test(type("Model", (Queue,), {"url": migrated_postgres}), settings=CI)
