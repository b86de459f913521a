"""Very large grids are worked on in pieces: nobody waits for all of them, and a crash between two leaves no half."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from threading import Event, Thread
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import Connection, func, select, text
from sqlalchemy.event import listen, remove

from service.api.app import create_app
from service.domain.plan import PlannedRun
from service.domain.requests import GridRequest, plan
from service.domain.states import GridState
from service.runtime.settings import Settings
from service.store import pieces, settling, submission
from service.store.database import Database
from service.store.depth import QueueDepth
from service.store.grids import GridStore
from service.store.leadership import Leadership
from service.store.leases import Outcome
from service.store.outbox import EventStore
from service.store.queue import Failure, RunQueue
from service.store.runs import NotFoundError
from service.store.submission import SubmissionLostError
from service.store.tables import grid, idempotency, run
from service.store.upkeep import PATIENCE_S, Upkeep
from tests.service.conftest import empty
from tests.service.crashes import DEAD, OPERATIONS, Stores, stores
from tests.service.plans import body, planned, submit
from tests.service.queue_model import check
from tests.service.test_crash_points import assert_whole, crash, go_on, picture
from tests.service.test_dispatcher import InstantPool, Setting

BROKEN = Failure(Outcome.ERROR, "error", "broken", retries=0)


def cut(monkeypatch: pytest.MonkeyPatch, piece: int) -> None:
    for module in (pieces, settling, submission):
        monkeypatch.setattr(module, "PIECE", piece)


@pytest.fixture
def grids(database: Database) -> GridStore:
    return GridStore(database)


class Watched:
    """A plan that calls back before each of its runs."""

    def __init__(self, runs: int, seen: Callable[[int], None]) -> None:
        self._runs, self._seen = planned(runs), seen

    def __len__(self) -> int:
        return len(self._runs)

    def __iter__(self) -> Iterator[PlannedRun]:
        for place, one in enumerate(self._runs):
            self._seen(place)
            yield one


class StalledError(Exception):
    """The process that submits goes no further."""


def stall(grids: GridStore, runs: int, at: int, key: str | None = None, engine: str | None = None) -> None:
    """Leave a submission behind that has come as far as the piece before place ``at``."""

    def seen(place: int) -> None:
        if place == at:
            raise StalledError

    with pytest.raises(StalledError):
        grids.create(body(runs), lambda: Watched(runs, seen), key=key, engine=engine)


def stored(database: Database) -> tuple[int, int, int]:
    """Grids, runs and keys in the database, seen or not."""
    with database.read() as connection:
        grids, runs, keys = (connection.scalar(select(func.count()).select_from(t)) for t in (grid, run, idempotency))
    return grids or 0, runs or 0, keys or 0


def test_a_grid_that_is_being_stored_is_nowhere_until_all_of_it_is(
    database: Database, grids: GridStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    cut(monkeypatch, 3)
    generation = Leadership(database).take("me") or 0
    queue, depth, events = RunQueue(database), QueueDepth(database), EventStore(database)
    looked: list[int] = []

    def look(place: int) -> None:
        with database.read() as connection:
            hidden = connection.scalar(select(grid.c.id))
            first = connection.scalar(select(run.c.id))
        looked.append(stored(database)[1])
        assert grids.grids(10).items == []
        shown = depth.look()
        assert (shown.queued, shown.delayed, shown.leased, sum(shown.grids.values())) == (0, 0, 0, 0)
        assert not queue.waiting("e" * 64)
        assert queue.claim(generation, 5) == []
        assert queue.claim(generation, 5, "e" * 64) == []
        for asked in (grids.grid, grids.cancel, grids.pause, grids.resume, grids.revive):
            with pytest.raises(NotFoundError):
                asked(hidden or "g")
        with pytest.raises(NotFoundError):
            grids.run(first or "r")
        with pytest.raises(NotFoundError):
            grids.runs(hidden or "g", 10)
        with pytest.raises(NotFoundError):
            events.page(hidden or "g", 0, 10)

    made = grids.create(body(8), lambda: Watched(8, look), engine="e" * 64).grid
    # What is planned meanwhile is never more than a piece ahead of what is stored.
    assert looked == [0, 0, 0, 3, 3, 3, 6, 6]
    assert (made.n_runs, made.counts.queued) == (8, 8)
    assert grids.grids(10).items == [made]
    assert depth.look().queued == 8
    assert len(queue.claim(generation, 10, "e" * 64)) == 8
    kinds = [event.kind for event in events.page(made.id, 0, 10).items]
    assert kinds == ["grid_submitted", *8 * ["run_started"]]


def test_a_repeated_request_goes_on_where_the_first_one_stands(
    database: Database, grids: GridStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    cut(monkeypatch, 3)
    stall(grids, 8, at=6, key="k")
    with database.read() as connection:
        begun = connection.scalar(select(grid.c.id))
    planned_anew: list[int] = []
    made = grids.create(body(8), lambda: Watched(8, planned_anew.append), key="k")
    assert (made.grid.id, made.grid.counts.queued, made.replayed) == (begun, 8, True)
    assert stored(database) == (1, 8, 1)
    again = grids.create(body(8), lambda: pytest.fail("planned again"), key="k")
    assert again.replayed
    assert again.grid.id == begun


def test_two_who_store_one_grid_help_each_other(
    database: Database, grids: GridStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    cut(monkeypatch, 3)
    made: list[str] = []

    def seen(place: int) -> None:
        if place == 4 and not made:
            made.append(grids.create(body(8), lambda: planned(8), key="k").grid.id)

    assert [grids.create(body(8), lambda: Watched(8, seen), key="k").grid.id] == made
    assert stored(database) == (1, 8, 1)
    assert [event.kind for event in EventStore(database).page(made[0], 0, 10).items] == ["grid_submitted"]


def test_another_engine_does_not_go_on_with_what_the_first_one_planned(
    database: Database, grids: GridStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    cut(monkeypatch, 3)
    stall(grids, 8, at=6, key="k", engine="e" * 64)
    made = grids.create(body(8), lambda: planned(8), key="k", engine="f" * 64)
    assert (made.grid.engine_digest, made.grid.counts.queued, made.replayed) == ("f" * 64, 8, False)
    while Upkeep(database).step():
        pass
    assert stored(database) == (1, 8, 1)


def test_what_nobody_goes_on_with_is_taken_away_and_its_key_is_free(
    database: Database, grids: GridStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    cut(monkeypatch, 3)
    other = submit(grids, 5, seed=100)
    stall(grids, 8, at=6, key="k")
    now = 0.0
    kept = Upkeep(database, monotonic=lambda: now)
    assert not kept.step()
    now += PATIENCE_S
    assert not kept.step()
    now += 1.0
    assert kept.step()
    while kept.step():
        pass
    assert stored(database) == (1, 5, 0)
    assert grids.grid(other).counts.queued == 5
    assert not grids.create(body(8), lambda: planned(8), key="k").replayed


def test_a_submission_that_goes_on_slowly_is_left_alone(
    database: Database, grids: GridStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    cut(monkeypatch, 1)
    now = 0.0
    kept = Upkeep(database, monotonic=lambda: now)

    def seen(place: int) -> None:
        nonlocal now
        now += 0.9 * PATIENCE_S
        assert not kept.step()

    assert grids.create(body(5), lambda: Watched(5, seen)).grid.counts.queued == 5


def test_who_was_given_up_is_told_and_leaves_nothing(
    database: Database, grids: GridStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    cut(monkeypatch, 3)
    now = 0.0
    kept = Upkeep(database, monotonic=lambda: now)

    def seen(place: int) -> None:
        nonlocal now
        if place == 7:
            kept.step()
            now += PATIENCE_S + 1.0
            assert kept.step()

    with pytest.raises(SubmissionLostError):
        grids.create(body(9), lambda: Watched(9, seen), key="k")
    while kept.step():
        pass
    assert stored(database) == (0, 0, 0)


def test_a_client_whose_grid_was_given_up_may_try_again(
    sqlite_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lost(*_: object) -> None:
        raise SubmissionLostError("nothing was stored for too long; repeat the request")

    monkeypatch.setattr(GridStore, "create", lost)
    with TestClient(create_app(Settings(database_url=sqlite_url, data_dir=tmp_path))) as api:
        answer = api.post("/v1/grids", json=body(2))
    assert (answer.status_code, answer.headers["retry-after"]) == (503, "1")
    assert "repeat the request" in answer.json()["detail"]


def test_a_grid_that_is_whole_in_the_last_moment_is_not_taken_away(database: Database, grids: GridStore) -> None:
    whole = submit(grids, 3)
    now = grids.grid(whole).created_at
    with database.write() as connection:
        submission.give_up(connection, whole, now)
        submission.take_away(connection, whole)
    grids.cancel(whole)
    with database.write() as connection:
        submission.take_away(connection, whole)
    assert grids.grid(whole).counts.cancelled == 3


def _half_marked(database: Database, grids: GridStore, act: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """A grid of eight runs whose process has died after the first piece of three."""
    cut(monkeypatch, 3)
    grid_id = submit(grids, 8)
    if act == "resume":
        grids.pause(grid_id)
    if act == "revive":
        grids.cancel(grid_id)
    monkeypatch.setattr(pieces.Turns, "wait", _die)
    with pytest.raises(StalledError):
        getattr(grids, act)(grid_id)
    monkeypatch.undo()
    cut(monkeypatch, 3)
    return grid_id


def _die(_: pieces.Turns) -> None:
    raise StalledError


ENDS = {"cancel": "cancelled", "pause": "paused", "resume": "queued", "revive": "queued"}


@pytest.mark.parametrize("act", ENDS)
@pytest.mark.parametrize("who", ["the dispatcher", "a repetition"])
def test_what_a_crash_leaves_half_is_brought_to_its_end(
    database: Database, grids: GridStore, act: str, who: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    grid_id = _half_marked(database, grids, act, monkeypatch)
    assert getattr(grids.grid(grid_id).counts, ENDS[act]) == 3
    generation = Leadership(database).take("me") or 0
    claimed = RunQueue(database).claim(generation, 10)
    assert len(claimed) == (3 if act in {"resume", "revive"} else 0)
    RunQueue(database).hand_back(claimed)
    if who == "the dispatcher":
        steps = 0
        while RunQueue(database).upkeep.step():
            steps += 1
        assert steps == 2
    else:
        getattr(grids, act)(grid_id)
    assert getattr(grids.grid(grid_id).counts, ENDS[act]) == 8
    assert (grids.grid(grid_id).finished_at is not None) == (act == "cancel")
    assert not Upkeep(database).step()


def test_a_dispatcher_at_work_goes_on_with_what_a_crash_has_left(
    sqlite_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    database = Database(sqlite_url)
    setting = Setting(database, InstantPool(tmp_path), runs=2, reconcile_s=0.01)
    grid_id = _half_marked(database, setting.grids, "cancel", monkeypatch)
    setting.run(until=lambda: setting.grids.grid(grid_id).finished_at is not None)
    assert setting.grids.grid(grid_id).counts.cancelled == 8
    assert setting.pool.submitted == [key for key in setting.pool.submitted if grid_id[2:] not in key]
    database.close()


def test_a_retry_queues_each_run_once_though_it_fails_again_meanwhile(
    database: Database, grids: GridStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    grid_id = _half_marked(database, grids, "revive", monkeypatch)
    generation = Leadership(database).take("me") or 0
    queue = RunQueue(database)
    for lease in queue.claim(generation, 10):
        queue.fail(lease, BROKEN)
    # None is open, and yet the grid has not ended: five of its runs are still to come.
    assert grids.grid(grid_id).finished_at is None
    while queue.upkeep.step():
        pass
    assert (grids.grid(grid_id).counts.failed, grids.grid(grid_id).counts.queued) == (3, 5)
    for lease in queue.claim(generation, 10):
        queue.fail(lease, BROKEN)
    assert grids.grid(grid_id).state is GridState.FAILED


def test_a_grid_cancelled_during_its_retry_stays_cancelled(
    database: Database, grids: GridStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    grid_id = _half_marked(database, grids, "revive", monkeypatch)
    assert grids.cancel(grid_id).counts.cancelled == 8
    assert not Upkeep(database).step()
    assert grids.grid(grid_id).state is GridState.CANCELLED


def test_a_retry_of_a_paused_grid_queues_nothing(
    database: Database, grids: GridStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    cut(monkeypatch, 3)
    grid_id = submit(grids, 8)
    queue = RunQueue(database)
    for lease in queue.claim(Leadership(database).take("me") or 0, 7):
        queue.fail(lease, BROKEN)
    grids.pause(grid_id)
    assert grids.revive(grid_id) == 7
    assert grids.grid(grid_id).counts.paused == 8


def test_looking_at_an_ended_grid_does_not_end_it_again(database: Database, grids: GridStore) -> None:
    grid_id = submit(grids, 2)
    ended = grids.cancel(grid_id)
    for act in (grids.cancel, grids.pause, grids.resume):
        assert act(grid_id) == ended
    kinds = [event.kind for event in EventStore(database).page(grid_id, 0, 10).items]
    assert kinds == ["grid_submitted", "grid_cancelled", "grid_finished"]


@pytest.mark.parametrize("name", ["submit", "cancel", "pause", "resume", "revive"])
def test_a_crash_between_any_two_pieces_leaves_the_whole_or_nothing(
    url: str, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    cut(monkeypatch, 1)
    operation = OPERATIONS[name]
    with stores(url) as mine:
        operation.act(mine, operation.prepare(mine))
        after = picture(mine)
        between = 0
        for boundary in count(1):
            empty(url)
            scene = operation.prepare(mine)
            before = picture(mine)
            code = crash(url, name, scene, boundary, within=False)
            if code != DEAD:
                break
            left = picture(mine)
            between += left not in (before, after)
            if name in {"cancel", "pause"} and left != before:
                assert not [one for one in mine.queue.claim(scene.generation, 9) if one.grid_id == scene.grid_id]
                mine.lead()
            _assert_counts_fit(mine)
            if name == "submit" and boundary % 2:
                operation.act(mine, scene)
                assert picture(mine) == after
            else:
                _keep_up(mine.database)
                if name not in {"cancel", "pause"}:
                    assert picture(mine) in (before, after)
            assert_whole(mine)
        assert code == 0
        assert between > 0, "no crash fell between two pieces"
        go_on(mine)


def _keep_up(database: Database) -> None:
    times = count(0.0, PATIENCE_S + 1.0)
    kept = Upkeep(database, monotonic=lambda: next(times))
    kept.step()
    while kept.step():
        pass


def _assert_counts_fit(mine: Stores) -> None:
    for shown in mine.grids.grids(10).items:
        assert sum(shown.counts.model_dump().values()) == shown.n_runs


@pytest.mark.parametrize("piece", [1, 2])
def test_the_queue_holds_its_promises_in_pieces(url: str, piece: int, monkeypatch: pytest.MonkeyPatch) -> None:
    cut(monkeypatch, piece)
    monkeypatch.setattr(pieces, "_TURN_S", 0.0)
    # What is left where an answer is lost between two pieces is looked at above; here all of them are made.
    assert check(url, examples=4, steps=40, shrink=False, pieces=True) >= 100


def test_others_write_between_the_pieces_of_sqlite(sqlite_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever waits sleeps up to 0.1 s between two looks, so a shorter gap would pass unseen."""
    cut(monkeypatch, 1)
    database, other = Database(sqlite_url), Database(sqlite_url)
    grids = GridStore(database)
    grid_id = submit(grids, 10)
    over = Event()
    written = []

    def write() -> None:
        while not over.is_set():
            with other.write() as connection:
                left = connection.scalar(select(func.count()).where(run.c.state == "queued"))
            written.append(left)

    writer = Thread(target=write)
    writer.start()
    grids.cancel(grid_id)
    over.set()
    writer.join()
    # It wrote while some were still queued and others not.
    assert len(set(written) & set(range(1, 10))) >= 5
    database.close()
    other.close()


