"""A Hypothesis state machine over the queue: whatever happens in whatever order, nothing is lost or stored twice.

Beside the database runs a model of a few dictionaries; after every step both must say the same. As a command::

    python -m tests.service.queue_model --steps 100000 [--database URL]

It empties the database that it is given; without one it makes a SQLite file of its own, and with ``--database
postgresql`` a server of its own.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, settings
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

from service.drills.drill import THROW_AWAY
from service.drills.postgres import FAST, postgres_server
from service.store.database import Database
from service.store.grids import GridStore
from service.store.leadership import Leadership, LeadershipLostError
from service.store.leases import Lease, Outcome
from service.store.migrate import upgrade
from service.store.queue import Failure, RunQueue, Stored
from service.store.states import TERMINAL_STATES, RunState
from service.store.tables import attempt, grid, result, run
from tests.service.conftest import Clock, empty
from tests.service.plans import body, planned, result_of

RETRY_S = 1.0
ENGINES = (None, "e" * 64, "f" * 64)
QUEUED, PAUSED, LEASED, DONE, FAILED, QUARANTINED, CANCELLED = (
    RunState(name) for name in ("queued", "paused", "leased", "done", "failed", "quarantined", "cancelled")
)


@dataclass
class ModelRun:
    """A run as it has to be."""

    grid: ModelGrid
    state: RunState = QUEUED
    lease: Lease | None = None
    suspect: bool = False
    attempts: int = 0
    ready_by: float = 0.0
    charged: Counter[Outcome] = field(default_factory=Counter)


@dataclass
class ModelGrid:
    """A grid as it has to be."""

    engine: str | None
    runs: list[ModelRun] = field(default_factory=list)
    paused: bool = False
    cancelled: bool = False

    @property
    def ended(self) -> bool:
        return all(found.state in TERMINAL_STATES for found in self.runs)


class Queue(RuleBasedStateMachine):
    """Rules are what processes do; a crash is a lease that nobody ends until another takes over or looks."""

    url: str
    steps_done = 0

    grids = Bundle("grids")
    leases = Bundle("leases")
    dead = Bundle("dead")

    def __init__(self) -> None:
        super().__init__()
        empty(self.url)
        self.clock = Clock()
        self.database = Database(self.url)
        self.grid_store = GridStore(self.database, self.clock)
        self.queue = RunQueue(self.database, self.clock, retry_delay_s=RETRY_S)
        self.leadership = Leadership(self.database, 30.0, self.clock)
        self.generation = self.leadership.take("0") or 0
        self.seconds = 0.0
        self.model_grids: dict[str, ModelGrid] = {}
        self.runs: dict[str, ModelRun] = {}

    def teardown(self) -> None:
        self.database.close()

    # What the model does.

    def pass_time(self, seconds: float) -> None:
        self.clock.advance(seconds)
        self.seconds += seconds

    def valid(self, lease: Lease) -> ModelRun | None:
        found = self.runs[lease.run_id]
        return found if found.lease == lease else None

    def end(self, found: ModelRun, state: RunState) -> None:
        found.lease, found.state = None, state
        self.close(found.grid)

    def requeue(self, found: ModelRun, delay: float = 0.0) -> RunState:
        where = CANCELLED if found.grid.cancelled else PAUSED if found.grid.paused else QUEUED
        found.ready_by = max(found.ready_by, self.seconds + delay)
        self.end(found, where)
        return where

    @staticmethod
    def close(of: ModelGrid) -> None:
        if of.ended:
            of.paused = False

    # What processes do.

    @rule(target=grids, runs=st.integers(1, 4), engine=st.sampled_from(ENGINES))
    def submit(self, runs: int, engine: str | None) -> str:
        self.pass_time(0.001)
        made = self.grid_store.create(body(runs), lambda: planned(runs), engine=engine).grid.id
        self.model_grids[made] = ModelGrid(engine)
        for found in self.grid_store.runs(made, 10).items:
            self.runs[found.id] = ModelRun(self.model_grids[made], ready_by=self.seconds)
            self.model_grids[made].runs.append(self.runs[found.id])
        return made

    @rule(target=leases, limit=st.integers(1, 3), engine=st.sampled_from(ENGINES), suspects=st.booleans())
    def claim(self, limit: int, engine: str | None, suspects: bool) -> Any:
        leases = self.queue.claim(self.generation, limit, engine, suspects=suspects)
        fitting = [
            found
            for found in self.runs.values()
            if (found.state is QUEUED and found.suspect is suspects and engine in {None, found.grid.engine})
            or (found.state is QUEUED and found.suspect is suspects and found.grid.engine is None)
        ]  # fmt: skip
        for lease in leases:
            found = self.runs[lease.run_id]
            assert any(found is other for other in fitting)
            assert (lease.engine, lease.suspect) == (found.grid.engine, suspects)
            found.lease, found.state, found.attempts = lease, LEASED, found.attempts + 1
            assert lease.attempt == found.attempts
        ready = [found for found in fitting if found.ready_by <= self.seconds]
        assert min(limit, len(ready)) <= len(leases) <= min(limit, len(fitting))
        return multiple(*leases)

    @rule(target=dead, lease=consumes(leases))
    def finish(self, lease: Lease) -> Lease:
        self.a_result_comes(lease)
        return lease

    @rule(lease=dead)
    def a_late_result(self, lease: Lease) -> None:
        """Nothing but a lease that nobody has ended yet, though its dispatcher has crashed, takes it."""
        self.a_result_comes(lease)

    def a_result_comes(self, lease: Lease) -> None:
        found = self.valid(lease)
        assert self.queue.store(lease, result_of(lease)) is (Stored.STALE_SAME if found is None else Stored.STORED)
        if found is not None:
            self.end(found, DONE)

    @rule(
        target=dead,
        lease=consumes(leases),
        outcome=st.sampled_from([Outcome.ERROR, Outcome.WORKER_LOST, Outcome.DEADLINE]),
        retries=st.integers(0, 2),
    )
    def fail(self, lease: Lease, outcome: Outcome, retries: int) -> Lease:
        suspect = outcome is Outcome.WORKER_LOST
        state = self.queue.fail(lease, Failure(outcome, "error", "broken", retries, suspect))
        found = self.valid(lease)
        if found is None:
            assert state is None
            return lease
        charged = found.charged[outcome]
        found.charged[outcome] += 1
        if charged < retries:
            found.suspect = found.suspect or suspect
            assert state is self.requeue(found, delay=RETRY_S * 2.0**charged * 1.5)
        else:
            self.end(found, QUARANTINED if suspect else FAILED)
            assert state is found.state
        return lease

    @rule(target=dead, first=consumes(leases), second=consumes(leases))
    def a_worker_dies_with_two(self, first: Lease, second: Lease) -> Any:
        found = [one for one in (self.valid(first), self.valid(second)) if one is not None]
        given = self.queue.suspect([first, second], "one of two")
        for one in found:
            one.suspect = True
            self.requeue(one)
        assert given == sum(one.state is not CANCELLED for one in found)
        return multiple(first, second)

    @rule(target=dead, lease=consumes(leases))
    def another_engine_answers(self, lease: Lease) -> Lease:
        found = self.valid(lease)
        taken = self.queue.refuse_engine(lease, "0" * 64)
        assert taken == (found is not None and self.requeue(found, delay=RETRY_S) is not CANCELLED)
        return lease

    @rule(target=dead, lease=consumes(leases))
    def hand_back(self, lease: Lease) -> Lease:
        found = self.valid(lease)
        given = self.queue.hand_back([lease])
        assert given == (found is not None and self.requeue(found) is not CANCELLED)
        return lease

    @rule(target=dead, lease=consumes(leases))
    def the_dispatcher_crashes_with(self, lease: Lease) -> Lease:
        """Nobody ends this lease: only a take-over or a reconciliation does."""
        return lease

    @rule(wait=st.sampled_from([31.0, 0.0]))
    def another_leader_takes_over(self, wait: float) -> None:
        """The lease of the first runs out, or its process is known to be dead."""
        deposed = self.generation
        if not wait:
            assert self.leadership.take("next") is None
        self.pass_time(wait)
        taken = self.leadership.take("next", lambda _: not wait)
        assert taken == deposed + 1
        self.generation = taken
        for found in self.runs.values():
            if found.state is LEASED:
                self.requeue(found)
        assert not self.leadership.beat(deposed, {"e": 1})
        with pytest.raises(LeadershipLostError):
            self.queue.claim(deposed, 1)

    @rule(known=st.lists(leases, max_size=3))
    def a_reconciliation(self, known: list[Lease]) -> None:
        """The dispatcher knows of a few of its runs, and gives back what it does not know."""
        ids = {lease.run_id for lease in known}
        self.queue.requeue_forgotten(self.generation, sorted(ids))
        for run_id, found in self.runs.items():
            if found.state is LEASED and run_id not in ids:
                self.requeue(found)

    @rule()
    def clocks_are_looked_at(self) -> None:
        """None of them was wrong, so nobody's delay is cut short."""
        assert self.queue.release_postdated() == 0

    @rule(seconds=st.floats(0.1, 20.0))
    def time_passes(self, seconds: float) -> None:
        self.pass_time(seconds)
        assert self.leadership.beat(self.generation, {"e" * 64: 2})

    @rule(grid_id=grids, dispatcher_looks=st.booleans())
    def cancel(self, grid_id: str, dispatcher_looks: bool) -> None:
        self.grid_store.cancel(grid_id)
        mine = self.model_grids[grid_id]
        if not mine.ended:
            mine.cancelled, mine.paused = True, False
        for found in mine.runs:
            if found.state in {QUEUED, PAUSED}:
                found.state = CANCELLED
        stopping = {found.lease.run_id for found in mine.runs if found.lease is not None}
        assert stopping <= set(self.queue.to_cancel(self.generation))
        if dispatcher_looks:
            for found in mine.runs:
                if found.lease is not None:
                    assert self.queue.cancel_leased(found.lease)
                    self.end(found, CANCELLED)

    @rule(grid_id=grids)
    def pause(self, grid_id: str) -> None:
        shown = self.grid_store.pause(grid_id)
        mine = self.model_grids[grid_id]
        if not mine.ended and not mine.cancelled:
            mine.paused = True
            for found in mine.runs:
                if found.state is QUEUED:
                    found.state = PAUSED
        assert (shown.state == "paused") == mine.paused

    @rule(grid_id=grids)
    def resume(self, grid_id: str) -> None:
        self.grid_store.resume(grid_id)
        mine = self.model_grids[grid_id]
        mine.paused = False
        for found in mine.runs:
            if found.state is PAUSED:
                found.state = QUEUED

    @rule(grid_id=grids)
    def retry(self, grid_id: str) -> None:
        mine = self.model_grids[grid_id]
        again = [found for found in mine.runs if found.state in {FAILED, QUARANTINED, CANCELLED}]
        assert self.grid_store.revive(grid_id) == len(again)
        for found in again:
            found.state = PAUSED if mine.paused else QUEUED
            found.suspect, found.ready_by = False, self.seconds
            found.charged.clear()
        if again:
            mine.cancelled = False

    # What must be true after each of them.

    @invariant()
    def every_run_is_as_it_has_to_be_and_has_a_result_if_and_only_if_it_is_done(self) -> None:
        type(self).steps_done += 1
        columns = (run.c.id, run.c.state, run.c.token, run.c.attempt, run.c.suspect)
        with self.database.read() as connection:
            rows = connection.execute(select(*columns)).all()
            results = list(connection.scalars(select(result.c.run_id)))
            counted = select(attempt.c.run_id, func.count().label("ended")).group_by(attempt.c.run_id)
            ends = {row.run_id: row.ended for row in connection.execute(counted)}
        found = {row.id: (row.state, row.token, row.attempt, row.suspect, ends.get(row.id, 0)) for row in rows}
        wanted = {
            run_id: (
                model.state,
                None if model.lease is None else model.lease.token,
                model.attempts,
                model.suspect,
                model.attempts - (model.state is LEASED),
            )
            for run_id, model in self.runs.items()
        }
        assert found == wanted
        assert Counter(results) == Counter(run_id for run_id, model in self.runs.items() if model.state is DONE)

    @invariant()
    def a_grid_has_ended_if_and_only_if_all_its_runs_have(self) -> None:
        with self.database.read() as connection:
            rows = {row.id: row for row in connection.execute(select(grid))}
        assert rows.keys() == self.model_grids.keys()
        for grid_id, mine in self.model_grids.items():
            row = rows[grid_id]
            assert (row.finished_at is not None) == (row.state != "queued") == mine.ended
            assert (row.paused_at is not None) == mine.paused
            if mine.ended:
                assert row.state == _final({found.state for found in mine.runs})


