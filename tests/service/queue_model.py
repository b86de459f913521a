"""A Hypothesis state machine over the queue: whatever happens in whatever order, nothing is lost or stored twice.

Beside the database runs a model of a few dictionaries; after every step both must say the same. As a command::

    python -m tests.service.queue_model --steps 100000 [--database URL]

It empties the database that it is given; without one it makes a SQLite file of its own, and with ``--database
postgresql`` a server of its own.
"""

from __future__ import annotations

import argparse
import logging
import math
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from enum import Enum, auto
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
    precondition,
    rule,
    run_state_machine_as_test,
)
from sqlalchemy import Connection, event, func, select
from sqlalchemy.exc import OperationalError

from service.domain.precision import Until, standard_error
from service.domain.states import TERMINAL_STATES, RunState
from service.store.database import Database
from service.store.grids import GridStore
from service.store.leadership import Leadership, LeadershipLostError
from service.store.leases import Lease, Outcome
from service.store.migrate import upgrade
from service.store.queue import Failure, RunQueue, Stored
from service.store.tables import attempt, grid, result, run
from tests.drills.drill import THROW_AWAY
from tests.drills.postgres import FAST, postgres_server
from tests.service.conftest import Clock, empty
from tests.service.plans import body, body_until, planned, planned_until, result_of, until

RETRY_S = 1.0
TTL_S = 30.0
ENGINES = (None, "e" * 64, "f" * 64)
QUEUED, PAUSED, LEASED, DONE, FAILED, QUARANTINED, CANCELLED, NOT_NEEDED = (
    RunState(name)
    for name in ("queued", "paused", "leased", "done", "failed", "quarantined", "cancelled", "not_needed")
)
RULES = (None, None, until(1.0, at_most=5), until(0.13, at_most=6), until(1e-9, at_most=3))
"""Results scatter by 0.1: three of them are enough for the first, three or four for the next, none for the last."""


class Answer(Enum):
    """What becomes of the database's answer to a commit."""

    COMES = auto()
    LOST = auto()
    """Committed, but nobody is told, and nobody asks again."""
    REPEATED = auto()
    """Committed, but nobody is told: whoever asked does it once more."""


ANSWERS = st.sampled_from([Answer.COMES, Answer.COMES, Answer.LOST, Answer.REPEATED])


class Forgetful(Database):
    """A database whose connection breaks after the next commit, if it is told to lose its answer."""

    loses = False
    commits = 0

    def __init__(self, url: str) -> None:
        super().__init__(url, asked_first=False)
        if self.is_sqlite:
            # As the servers of the tests: nobody pulls the plug here, and each commit would wait for the disk.
            event.listen(self.engine, "connect", lambda connection, _: connection.execute("PRAGMA synchronous = OFF"))

    @contextmanager
    def write(self) -> Iterator[Connection]:
        """As ever, but for the answer."""
        with super().write() as connection:
            yield connection
        self.commits += 1
        if self.loses:
            self.loses = False
            raise OperationalError("COMMIT", {}, Exception("the answer was lost"))


@dataclass
class ModelRun:
    """A run as it has to be."""

    grid: ModelGrid
    state: RunState = QUEUED
    token: str | None = None
    suspect: bool = False
    attempts: int = 0
    charged_from: int = 0
    ready_by: float = 0.0
    """Seconds after which it must be claimable; for ever where a clock was wrong that nobody has looked at yet."""
    place: int = 0
    """Of its point."""
    charged: Counter[Outcome] = field(default_factory=Counter)


@dataclass
class ModelGrid:
    """A grid as it has to be."""

    engine: str | None
    runs: dict[str, ModelRun] = field(default_factory=dict)
    paused: bool = False
    cancelled: bool = False
    rule: Until | None = None
    biases: dict[int, list[float]] = field(default_factory=lambda: defaultdict(list))
    """By point."""
    reached: set[int] = field(default_factory=set)
    """Points of which no replicate waits any more."""

    @property
    def ended(self) -> bool:
        return all(found.state in TERMINAL_STATES for found in self.runs.values())