class Statements:
    """What is sent to a database."""

    def __init__(self, database: Database) -> None:
        self._engine = database.engine
        self.sent: list[tuple[str, Any]] = []

    def __enter__(self) -> Statements:
        listen(self._engine, "before_cursor_execute", self._note)
        return self

    def __exit__(self, *_: object) -> None:
        remove(self._engine, "before_cursor_execute", self._note)

    def _note(self, _c: Connection, _cursor: Any, statement: str, parameters: Any, _context: Any, _many: bool) -> None:
        self.sent.append((statement, parameters))


def test_a_list_of_open_grids_takes_as_many_statements_for_forty_as_for_two(
    database: Database, grids: GridStore
) -> None:
    queue = RunQueue(database)
    for seed in range(40):
        submit(grids, 2, seed=10 * seed)
    generation = Leadership(database).take("me") or 0
    for lease in queue.claim(generation, 60):
        queue.fail(lease, BROKEN)
    sent = {}
    for limit in (2, 40):
        with Statements(database) as statements:
            page = grids.grids(limit)
        sent[limit] = len(statements.sent)
        assert len(page.items) == limit
    assert sent[2] == sent[40]
    # The newest were not begun, of the oldest both runs have ended.
    assert page.items[0].rate_per_s is None
    assert {shown.counts.failed for shown in page.items} == {0, 2}
    with_rate = grids.grid(page.items[-1].id)
    assert with_rate.rate_per_s == page.items[-1].rate_per_s is not None


