"""The queue keeps its promises on SQLite and on PostgreSQL."""

from __future__ import annotations

import sqlite3
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import pytest
from sqlalchemy import func, select, text, update
from sqlalchemy.event import listen
from sqlalchemy.exc import IntegrityError, OperationalError

from service.domain.payload import QuantityPayload
from service.domain.states import GridState, RunState
from service.store import leases as leases_module
from service.store import queue as queue_module
from service.store.database import Database
from service.store.grids import GridStore, KeyReusedError
from service.store.leadership import Leadership, LeadershipLostError, require_generation
from service.store.leases import Lease, Outcome, end_attempts, leased_by
from service.store.queue import Failure, RunQueue, Stored
from service.store.runs import NotFoundError
from service.store.tables import event, leader, result, run
from tests.service.conftest import Clock, empty
from tests.service.plans import body, planned, result_of, submit

T = TypeVar("T")


def at_once(work: Callable[..., T], arguments: Iterable[Any]) -> list[T]:
    """Call ``work`` from as many threads at one moment as there are arguments."""
    each = list(arguments)
    barrier = threading.Barrier(len(each))

    def start(argument: Any) -> T:
        barrier.wait()
        return work(argument)

    with ThreadPoolExecutor(len(each)) as threads:
        return list(threads.map(start, each))


ERROR = Failure(Outcome.ERROR, "error", "it broke", retries=2)
PERMANENT = Failure(Outcome.ERROR, "invalid_spec", "never", retries=0)
CRASH = Failure(Outcome.WORKER_LOST, "worker_lost", "gone", retries=2, suspect=True)


@pytest.fixture
def grids(database: Database, clock: Clock) -> GridStore:
    return GridStore(database, clock)


@pytest.fixture
def queue(database: Database, clock: Clock) -> RunQueue:
    return RunQueue(database, clock, retry_delay_s=2.0)


@pytest.fixture
def leadership(database: Database, clock: Clock) -> Leadership:
    return Leadership(database, 30.0, clock, clock.monotonic)


@pytest.fixture
def generation(leadership: Leadership) -> int:
    taken = leadership.take("first")
    assert taken == 1
    return taken


def one(queue: RunQueue, generation: int) -> Lease:
    (lease,) = queue.claim(generation, 1)
    return lease


def results(database: Database) -> int:
    with database.read() as connection:
        return connection.scalar(select(func.count()).select_from(result)) or 0


def test_runs_are_claimed_in_the_order_of_their_grids(grids: GridStore, queue: RunQueue, clock: Clock) -> None:
    Leadership(queue._database, 30.0, clock).take("first")
    first = submit(grids, 3)
    clock.advance(1)
    second = submit(grids, 2, seed=10)
    leases = [lease for _ in range(5) for lease in queue.claim(1, 1)]
    assert [lease.grid_id for lease in leases] == [first] * 3 + [second] * 2
    assert [lease.run_id for lease in leases] == sorted(lease.run_id for lease in leases)
    assert not queue.waiting()
    assert queue.claim(1, 10) == []


def test_four_dispatching_threads_claim_each_run_once(
    url: str, grids: GridStore, generation: int, clock: Clock
) -> None:
    submit(grids, 120)

    def work(_: int) -> list[str]:
        database = Database(url)
        mine = RunQueue(database, clock)
        claimed = []
        while leases := mine.claim(generation, 3):
            claimed += [lease.run_id for lease in leases]
        database.close()
        return claimed

    claimed = [run_id for some in at_once(work, range(4)) for run_id in some]
    # SKIP LOCKED may let a claimer leave while another still holds rows: what is claimed is claimed once all the same.
    assert set(Counter(claimed).values()) == {1}
    assert len(claimed) == 120