def _final(states: Iterable[RunState]) -> str:
    found = set(states)
    return "cancelled" if CANCELLED in found else "done" if found == {DONE} else "failed"


def check(url: str, examples: int, steps: int = 40, *, shrink: bool = True) -> int:
    """Let the machine run on a database; the number of steps after which everything was as it had to be."""
    phases = [Phase.generate, Phase.shrink] if shrink else [Phase.generate]
    chosen = settings(
        max_examples=examples,
        stateful_step_count=steps,
        deadline=None,
        database=None,
        phases=phases,
        suppress_health_check=list(HealthCheck),
    )
    machine = type("Model", (Queue,), {"url": url, "steps_done": 0})
    run_state_machine_as_test(machine, settings=chosen)
    return int(machine.steps_done)


def main() -> None:
    """Run at least as many steps as are asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--database", help="URL of a database that may be emptied, or postgresql: a server of its own")
    given = parser.parse_args()
    with ExitStack() as stack:
        if given.database == THROW_AWAY:
            url = stack.enter_context(postgres_server(FAST)).create("model")
        else:
            folder = stack.enter_context(tempfile.TemporaryDirectory())
            url = given.database or f"sqlite:///{Path(folder) / 'model.sqlite'}"
        upgrade(url)
        began, done = time.monotonic(), 0
        while done < given.steps:
            done += check(url, examples=100, steps=100)
            print(f"{done} steps, {time.monotonic() - began:.0f} s", flush=True)
    print(f"{done} steps on {Database(url).url.get_backend_name()}: nothing lost, nothing stored twice")


if __name__ == "__main__":
    main()