class Queue(RuleBasedStateMachine):
    """Rules are what processes do; a crash is a lease that nobody ends until another takes over or looks."""

    url: str
    steps_done = 0
    pieces = False
    """Whether operations take several commits: of these it is the last whose answer is lost."""

    grids = Bundle("grids")
    leases = Bundle("leases")
    dead = Bundle("dead")

    def __init__(self) -> None:
        super().__init__()
        empty(self.url)
        self.clock = Clock()
        self.database = Forgetful(self.url)
        self.grid_store = GridStore(self.database, self.clock)
        self.ahead = timedelta()
        """By so much the dispatcher's clock is ahead of the API's."""
        self.queue = RunQueue(self.database, self.dispatcher_clock, retry_delay_s=RETRY_S)
        self.leadership = self.a_dispatcher(timedelta())
        self.generation = self.leadership.take("0") or 0
        self.seconds = 0.0
        self.model_grids: dict[str, ModelGrid] = {}
        self.runs: dict[str, ModelRun] = {}
        self.seen: list[Lease] = []
        """Every lease that anybody was told of."""

    def teardown(self) -> None:
        self.database.close()

    # What the model does.

    def dispatcher_clock(self) -> datetime:
        return self.clock() + self.ahead

    def a_dispatcher(self, ahead: timedelta) -> Leadership:
        return Leadership(self.database, TTL_S, lambda: self.clock() + ahead, self.clock.monotonic)

    def pass_time(self, seconds: float) -> None:
        self.clock.advance(seconds)
        self.seconds += seconds

    def valid(self, lease: Lease) -> ModelRun | None:
        found = self.runs[lease.run_id]
        return found if found.token == lease.token else None

    def end(self, found: ModelRun, state: RunState) -> None:
        found.token, found.state = None, state
        self.close(found.grid)

    def requeue(self, found: ModelRun, delay: float = 0.0) -> RunState:
        where = CANCELLED if found.grid.cancelled else self.waiting(found)
        found.ready_by = max(found.ready_by, self.seconds + delay)
        self.end(found, where)
        return where

    @staticmethod
    def waiting(found: ModelRun) -> RunState:
        """Where a run belongs that might be run."""
        return NOT_NEEDED if found.place in found.grid.reached else PAUSED if found.grid.paused else QUEUED

    def judge(self, stored: list[Lease]) -> None:
        """Results have come: where the mean bias of a point is known well enough now, nobody waits for others of it."""
        for lease in stored:
            found, estimate = self.runs[lease.run_id], result_of(lease).estimates["image_wide"]
            assert estimate is not None
            found.grid.biases[found.place].append(estimate.magnitude.mean - (estimate.magnitude.truth or 0.0))
        for mine, place in [(self.runs[lease.run_id].grid, self.runs[lease.run_id].place) for lease in stored]:
            known = mine.biases[place]
            if mine.rule is not None and mine.rule.is_kept(standard_error(known), len(known)):
                mine.reached.add(place)
            for found in mine.runs.values():
                if found.state in {QUEUED, PAUSED} and found.place in mine.reached:
                    found.state = NOT_NEEDED
            self.close(mine)

    @staticmethod
    def close(of: ModelGrid) -> None:
        if of.ended:
            of.paused = False

    def carry_out(self, answer: Answer, operation: Callable[[], object], first: object, again: object) -> None:
        """Do something; what it has to say the first time, and once more where the first answer was lost."""
        said = self.say(answer, operation)
        if said:
            assert said[-1] == (first if len(said) == 1 else again)

    def say(self, answer: Answer, operation: Callable[[], object]) -> list[object]:
        """What an operation says: nothing where the answer is lost, two things where it was repeated."""
        self.database.loses = answer is not Answer.COMES and not self.pieces
        before = self.database.commits
        try:
            said = [operation()]
            if self.pieces and answer is not Answer.COMES and self.database.commits > before:
                said = [None, operation()] if answer is Answer.REPEATED else []
        except OperationalError:
            said = [None, operation()] if answer is Answer.REPEATED else []
        finally:
            self.database.loses = False
        return said

    # What processes do.

    @rule(
        target=grids,
        runs=st.integers(1, 4),
        rule=st.sampled_from(RULES),
        engine=st.sampled_from(ENGINES),
        keyed=st.booleans(),
        answer=ANSWERS,
    )
    def submit(self, runs: int, rule: Until | None, engine: str | None, keyed: bool, answer: Answer) -> Any:
        self.pass_time(0.001)
        key = f"key-{len(self.model_grids)}" if keyed else None
        points = (runs + 1) // 2
        asked = body(runs) if rule is None else body_until(points, rule)
        plan = planned(runs) if rule is None else planned_until(points, rule)
        said = self.say(
            answer, lambda: self.grid_store.create(asked, lambda: plan, key=key, engine=engine, until=rule)
        )  # fmt: skip
        with self.database.read() as connection:
            rows = connection.execute(select(run.c.id, run.c.grid_id, run.c.ordinal)).all()
        made = {row.grid_id for row in rows} - self.model_grids.keys()
        # Without a key nobody can tell the second submission from the first.
        assert len(made) == (2 if len(said) == 2 and not keyed else 1)
        for grid_id in made:
            self.model_grids[grid_id] = mine = ModelGrid(engine, rule=rule)
            for row in rows:
                if row.grid_id == grid_id:
                    place = row.ordinal % points
                    self.runs[row.id] = mine.runs[row.id] = ModelRun(mine, ready_by=self.from_now(), place=place)
        return multiple(*sorted(made))

    def from_now(self) -> float:
        """When a run can be claimed that the API lets go now."""
        return math.inf if self.ahead < timedelta() else self.seconds

    @rule(
        target=leases,
        limit=st.integers(1, 6),
        engine=st.sampled_from(ENGINES),
        suspects=st.booleans(),
        answer=ANSWERS,
    )
    def claim(self, limit: int, engine: str | None, suspects: bool, answer: Answer) -> Any:
        fitting = {
            run_id: found
            for run_id, found in self.runs.items()
            if found.state is QUEUED
            and found.suspect is suspects
            and (engine in {None, found.grid.engine} or found.grid.engine is None)
        }
        ready = sum(found.ready_by <= self.seconds for found in fitting.values())
        said = self.say(answer, lambda: self.queue.claim(self.generation, limit, engine, suspects=suspects))
        times = max(len(said), 1)
        claimed = self.now_leased() - {(run_id, found.token) for run_id, found in self.runs.items()}
        assert min(times * limit, ready) <= len(claimed) <= min(times * limit, len(fitting))
        for run_id, token in claimed:
            found = fitting[run_id]
            found.token, found.state, found.attempts = token, LEASED, found.attempts + 1
            found.ready_by = min(found.ready_by, self.seconds)
        leases: Any = said[-1] if said else []
        for lease in leases:
            found = self.runs[lease.run_id]
            assert lease.pair in claimed
            assert (lease.engine, lease.suspect, lease.attempt) == (found.grid.engine, suspects, found.attempts)
        self.seen += leases
        return multiple(*leases)

    def now_leased(self) -> set[tuple[str, str]]:
        return self.queue.held(self.generation)

    @rule(target=dead, lease=consumes(leases), answer=ANSWERS)
    def finish(self, lease: Lease, answer: Answer) -> Lease:
        self.results_come([lease], answer)
        return lease

    @rule(lease=dead)
    def a_late_result(self, lease: Lease) -> None:
        """Nothing but a lease that nobody has ended yet, though its dispatcher has crashed, takes it."""
        self.results_come([lease], Answer.COMES)

    @rule(target=grids, rule=st.sampled_from(RULES[2:]), answer=ANSWERS)
    def replicates_are_run(self, rule: Until, answer: Answer) -> Any:
        """A grid comes, and results of all but the last lease of its kind: step by step that would be seldom."""
        made = self.submit(1, rule, None, False, Answer.COMES)
        self.claim(6, None, False, Answer.COMES)
        self.results_come(self.of_points()[:-1], answer)
        return made

    def of_points(self) -> list[Lease]:
        return [lease for lease in self.seen if self.valid(lease) and self.runs[lease.run_id].grid.rule is not None]

    def results_come(self, leases: list[Lease], answer: Answer) -> None:
        first, stored = [], []
        for lease in leases:
            found = self.valid(lease)
            first.append(Stored.STALE_SAME if found is None else Stored.STORED)
            if found is not None:
                self.end(found, DONE)
                stored.append(lease)
        self.judge(stored)
        results = [(lease, result_of(lease)) for lease in leases]
        self.carry_out(answer, lambda: self.queue.store_all(results), first, [Stored.STALE_SAME] * len(leases))

    @precondition(lambda self: self.seen)
    @rule(
        picks=st.lists(st.integers(0, 19), min_size=1, max_size=5),
        swapped=st.booleans(),
        how=st.sampled_from(["stored", "handed back", "suspected"]),
        answer=ANSWERS,
    )
    def several_end_together(self, picks: list[int], swapped: bool, how: str, answer: Answer) -> None:
        """Leases of now and of before, some of them twice, and perhaps a run with the token of another.

        Half of them are of runs that are leased now, by that lease or by another.
        """
        running = [lease for lease in self.seen if self.runs[lease.run_id].state is LEASED] or self.seen
        these = []
        for pick in picks:
            place, which = divmod(pick, 2)
            among = (running, self.seen)[which]
            these.append(among[-1 - place % len(among)])
        if swapped:
            these += [replace(these[0], token=these[-1].token), replace(these[-1], token=these[0].token)]
        if how == "stored":
            self.results_come(these, answer)
            return
        given = 0
        for lease in these:
            found = self.valid(lease)
            if found is not None:
                found.suspect = found.suspect or how == "suspected"
                given += self.requeue(found) in {QUEUED, PAUSED}
        if how == "suspected":
            self.carry_out(answer, lambda: self.queue.suspect(these, "one of them"), given, 0)
        else:
            self.carry_out(answer, lambda: self.queue.hand_back(these), given, 0)

    @rule(
        target=dead,
        lease=consumes(leases),
        outcome=st.sampled_from([Outcome.ERROR, Outcome.WORKER_LOST, Outcome.DEADLINE]),
        retries=st.integers(0, 2),
        answer=ANSWERS,
    )
    def fail(self, lease: Lease, outcome: Outcome, retries: int, answer: Answer) -> Lease:
        suspect = outcome is Outcome.WORKER_LOST
        found, state = self.valid(lease), None
        if found is not None:
            charged = found.charged[outcome]
            found.charged[outcome] += 1
            if charged < retries:
                found.suspect = found.suspect or suspect
                state = self.requeue(found, delay=RETRY_S * 2.0**charged * 1.5)
            else:
                state = QUARANTINED if suspect else FAILED
                self.end(found, state)
        failure = Failure(outcome, "error", "broken", retries, suspect)
        self.carry_out(answer, lambda: self.queue.fail(lease, failure), state, None)
        return lease

    @rule(target=dead, lease=consumes(leases), answer=ANSWERS)
    def another_engine_answers(self, lease: Lease, answer: Answer) -> Lease:
        found = self.valid(lease)
        taken = found is not None and self.requeue(found, delay=RETRY_S) in {QUEUED, PAUSED}
        self.carry_out(answer, lambda: self.queue.refuse_engine(lease, "0" * 64), taken, False)
        return lease

    @rule(target=dead, lease=consumes(leases), answer=ANSWERS)
    def dask_loses_it(self, lease: Lease, answer: Answer) -> Lease:
        found = self.valid(lease)
        given = found is not None and self.requeue(found) in {QUEUED, PAUSED}
        self.carry_out(answer, lambda: self.queue.requeue_lost(lease, Outcome.FORGOTTEN, "gone"), given, False)
        return lease

    @rule(target=dead, lease=consumes(leases), answer=ANSWERS)
    def its_end_is_refused(self, lease: Lease, answer: Answer) -> Lease:
        found = self.valid(lease)
        if found is not None:
            self.end(found, QUARANTINED)
        aside = found is not None
        self.carry_out(answer, lambda: self.queue.set_aside(lease, ValueError("refused")), aside, False)
        return lease

    @rule(target=dead, lease=consumes(leases))
    def the_dispatcher_crashes_with(self, lease: Lease) -> Lease:
        """Nobody ends this lease: only a take-over or a reconciliation does."""
        return lease

    @rule(why=st.sampled_from(["silent", "dead", "resigned"]), hours=st.sampled_from([-1, 0, 1]), answer=ANSWERS)
    def another_leader_takes_over(self, why: str, hours: int, answer: Answer) -> None:
        """The first is silent for long, or known to be dead, or has left; the clock of the next may be wrong."""
        deposed, rival = self.generation, self.a_dispatcher(timedelta(hours=hours))
        name = f"after {deposed}"
        assert rival.take(name) is None
        if why == "silent":
            self.pass_time(TTL_S - 1.0)
            assert rival.take(name) is None
            self.pass_time(2.0)
        elif why == "resigned":
            self.leadership.resign(deposed)
        said = self.say(answer, lambda: rival.take(name, lambda _: why == "dead"))
        self.generation = deposed + 1
        if said:
            self.generation += len(said) - 1
            assert said[-1] == self.generation
        else:
            # The next one after that finds it dead.
            self.generation += 1
            rival = self.a_dispatcher(timedelta())
            assert rival.take("the one after", lambda _: True) == self.generation
        self.leadership = rival
        for found in self.runs.values():
            if found.state is LEASED:
                self.requeue(found)
        for older in range(deposed, self.generation):
            assert not self.leadership.beat(older, {"e": 1})
            with pytest.raises(LeadershipLostError):
                self.queue.claim(older, 1)

    @rule(known=st.lists(leases, max_size=3), answer=ANSWERS)
    def a_reconciliation(self, known: list[Lease], answer: Answer) -> None:
        """The dispatcher knows of a few of its runs, and gives back what it does not know."""
        pairs = {lease.pair for lease in known}
        given = []
        for run_id, found in self.runs.items():
            if found.state is LEASED and (run_id, found.token) not in pairs and self.requeue(found) in {QUEUED, PAUSED}:
                given.append(run_id)
        self.carry_out(
            answer, lambda: sorted(self.queue.requeue_forgotten(self.generation, pairs)), sorted(given), []
        )  # fmt: skip

    @rule(hours=st.sampled_from([-1, 0, 1]))
    def the_clock_of_the_dispatcher_is_set(self, hours: int) -> None:
        """Or another leads on a machine with another clock: what waits for a time may wait too long."""
        before, self.ahead = self.ahead, timedelta(hours=hours)
        if self.ahead < max(before, timedelta()):
            for found in self.runs.values():
                found.ready_by = math.inf

    @rule(answer=ANSWERS)
    def clocks_are_looked_at(self, answer: Answer) -> None:
        """Nobody's delay is cut short where none of them was wrong."""
        wrong = any(math.isinf(found.ready_by) for found in self.runs.values())
        said = self.say(answer, self.queue.release_postdated)
        assert wrong or said in ([], [0])
        for found in self.runs.values():
            if found.state is QUEUED:
                tries = found.attempts - found.charged_from
                longest = RETRY_S * 2.0 ** (tries - 1) * 1.5 if tries else 0.0
                found.ready_by = min(found.ready_by, self.seconds + 1.001 + longest)

    @rule(seconds=st.floats(0.1, 20.0), answer=ANSWERS)
    def time_passes(self, seconds: float, answer: Answer) -> None:
        self.pass_time(seconds)
        self.carry_out(answer, lambda: self.leadership.beat(self.generation, {"e" * 64: 2}), True, True)

    @rule(grid_id=grids, answer=ANSWERS, stopped=st.sampled_from([None, *Answer]))
    def cancel(self, grid_id: str, answer: Answer, stopped: Answer | None) -> None:
        """The dispatcher has not looked yet where none is ``stopped``."""
        self.say(answer, lambda: self.grid_store.cancel(grid_id))
        mine = self.model_grids[grid_id]
        if not mine.ended:
            mine.cancelled, mine.paused = True, False
        for found in mine.runs.values():
            if found.state in {QUEUED, PAUSED}:
                found.state = CANCELLED
        stopping = {(run_id, found.token) for run_id, found in mine.runs.items() if found.state is LEASED}
        assert stopping == {pair for pair in self.queue.to_cancel(self.generation) if pair[0] in mine.runs}
        if stopped is not None:
            for lease in [lease for lease in self.seen if lease.pair in stopping]:
                self.end(mine.runs[lease.run_id], CANCELLED)
                self.carry_out(stopped, lambda lease=lease: self.queue.cancel_leased(lease), True, False)  # type: ignore[misc]

    @precondition(lambda self: self.seen)
    @rule(pick=st.integers(0, 9), answer=ANSWERS)
    def a_run_is_cancelled_that_somebody_may_have_revived(self, pick: int, answer: Answer) -> None:
        """The dispatcher looked, and before it came to cancel the run its grid was revived, or the run has ended."""
        lease = self.seen[-1 - pick % len(self.seen)]
        found, cancelled = self.valid(lease), False
        if found is not None:
            cancelled = self.requeue(found) is CANCELLED
        self.carry_out(answer, lambda: self.queue.cancel_leased(lease), cancelled, False)

    @rule(grid_id=grids, answer=ANSWERS)
    def pause(self, grid_id: str, answer: Answer) -> None:
        said: Any = self.say(answer, lambda: self.grid_store.pause(grid_id))
        mine = self.model_grids[grid_id]
        if not mine.ended and not mine.cancelled:
            mine.paused = True
            for found in mine.runs.values():
                if found.state is QUEUED:
                    found.state = PAUSED
        assert not said or (said[-1].state == "paused") == mine.paused

    @rule(grid_id=grids, answer=ANSWERS)
    def resume(self, grid_id: str, answer: Answer) -> None:
        self.say(answer, lambda: self.grid_store.resume(grid_id))
        mine = self.model_grids[grid_id]
        mine.paused = False
        for found in mine.runs.values():
            if found.state is PAUSED:
                found.state = QUEUED

    @rule(grid_id=grids, answer=ANSWERS)
    def retry(self, grid_id: str, answer: Answer) -> None:
        mine = self.model_grids[grid_id]
        again = [found for found in mine.runs.values() if found.state in {FAILED, QUARANTINED, CANCELLED}]
        self.carry_out(answer, lambda: self.grid_store.revive(grid_id), len(again), 0)
        for found in again:
            found.state = self.waiting(found)
            found.suspect, found.ready_by, found.charged_from = False, self.from_now(), found.attempts
            found.charged.clear()
        if again:
            mine.cancelled = False
            self.close(mine)

    # What must be true after each of them.

    @invariant()
    def all_is_as_it_has_to_be(self) -> None:
        """Each run, with a result if and only if it is done; each grid, ended if and only if all its runs have."""
        type(self).steps_done += 1
        columns = (run.c.id, run.c.state, run.c.token, run.c.attempt, run.c.suspect)
        with self.database.read() as connection:
            rows = connection.execute(select(*columns)).all()
            results = list(connection.scalars(select(result.c.run_id)))
            counted = select(attempt.c.run_id, func.count().label("ended")).group_by(attempt.c.run_id)
            ends = {row.run_id: row.ended for row in connection.execute(counted)}
            grids = {row.id: row for row in connection.execute(select(grid))}
        found = {row.id: (row.state, row.token, row.attempt, row.suspect, ends.get(row.id, 0)) for row in rows}
        wanted = {
            run_id: (model.state, model.token, model.attempts, model.suspect, model.attempts - (model.state is LEASED))
            for run_id, model in self.runs.items()
        }
        assert found == wanted
        assert Counter(results) == Counter(run_id for run_id, model in self.runs.items() if model.state is DONE)
        assert grids.keys() == self.model_grids.keys()
        for grid_id, mine in self.model_grids.items():
            row = grids[grid_id]
            assert (row.finished_at is not None) == (row.state != "queued") == mine.ended
            assert (row.paused_at is not None) == mine.paused
            if mine.ended:
                assert row.state == _final({found.state for found in mine.runs.values()})