def test_a_stored_run_is_done_and_has_one_result_with_its_inputs(
    database: Database, grids: GridStore, queue: RunQueue, generation: int
) -> None:
    grid_id = submit(grids, 1)
    lease = one(queue, generation)
    payload = result_of(lease)
    assert queue.store(lease, payload) is Stored.STORED
    found = grids.run(lease.run_id)
    assert found.state is RunState.DONE
    assert found.result is not None
    assert found.result.payload_digest == payload.digest
    estimate, sent = found.result.estimates["projected_fixed"], payload.estimates["projected_fixed"]
    assert estimate.r_eff.mean == sent.r_eff.mean
    assert estimate.r_eff.bias == pytest.approx(sent.r_eff.mean - 0.39)
    assert found.result.lens["theta_E"].mean == payload.lens["theta_E"].mean
    assert "gamma1" not in found.result.lens
    assert [ended.outcome for ended in found.attempts] == ["done"]
    with database.read() as connection:
        row = connection.execute(select(result)).one()
    assert (row.system, row.camera, row.n, row.magnitude, row.seed) == ("HE0435", "WFC3-IR_F160W", 2.0, 20.5, 0)
    grid = grids.grid(grid_id)
    assert (grid.state, grid.counts.done, grid.progress, grid.eta_seconds) == (GridState.DONE, 1, 1.0, 0.0)


def test_results_with_other_lens_parameters_are_stored_together(
    database: Database, grids: GridStore, queue: RunQueue, generation: int
) -> None:
    """One system has an external shear and another has none; their runs may end in the same moment."""
    submit(grids, 4)
    leases = queue.claim(generation, 4)
    with_shear = {"gamma1": QuantityPayload(mean=0.01, sd=0.001, truth=0.02)}
    for pair, sheared in ((leases[:2], 0), (leases[2:], 1)):
        payloads = [result_of(lease) for lease in pair]
        lens = {**payloads[sheared].lens, **with_shear}
        payloads[sheared] = payloads[sheared].model_copy(update={"lens": lens})
        queue.store_all(list(zip(pair, payloads, strict=True)))
    found = [grids.run(lease.run_id).result for lease in leases]
    assert [result is not None and "gamma1" in result.lens for result in found] == [True, False, False, True]
    assert found[0] is not None
    assert found[3] is not None
    assert found[0].lens["gamma1"].model_dump() == found[3].lens["gamma1"].model_dump()
    assert found[0].lens["gamma1"].truth == 0.02


def test_a_result_comes_too_late_once_another_was_stored(
    database: Database, grids: GridStore, queue: RunQueue, leadership: Leadership, generation: int, clock: Clock
) -> None:
    submit(grids, 1)
    late = one(queue, generation)
    second = leadership.take("second", lambda _: True)
    assert second == 2
    fresh = one(queue, second)
    assert fresh.run_id == late.run_id
    assert fresh.token != late.token
    assert queue.store(fresh, result_of(fresh)) is Stored.STORED
    assert queue.store(late, result_of(late)) is Stored.STALE_SAME
    other = result_of(late).model_copy(update={"chi2": 1.0})
    assert queue.store(late, other) is Stored.STALE_OTHER
    assert results(database) == 1
    with database.read() as connection:
        assert connection.scalar(select(func.count()).where(event.c.kind == "stale_result")) == 2
    assert [ended.outcome for ended in grids.run(late.run_id).attempts] == ["dispatcher_lost", "done"]


def test_two_stores_with_one_lease_at_the_same_time_store_once(
    url: str, database: Database, grids: GridStore, queue: RunQueue, generation: int, clock: Clock
) -> None:
    submit(grids, 1)
    lease = one(queue, generation)
    payload = result_of(lease)

    def work(_: int) -> Stored:
        mine = Database(url)
        stored = RunQueue(mine, clock).store(lease, payload)
        mine.close()
        return stored

    outcomes = at_once(work, range(4))
    assert Counter(outcomes) == {Stored.STORED: 1, Stored.STALE_SAME: 3}
    assert results(database) == 1


def test_the_last_two_runs_ending_at_once_finish_the_grid(
    url: str, grids: GridStore, queue: RunQueue, generation: int, clock: Clock
) -> None:
    def work(lease: Lease) -> None:
        mine = Database(url)
        RunQueue(mine, clock).store(lease, result_of(lease))
        mine.close()

    for repetition in range(5):
        grid_id = submit(grids, 2, seed=10 * repetition)
        at_once(work, queue.claim(generation, 2))
        assert grids.grid(grid_id).state is GridState.DONE