LOOKS: dict[str, Callable[[Database, int], object]] = {
    "take-over": lambda database, _: Leadership(database).take("next", lambda _: True),
    "claim": lambda database, generation: RunQueue(database).claim(generation, 2, "e" * 64),
    "waiting": lambda database, _: RunQueue(database).waiting("e" * 64),
    "forgotten": lambda database, generation: RunQueue(database).requeue_forgotten(generation, []),
    "to cancel": lambda database, generation: RunQueue(database).to_cancel(generation),
    "post-dated": lambda database, _: RunQueue(database).release_postdated(),
    "depth": lambda database, _: QueueDepth(database).look(),
    "upkeep": lambda database, _: Upkeep(database).step(),
    "list": lambda database, _: GridStore(database).grids(100),
    "cancel": lambda database, _: GridStore(database).cancel(GridStore(database).grids(1).items[0].id),
    "close": lambda database, _: GridStore(database).revive(GridStore(database).grids(100).items[-1].id),
}


@pytest.mark.parametrize("look", LOOKS)
def test_no_look_at_the_queue_goes_through_all_runs(database: Database, grids: GridStore, look: str) -> None:
    """By the plans of the databases; PostgreSQL scans small tables unless told not to."""
    generation = Leadership(database).take("me") or 0
    queue = RunQueue(database)
    done = submit(grids, 300)
    with database.write() as connection:
        connection.execute(run.update().where(run.c.grid_id == done).values(state="cancelled"))
        connection.execute(grid.update().where(grid.c.id == done).values(state="cancelled"))
    for seed in (1000, 2000, 3000):
        submit(grids, 5, seed=seed)
    queue.claim(generation, 4)
    with database.engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
        connection.execute(text("ANALYZE"))
    with Statements(database) as statements:
        LOOKS[look](database, generation)
    for statement, parameters in statements.sent:
        if " run" in statement and not statement.startswith(("INSERT", "EXPLAIN")):
            lines = _plan(database, statement, parameters)
            assert not [line for line in lines if _is_scan(line)], (lines, statement)
            if "run.state = 'leased'" in statement and "JOIN" not in statement:
                # The leases, or those runs that are named.
                named = ("ix_run_leased", "(id=?)", "pk_run")
                assert any(index in line for index in named for line in lines), (lines, statement)