def _final(states: Iterable[RunState]) -> str:
    found = set(states)
    return "cancelled" if CANCELLED in found else "done" if found <= {DONE, NOT_NEEDED} else "failed"


def check(url: str, examples: int, steps: int = 40, *, shrink: bool = True, pieces: bool = False) -> int:
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
    machine: type[Queue] = type("Model", (Queue,), {"url": url, "steps_done": 0, "pieces": pieces})
    run_state_machine_as_test(machine, settings=chosen)
    return int(machine.steps_done)


def main() -> None:
    """Run at least as many steps as are asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--database", help="URL of a database that may be emptied, or postgresql: a server of its own")
    given = parser.parse_args()
    # What is set aside here is told a thousand times, with its reason.
    logging.disable(logging.CRITICAL)
    with ExitStack() as stack:
        if given.database == THROW_AWAY:
            url = stack.enter_context(postgres_server(FAST)).create("model")
        else:
            folder = stack.enter_context(tempfile.TemporaryDirectory())
            url = given.database or f"sqlite:///{Path(folder) / 'model.sqlite'}"
        upgrade(url)
        began, done = time.monotonic(), 0
        while done < given.steps:
            done += check(url, examples=50, steps=100)
            print(f"{done} steps, {time.monotonic() - began:.0f} s", flush=True)
    print(f"{done} steps on {Database(url).url.get_backend_name()}: nothing lost, nothing stored twice")


if __name__ == "__main__":
    main()