def test_a_failed_run_is_tried_twice_more_with_growing_delay(
    grids: GridStore, queue: RunQueue, generation: int, clock: Clock
) -> None:
    grid_id = submit(grids, 1)
    for least, most in ((1.0, 3.0), (2.0, 6.0)):
        assert queue.fail(one(queue, generation), ERROR) is RunState.QUEUED
        clock.advance(least - 0.01)
        assert not queue.waiting()
        clock.advance(most)
        assert queue.waiting()
    lease = one(queue, generation)
    assert queue.fail(lease, ERROR) is RunState.FAILED
    found = grids.run(lease.run_id)
    assert found.error is not None
    assert (found.error.code, found.attempt) == ("error", 3)
    assert grids.grid(grid_id).state is GridState.FAILED


def test_bad_input_fails_at_once(grids: GridStore, queue: RunQueue, generation: int) -> None:
    submit(grids, 1)
    assert queue.fail(one(queue, generation), PERMANENT) is RunState.FAILED


def test_a_run_that_loses_three_workers_is_quarantined(
    grids: GridStore, queue: RunQueue, generation: int, clock: Clock
) -> None:
    grid_id = submit(grids, 1)
    states = []
    for suspects in (False, True, True):
        (lease,) = queue.claim(generation, 1, suspects=suspects)
        assert lease.suspect is suspects
        states.append(queue.fail(lease, CRASH))
        clock.advance(60)
        assert queue.claim(generation, 1) == []
    assert states == [RunState.QUEUED, RunState.QUEUED, RunState.QUARANTINED]
    assert grids.grid(grid_id).counts.quarantined == 1
    # An explicit retry takes it out of the lane.
    assert grids.revive(grid_id) == 1
    assert not one(queue, generation).suspect


def test_suspects_are_charged_nothing_and_wait_in_a_lane_of_their_own_that_outlasts_the_dispatcher(
    grids: GridStore, queue: RunQueue, leadership: Leadership, generation: int, clock: Clock
) -> None:
    submit(grids, 4)
    leases = queue.claim(generation, 2)
    assert queue.suspect(leases, "one of two") == 2
    assert queue.suspect(leases, "too late") == 0
    innocent = queue.claim(generation, 10)
    assert [lease.run_id[-1] for lease in innocent] == ["2", "3"]
    assert not queue.waiting()
    assert queue.waiting(suspects=True)
    second = leadership.take("second", lambda _: True)
    assert second == 2
    for expected in ("0", "1"):
        (lease,) = queue.claim(second, 1, suspects=True)
        assert (lease.run_id[-1], lease.suspect) == (expected, True)
        assert queue.store(lease, result_of(lease)) is Stored.STORED
    assert [ended.outcome for ended in grids.run(leases[0].run_id).attempts] == ["suspected", "done"]
    # The others have lost their dispatcher, but nobody suspects them.
    assert [lease.suspect for lease in queue.claim(second, 10)] == [False, False]


def test_a_paused_grid_starts_nothing_and_a_resumed_one_goes_on_where_it_was(
    grids: GridStore, queue: RunQueue, generation: int, clock: Clock
) -> None:
    grid_id = submit(grids, 4)
    running, failing = queue.claim(generation, 2)
    paused = grids.pause(grid_id)
    assert (paused.state, paused.uws_phase, paused.counts.paused, paused.counts.leased) == ("paused", "HELD", 2, 2)
    assert paused.eta_seconds is None
    assert grids.pause(grid_id) == paused
    assert not queue.waiting()
    assert queue.claim(generation, 4) == []
    # What runs goes on; what has to be tried again waits with the others.
    assert queue.store(running, result_of(running)) is Stored.STORED
    assert queue.fail(failing, ERROR) is RunState.PAUSED
    clock.advance(60)
    assert queue.claim(generation, 4) == []
    resumed = grids.resume(grid_id)
    assert (resumed.state, resumed.counts.queued, resumed.counts.paused) == (GridState.RUNNING, 3, 0)
    assert grids.resume(grid_id) == resumed
    for lease in queue.claim(generation, 4):
        queue.store(lease, result_of(lease))
    assert grids.grid(grid_id).state is GridState.DONE
    assert grids.pause(grid_id).state is GridState.DONE