def _plan(database: Database, statement: str, parameters: Any) -> list[str]:
    with database.engine.connect() as connection:
        if database.is_sqlite:
            rows = connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {statement}", parameters).all()
            return [str(row[-1]) for row in rows]
        connection.exec_driver_sql("SET LOCAL enable_seqscan = off")
        return [str(row[0]) for row in connection.exec_driver_sql(f"EXPLAIN {statement}", parameters)]


def _is_scan(line: str) -> bool:
    """Whether a table of runs is gone through from end to end, by rows or by an index that has all of them."""
    if "Seq Scan on run" in line:
        return True
    partial = ("ix_run_queue", "ix_run_leased", "ix_run_suspect")
    return line.startswith("SCAN run") and not any(name in line for name in partial)


def test_a_large_grid_is_counted_and_checked_without_being_planned(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[object] = []
    monkeypatch.setattr("service.domain.requests._planned", lambda one: made.append(one) or one)
    free = {"systems": ["HE0435", "RXJ1131"], "l_eta": [0.8, 1.0], "mass_model": "recommended"}
    lists = {"n": [1 + i / 100 for i in range(100)], "r_eff": [0.3], "magnitude": [20 + i / 100 for i in range(100)]}
    counted = plan(GridRequest.model_validate({**free, **lists, "replicates": 2}), 100_000)
    assert len(counted) == 80_000
    assert made == []
    cut_short = plan(GridRequest.model_validate({**free, **lists, "n": [1.0], "magnitude": [20, 21]}), 100_000)
    assert len(list(cut_short)) == len(cut_short) == 8 == len(made)