def test_a_paused_grid_can_be_cancelled_and_one_that_ends_is_paused_no_longer(
    grids: GridStore, queue: RunQueue, generation: int
) -> None:
    grid_id = submit(grids, 3)
    grids.pause(grid_id)
    cancelled = grids.cancel(grid_id)
    assert (cancelled.state, cancelled.counts.cancelled, cancelled.paused_at) == (GridState.CANCELLED, 3, None)
    last = submit(grids, 1, seed=10)
    lease = one(queue, generation)
    grids.pause(last)
    queue.fail(lease, PERMANENT)
    ended = grids.grid(last)
    assert (ended.state, ended.paused_at) == (GridState.FAILED, None)
    assert grids.revive(last) == 1
    assert queue.waiting()


def test_a_grid_waits_for_workers_with_its_own_engine(
    grids: GridStore, queue: RunQueue, generation: int, clock: Clock
) -> None:
    grid_id = grids.create(body(2), lambda: planned(2), engine="e" * 64).grid.id
    assert grids.grid(grid_id).engine_digest == "e" * 64
    assert not queue.waiting("f" * 64)
    assert queue.claim(generation, 2, "f" * 64) == []
    assert queue.waiting("e" * 64)
    first, second = queue.claim(generation, 2, "e" * 64)
    assert first.engine == "e" * 64
    # Uncharged, and not at once: the same worker would take it again.
    assert queue.refuse_engine(first, "f" * 64)
    assert not queue.waiting("e" * 64)
    clock.advance(10)
    assert [lease.run_id for lease in queue.claim(generation, 2, "e" * 64)] == [first.run_id]
    (attempt, *_) = grids.run(first.run_id).attempts
    assert attempt.outcome == "other_engine"
    assert attempt.detail == f"the worker's engine is {'f' * 64}, the grid's is {'e' * 64}"
    assert queue.store(second, result_of(second)) is Stored.STORED


def test_a_run_handed_back_is_charged_nothing_and_keeps_its_place(
    grids: GridStore, queue: RunQueue, generation: int
) -> None:
    submit(grids, 3)
    for _ in range(5):
        leases = queue.claim(generation, 2)
        assert [lease.run_id[-1] for lease in leases] == ["0", "1"]
        assert queue.hand_back(leases) == 2
    assert queue.hand_back(leases) == 0
    assert queue.fail(one(queue, generation), ERROR) is RunState.QUEUED


def test_runs_that_the_dispatcher_does_not_know_of_go_back(grids: GridStore, queue: RunQueue, generation: int) -> None:
    submit(grids, 3)
    known, *unknown = queue.claim(generation, 3)
    given_back = queue.requeue_forgotten(generation, [known.pair])
    assert sorted(given_back) == [lease.run_id for lease in unknown]  # in which order, a database does not promise
    assert queue.requeue_forgotten(generation, [known.pair]) == []
    assert queue.store(known, result_of(known)) is Stored.STORED


def test_a_wide_cluster_asks_the_database_for_no_more_parameters_than_it_takes(
    sqlite_url: str, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    """SQLite takes 32,766 at most, PostgreSQL 65,535: here a hundred, and no statement names more than forty runs."""
    for module in (leases_module, queue_module):
        monkeypatch.setattr(module, "AT_ONCE", 40)
    database = Database(sqlite_url)
    listen(
        database.engine,
        "connect",
        lambda connection, _: connection.setlimit(sqlite3.SQLITE_LIMIT_VARIABLE_NUMBER, 100),
    )
    grids, queue, leadership = GridStore(database, clock), RunQueue(database, clock), Leadership(database, 30.0, clock)
    submit(grids, 150)
    generation = leadership.take("first")
    assert generation == 1
    leases: list[Lease] = []
    while claimed := queue.claim(generation, 150):
        assert len(claimed) <= 40
        leases += claimed
    assert len(leases) == 150
    assert queue.requeue_forgotten(generation, [lease.pair for lease in leases]) == []
    assert len(queue.requeue_forgotten(generation, [lease.pair for lease in leases[:110]])) == 40
    assert queue.hand_back(leases[:60]) == 60
    assert leadership.take("second", lambda _: True) == 2
    assert grids.grid(leases[0].grid_id).counts.queued == 150
    database.close()


def test_a_clock_that_is_set_back_holds_up_neither_new_runs_nor_retries(
    grids: GridStore, queue: RunQueue, generation: int, clock: Clock
) -> None:
    submit(grids, 3)
    assert queue.fail(one(queue, generation), ERROR) is RunState.QUEUED
    clock.advance(-7200)
    assert queue.claim(generation, 3) == []
    assert queue.release_postdated() == 3
    assert len(queue.claim(generation, 3)) == 3


def test_a_retry_waits_for_its_delay_however_often_clocks_are_looked_at(
    grids: GridStore, queue: RunQueue, generation: int, clock: Clock
) -> None:
    submit(grids, 1)
    queue.fail(one(queue, generation), ERROR)
    assert queue.release_postdated() == 0
    assert queue.claim(generation, 1) == []
    clock.advance(3.0)
    assert len(queue.claim(generation, 1)) == 1


@pytest.mark.postgres
def test_claims_and_heartbeats_do_not_wait_for_each_other(migrated_postgres: str, clock: Clock) -> None:
    empty(migrated_postgres)
    database = Database(migrated_postgres)
    leadership = Leadership(database, 30.0, clock)
    assert leadership.take("first") == 1
    with database.write() as claiming, database.write() as other:
        require_generation(claiming, 1)
        other.execute(text("SET LOCAL lock_timeout = '200ms'"))
        # As a heartbeat does; a successor's lock is another matter.
        other.execute(update(leader).values(workers=3))
    with database.write() as claiming, database.engine.connect() as other:
        require_generation(claiming, 1)
        other.execute(text("SET lock_timeout = '200ms'"))
        with pytest.raises(OperationalError, match="lock timeout"):
            other.execute(select(leader).with_for_update())
    database.close()


def test_a_deposed_leader_claims_nothing(
    grids: GridStore, queue: RunQueue, leadership: Leadership, generation: int, clock: Clock
) -> None:
    submit(grids, 2)
    assert leadership.take("second") is None
    clock.advance(29.0)
    assert leadership.beat(generation, {"e": 2})
    assert leadership.take("second") is None
    clock.advance(30.5)
    second = leadership.take("second")
    assert second == 2
    assert not leadership.beat(generation, {"e": 2})
    with pytest.raises(LeadershipLostError):
        queue.claim(generation, 1)
    assert len(queue.claim(second, 2)) == 2


def test_a_leader_known_to_be_dead_is_replaced_at_once(leadership: Leadership, generation: int) -> None:
    assert leadership.take("second", lambda name: name == "other") is None
    assert leadership.take("second", lambda name: name == "first") == 2
    view = leadership.view()
    assert view is not None
    assert view.holder == "second"


def test_a_leader_that_resigns_is_replaced_at_once(leadership: Leadership, generation: int) -> None:
    assert leadership.alive() is not None
    leadership.resign(generation)
    assert leadership.alive() is None
    assert leadership.take("second") == 2


def test_cancel_ends_queued_runs_at_once_and_running_ones_when_they_are_stopped(
    grids: GridStore, queue: RunQueue, generation: int
) -> None:
    grid_id = submit(grids, 4)
    running, returned = queue.claim(generation, 2)
    assert queue.to_cancel(generation) == set()
    assert grids.cancel(grid_id).counts.cancelled == 2
    assert queue.to_cancel(generation) == {running.pair, returned.pair}
    assert queue.hand_back([returned]) == 0
    assert grids.grid(grid_id).counts.cancelled == 3
    assert queue.cancel_leased(running)
    assert queue.store(running, result_of(running)) is Stored.STALE_SAME
    grid = grids.grid(grid_id)
    assert (grid.state, grid.counts.cancelled, grid.uws_phase) == (GridState.CANCELLED, 4, "ABORTED")
    assert grids.cancel(grid_id) == grid


def test_a_result_that_is_there_before_the_stop_is_kept(grids: GridStore, queue: RunQueue, generation: int) -> None:
    grid_id = submit(grids, 1)
    lease = one(queue, generation)
    grids.cancel(grid_id)
    assert queue.store(lease, result_of(lease)) is Stored.STORED
    assert grids.grid(grid_id).state is GridState.DONE


def test_an_explicit_retry_gives_failed_runs_a_fresh_count(
    grids: GridStore, queue: RunQueue, generation: int, clock: Clock
) -> None:
    grid_id = submit(grids, 2)
    first = one(queue, generation)
    queue.store(first, result_of(first))
    for _ in range(3):
        queue.fail(one(queue, generation), ERROR)
        clock.advance(60)
    assert grids.grid(grid_id).state is GridState.FAILED
    assert grids.revive(grid_id) == 1
    assert grids.grid(grid_id).state is GridState.RUNNING
    assert queue.fail(one(queue, generation), ERROR) is RunState.QUEUED
    clock.advance(60)
    last = one(queue, generation)
    assert last.attempt == 5
    queue.store(last, result_of(last))
    assert grids.grid(grid_id).state is GridState.DONE


def test_a_grid_is_stored_whole_or_not_at_all(database: Database, grids: GridStore) -> None:
    twice = planned(1) * 2
    with pytest.raises(IntegrityError):
        grids.create(body(2), lambda: twice)
    assert grids.grids(10).items == []
    with database.read() as connection:
        assert connection.scalar(select(func.count()).select_from(run)) == 0
        assert connection.scalar(select(func.count()).select_from(event)) == 0


def test_many_submissions_with_one_key_make_one_grid(url: str, grids: GridStore, clock: Clock) -> None:

    def work(_: int) -> str:
        mine = Database(url)
        made = GridStore(mine, clock).create(body(3), lambda: planned(3), key="k").grid.id
        mine.close()
        return made

    made = at_once(work, range(8))
    assert len(made) == 8
    assert len(set(made)) == 1
    assert len(grids.grids(10).items) == 1
    with pytest.raises(KeyReusedError):
        grids.create(body(4), lambda: planned(4), key="k")


def test_pages_show_each_thing_once(grids: GridStore, clock: Clock) -> None:
    made = []
    for seed in range(5):
        made.append(submit(grids, 5, seed=seed))
        clock.advance(1)
    seen, cursor = [], None
    while True:
        page = grids.grids(2, cursor)
        seen += [grid.id for grid in page.items]
        cursor = page.next
        if cursor is None:
            break
    assert seen == made[::-1]
    first = grids.runs(made[0], 3)
    assert first.next == "2"
    rest = grids.runs(made[0], 3, after=int(first.next))
    assert [found.ordinal for found in first.items + rest.items] == list(range(5))
    assert rest.next is None
    with pytest.raises(NotFoundError):
        grids.runs("g_" + "0" * 26, 3)


def test_rate_and_time_left_follow_the_runs(grids: GridStore, queue: RunQueue, generation: int, clock: Clock) -> None:
    grid_id = submit(grids, 6)
    clock.advance(1000)
    assert grids.grid(grid_id).rate_per_s is None
    for _ in range(2):
        leases = queue.claim(generation, 2)
        clock.advance(10)
        for lease in leases:
            queue.store(lease, result_of(lease))
    grid = grids.grid(grid_id)
    assert grid.state is GridState.RUNNING
    assert grid.rate_per_s == pytest.approx(4 / 20)
    assert grid.eta_seconds == pytest.approx(10)
    clock.advance(4)
    assert grids.grid(grid_id).eta_seconds == pytest.approx(6)
    clock.advance(16)
    assert grids.grid(grid_id).eta_seconds == pytest.approx(2 * 40 / 4)


def test_four_writers_at_once_never_find_sqlite_locked(sqlite_url: str, clock: Clock) -> None:
    grids = GridStore(Database(sqlite_url), clock)
    Leadership(Database(sqlite_url), 30.0, clock).take("first")

    def work(number: int) -> None:
        mine = Database(sqlite_url)
        queue = RunQueue(mine, clock)
        for repetition in range(25):
            submit(GridStore(mine, clock), 1, seed=100 * number + repetition)
            for lease in queue.claim(1, 2):
                queue.store(lease, result_of(lease))
        mine.close()

    at_once(work, range(4))
    assert sum(grid.counts.done for grid in grids.grids(1000).items) == 100


def together(how: str, queue: RunQueue, leases: list[Lease]) -> None:
    """Several leases end in one transaction."""
    if how == "stored":
        queue.store_all([(lease, result_of(lease)) for lease in leases])
    elif how == "handed back":
        queue.hand_back(leases)
    else:
        queue.suspect(leases, "one of them")


@pytest.mark.parametrize("how", ["stored", "handed back", "suspected"])
def test_the_late_end_of_a_run_beside_that_of_another_leaves_its_new_lease_alone(
    grids: GridStore, queue: RunQueue, generation: int, how: str
) -> None:
    """All runs of one claim share a token: neither the run nor the token tells, only both."""
    submit(grids, 2)
    old, given = queue.claim(generation, 2)
    queue.hand_back([old, given])
    new, beside = queue.claim(generation, 2)
    assert new.token == beside.token
    together(how, queue, [old, beside, beside])
    assert queue.held(generation) == {new.pair}
    assert queue.store(new, result_of(new)) is Stored.STORED
    ended = {"stored": "done", "handed back": "handed_back", "suspected": "suspected"}[how]
    assert [end.outcome for end in grids.run(beside.run_id).attempts] == ["handed_back", ended]
    assert [end.outcome for end in grids.run(new.run_id).attempts] == ["handed_back", "done"]


def test_a_reconciliation_tells_an_old_lease_of_a_run_from_its_new_one(
    grids: GridStore, queue: RunQueue, generation: int
) -> None:
    submit(grids, 1)
    old = one(queue, generation)
    queue.hand_back([old])
    new = one(queue, generation)  # whose answer was lost: the dispatcher knows the old one alone
    assert queue.requeue_forgotten(generation, [old.pair]) == [new.run_id]


def test_a_run_is_not_cancelled_any_more_once_its_grid_was_revived(
    grids: GridStore, queue: RunQueue, generation: int
) -> None:
    grid_id = submit(grids, 2)
    lease = one(queue, generation)
    grids.cancel(grid_id)
    assert queue.to_cancel(generation) == {lease.pair}
    assert grids.revive(grid_id) == 1
    assert not queue.cancel_leased(lease)
    assert grids.grid(grid_id).counts.queued == 2


def test_a_take_over_sets_aside_what_the_database_refuses_and_takes_back_the_rest(
    database: Database, grids: GridStore, queue: RunQueue, leadership: Leadership, generation: int
) -> None:
    """As a database looks that an older version has left: an attempt that is still under way is on record as ended."""
    grid_id = submit(grids, 3)
    poisoned, *others = queue.claim(generation, 3)
    with database.write() as connection:
        end_attempts(connection, leased_by(connection, [poisoned]), Outcome.DONE, queue._clock())
    with pytest.raises(IntegrityError):
        queue.store(poisoned, result_of(poisoned))
    assert leadership.take("second", lambda _: True) == 2
    found = grids.run(poisoned.run_id)
    assert (found.state, found.error and found.error.code) == ("quarantined", "ending_refused")
    assert grids.grid(grid_id).counts.queued == 2
    assert [lease.run_id for lease in queue.claim(2, 3)] == [lease.run_id for lease in others]
    # Nothing is lost for good: an explicit retry runs it again.
    assert grids.revive(grid_id) == 1
    again = one(queue, 2)
    assert queue.store(again, result_of(again)) is Stored.STORED
    with database.read() as connection:
        told = connection.execute(select(event.c.detail).where(event.c.kind == "run_quarantined")).one()
    assert told.detail == {"attempt": 1, "code": "ending_refused"}


def test_a_reconciliation_sets_aside_what_the_database_refuses_and_takes_back_the_rest(
    database: Database, grids: GridStore, queue: RunQueue, generation: int
) -> None:
    grid_id = submit(grids, 3)
    poisoned, *others = queue.claim(generation, 3)
    with database.write() as connection:
        end_attempts(connection, leased_by(connection, [poisoned]), Outcome.DONE, queue._clock())
    assert sorted(queue.requeue_forgotten(generation, [])) == [lease.run_id for lease in others]
    counts = grids.grid(grid_id).counts
    assert (counts.queued, counts.quarantined) == (2, 1)


@pytest.mark.parametrize("hours", [-1, 1])
def test_a_leader_whose_clock_is_wrong_is_replaced_when_it_falls_silent_and_not_before(
    database: Database, clock: Clock, hours: int
) -> None:
    wrong = Clock()
    wrong.set(3600 * hours)
    leader = Leadership(database, 30.0, wrong)
    generation = leader.take("far away")
    assert generation == 1
    standby, shown = (Leadership(database, 30.0, clock, clock.monotonic) for _ in range(2))
    for _ in range(20):
        assert standby.take("standby") is None
        clock.advance(5.0)
        wrong.advance(5.0)
        assert leader.beat(generation, {"e": 1})
        shown.alive()
        assert shown.alive() is not None or hours < 0
    assert standby.take("standby") is None
    assert shown.alive() is not None
    clock.advance(29.0)
    assert standby.take("standby") is None
    assert shown.alive() is not None
    clock.advance(1.0)
    assert shown.alive() is None
    just_started = Leadership(database, 30.0, clock, clock.monotonic)
    assert just_started.take("another") is None
    assert standby.take("standby") == 2
    assert not leader.beat(generation, {"e": 1})
    assert just_started.take("another") is None


def test_who_looks_for_the_first_time_takes_no_dead_leader_for_alive_for_long(database: Database, clock: Clock) -> None:
    ahead = Clock()
    ahead.set(3600)
    assert Leadership(database, 30.0, ahead).take("dead") == 1
    shown = Leadership(database, 30.0, clock, clock.monotonic)
    assert shown.alive() is not None
    clock.advance(30.0)
    assert shown.alive() is None
    # Where the clocks agree it is seen at once.
    now = Clock()
    now.advance(3700)
    assert Leadership(database, 30.0, now, now.monotonic).alive() is None


def test_a_standby_that_could_not_see_the_leader_waits_anew(database: Database, clock: Clock) -> None:
    """The database was away for both: the leader's next beat comes when it is back, and its results with it."""
    assert Leadership(database, 30.0, clock).take("leader") == 1
    standby = Leadership(database, 30.0, clock, clock.monotonic)
    assert standby.take("standby") is None
    clock.advance(60.0)
    standby.forget()
    assert standby.take("standby") is None
    clock.advance(30.0)
    assert standby.take("standby") == 2


def test_a_dispatcher_that_never_got_the_answer_takes_the_lead_again_at_once(
    leadership: Leadership, generation: int
) -> None:
    assert leadership.take("first") == 2


@pytest.mark.parametrize("minutes", [-1, -10, -120])
def test_a_retry_waits_no_longer_than_its_back_off_where_the_next_leader_s_clock_is_behind(
    database: Database, grids: GridStore, queue: RunQueue, generation: int, clock: Clock, minutes: int
) -> None:
    submit(grids, 1)
    queue.fail(one(queue, generation), ERROR)
    clock.set(60 * minutes)
    queue.release_postdated()
    # One second of slack, and a back-off of 2 s with its jitter.
    clock.advance(1.0 + 3.0)
    assert len(queue.claim(generation, 1)) == 1


def test_a_thousand_leases_end_together_in_well_under_a_second(
    grids: GridStore, queue: RunQueue, generation: int
) -> None:
    """Half of them by a claim that is over; the bound is ten times what it takes on an idle machine."""
    submit(grids, 1000)
    old = queue.claim(generation, 1000)
    queue.hand_back(old[:500])
    new = queue.claim(generation, 1000)
    began = time.process_time()
    assert queue.hand_back([*old, *new]) == 1000
    took = time.process_time() - began
    print(f"{took * 1000:.0f} ms of CPU here")
    assert took < 2.0


def test_a_run_whose_specification_nobody_can_read_fails_with_its_reason_and_keeps_no_other_from_being_claimed(
    database: Database, grids: GridStore, queue: RunQueue, generation: int
) -> None:
    """Only a change by hand makes such a row; PostgreSQL itself refuses text that is no JSON, but not a list."""
    grid_id = submit(grids, 3)
    broken = grids.runs(grid_id, 3).items[0].id
    spoilt = "'[1, 2'" if database.url.drivername.startswith("sqlite") else "'[1, 2]'::json"
    with database.write() as connection:
        connection.execute(text(f"UPDATE run SET spec = {spoilt} WHERE id = :id"), {"id": broken})  # noqa: S608
    leases = queue.claim(generation, 10)
    assert len(leases) == 2
    assert broken not in {lease.run_id for lease in leases}
    assert queue.claim(generation, 10) == []
    with database.read() as connection:
        row = connection.execute(select(run.c.state, run.c.error_code, run.c.error_detail).where(run.c.id == broken))
        assert tuple(row.one()) == ("failed", "invalid_spec", "the stored specification is not a JSON object")
        kinds = connection.scalars(select(event.c.kind).where(event.c.run_id == broken).order_by(event.c.id)).all()
        assert kinds == ["run_started", "run_failed"]
    for lease in leases:
        queue.store(lease, result_of(lease))
    assert grids.grid(grid_id).state is GridState.FAILED
