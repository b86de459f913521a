"""What comes of runs, through the dispatcher's loop: stored once, whatever answer is lost and whatever is refused."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import Connection
from sqlalchemy.exc import DataError, IntegrityError, OperationalError, ProgrammingError, StatementError

from engine import engine_digest
from service.dispatcher.outcomes import OtherEngine, judge_answer
from service.domain.payload import InvalidResultError, read_payload
from service.domain.states import GridState
from service.store.database import Database
from service.store.leadership import Leadership
from service.store.leases import Lease, Outcome, end_attempts, leased_by
from service.store.queue import Failure, RunQueue
from service.worker.answers import to_bytes
from tests.service.plans import body, planned, result_of
from tests.service.queue_model import Forgetful
from tests.service.tasks import synthetic_payload
from tests.service.test_dispatcher import InstantPool, Setting, outcomes


@pytest.fixture(autouse=True)
def no_sleep(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOSTLENS_DRILL_SLEEP", "0")


@pytest.fixture
def forgetful(url: str) -> Iterator[Forgetful]:
    found = Forgetful(url)
    yield found
    found.close()


def look_anew(setting: Setting) -> None:
    """Let the next step look at what was cancelled, and the next reconciliation be due."""
    setting.dispatcher._due.clear()


def test_a_cancellation_whose_answer_is_lost_and_a_retry_wedge_nothing(forgetful: Forgetful, tmp_path: Path) -> None:
    """The old A and the new B, which was claimed together with the new A, end at the same time."""
    pool = InstantPool(tmp_path, *["pending"] * 3)
    setting = Setting(forgetful, pool, runs=2, window=1)
    setting.run(until=lambda: len(pool.submitted) == 1)
    setting.grids.cancel(setting.grid_id)
    look_anew(setting)

    class LosesTheAnswer(RunQueue):
        def cancel_leased(self, lease: Lease) -> bool:
            forgetful.loses, self.__class__ = True, type(setting.queue)  # type: ignore[assignment]
            return super().cancel_leased(lease)

    was = setting.queue.__class__
    setting.queue.__class__ = LosesTheAnswer  # type: ignore[assignment]
    setting.run(
        until=lambda: setting.queue.__class__ is was or setting.grids.grid(setting.grid_id).finished_at is not None
    )
    setting.queue.__class__ = was
    assert setting.grids.grid(setting.grid_id).counts.cancelled == 2
    assert setting.grids.revive(setting.grid_id) == 2
    setting.dispatcher._claims._window = None
    setting.run(until=lambda: len(pool.submitted) == 3)
    assert len({lease.token for _, lease in pool.placed[1:]}) == 1, "one claim took both"
    for future in (pool.futures[0], pool.futures[2]):
        future.finish(tmp_path)
    setting.run(steps=5)
    pool.futures[1].finish(tmp_path)
    setting.run()
    assert setting.grids.grid(setting.grid_id).state is GridState.DONE
    assert sorted(outcomes(setting)) == [["cancelled", "done"], ["done"]]
    assert Leadership(forgetful).take("next", lambda _: True) == 2


REFUSALS = [
    DataError("INSERT", {}, Exception("numeric value out of range")),
    IntegrityError("INSERT", {}, Exception("duplicate key")),
    ProgrammingError("INSERT", {}, Exception("can't adapt type")),
    StatementError("a value is required", "INSERT", {}, Exception("for a parameter")),
    TypeError("not a number"),
    OverflowError("Python int too large to convert to SQLite INTEGER"),
]


@pytest.mark.parametrize("refusal", REFUSALS, ids=lambda error: type(error).__name__)
@pytest.mark.parametrize(
    "method", ["store_all", "fail", "refuse_engine", "suspect", "hand_back", "requeue_lost", "cancel_leased"]
)
def test_an_ending_that_the_database_refuses_is_set_aside_and_the_loop_goes_on(
    sqlite_url: str, tmp_path: Path, method: str, refusal: Exception
) -> None:
    """Of four runs one is poison: whatever ends it is refused, and so is to fail it."""
    database = Database(sqlite_url)
    setting = Setting(database, InstantPool(tmp_path, *["pending"] * 4, threads=2), runs=4)
    setting.run(until=lambda: len(setting.pool.submitted) == 4)
    leases = [lease for _, lease in setting.pool.placed]
    poison = leases[1]

    def refuses(original: Any) -> Any:
        def call(first: Any, *rest: Any) -> Any:
            concerned = first if isinstance(first, list) else [first]
            if any(poison in (one, one[0] if isinstance(one, tuple) else one) for one in concerned):
                raise refusal
            return original(first, *rest)

        return call

    for name in {method, "fail"}:
        setattr(setting.queue, name, refuses(getattr(setting.queue, name)))
    endings, flights = setting.dispatcher._endings, setting.dispatcher._flights
    flights.clear()
    if method == "store_all":
        endings.store([(lease, result_of(lease)) for lease in leases])
    elif method in {"suspect", "hand_back"}:
        more: Any = "one of four" if method == "suspect" else Outcome.HANDED_BACK
        getattr(endings, method)(leases, more)
    else:
        more = {
            "fail": [Failure(Outcome.ERROR, "error", "broken", 0)],
            "refuse_engine": ["0" * 64],
            "requeue_lost": ["gone"],
            "cancel_leased": [],
        }[method]
        name = {"requeue_lost": "lose", "cancel_leased": "cancel"}.get(method, method)
        for lease in leases:
            getattr(endings, name)(lease, *more)
    endings.write()
    assert len(endings) == 0
    found = setting.grids.run(poison.run_id)
    assert (found.state, found.error and found.error.code) == ("quarantined", "ending_refused")
    assert found.error is not None
    assert type(refusal).__name__ in (found.error.detail or "")
    counts = setting.grids.grid(setting.grid_id).counts
    assert (counts.quarantined, counts.leased) == (1, 0)
    assert setting.dispatcher._metrics.registry.get_sample_value("hostlens_database_refusals_total", {"what": "ending"})
    database.close()


def test_a_database_that_is_away_in_the_middle_of_endings_that_are_tried_alone_loses_none(
    sqlite_url: str, tmp_path: Path
) -> None:
    database = Database(sqlite_url)
    setting = Setting(database, InstantPool(tmp_path, *["pending"] * 4, threads=2), runs=4)
    setting.run(until=lambda: len(setting.pool.submitted) == 4)
    leases = [lease for _, lease in setting.pool.placed]
    calls: list[int] = []
    stores = setting.queue.store_all

    def fussy(results: Sequence[Any]) -> Any:
        calls.append(len(results))
        if len(results) > 1:
            raise DataError("INSERT", {}, Exception("one of them"))
        if len(calls) == 3:
            raise OperationalError("INSERT", {}, Exception("away"))
        return stores(results)

    setting.queue.store_all = fussy  # type: ignore[method-assign]
    setting.dispatcher._flights.clear()
    setting.dispatcher._endings.store([(lease, result_of(lease)) for lease in leases])
    with pytest.raises(OperationalError):
        setting.dispatcher._endings.write()
    setting.dispatcher._endings.write()
    assert setting.grids.grid(setting.grid_id).counts.done == 4
    database.close()


def test_a_lease_that_nothing_can_end_stops_neither_the_dispatcher_nor_the_next_one(url: str, tmp_path: Path) -> None:
    """An attempt that is under way is on record as ended: store, fail and requeue are refused alike."""
    database = Database(url)
    pool = InstantPool(tmp_path, "pending", "pending")
    setting = Setting(database, pool, runs=4)
    setting.run(until=lambda: len(pool.submitted) == 2)
    poison = pool.placed[0][1]
    with database.write() as connection:
        end_attempts(connection, leased_by(connection, [poison]), Outcome.DONE, setting.queue._clock())
    for future in pool.futures:
        future.finish(tmp_path)
    setting.run()
    counts = setting.grids.grid(setting.grid_id).counts
    assert (counts.done, counts.quarantined) == (3, 1)
    assert setting.grids.revive(setting.grid_id) == 1
    setting.run()
    assert setting.grids.grid(setting.grid_id).state is GridState.DONE
    database.close()


def test_a_step_that_the_database_refuses_keeps_no_result_waiting(sqlite_url: str, tmp_path: Path) -> None:
    database = Database(sqlite_url)
    pool = InstantPool(tmp_path, "pending", "pending")
    setting = Setting(database, pool, runs=2, reconcile_s=0.001)
    setting.run(until=lambda: len(pool.submitted) == 2)

    def refused(*_: Any, **__: Any) -> Any:
        raise ProgrammingError("SELECT", {}, Exception("no such column"))

    for name in ("claim", "waiting", "to_cancel", "held", "release_postdated"):
        setattr(setting.queue, name, refused)
    look_anew(setting)
    for future in pool.futures:
        future.finish(tmp_path)
    setting.run()
    assert setting.grids.grid(setting.grid_id).counts.done == 2
    database.close()


class Away(Database):
    """A database that is away from its ``after``-th transaction of a kind on, until it is told to be back."""

    after: int | None = None

    @contextmanager
    def read(self) -> Iterator[Connection]:
        self._ask()
        with super().read() as connection:
            yield connection

    @contextmanager
    def write(self) -> Iterator[Connection]:
        self._ask()
        with super().write() as connection:
            yield connection

    def _ask(self) -> None:
        if self.after is not None:
            self.after -= 1
            if self.after < 0:
                raise OperationalError("BEGIN", {}, Exception("the database is away"))


def test_a_run_whose_lease_has_ended_without_the_dispatcher_is_stopped(sqlite_url: str, tmp_path: Path) -> None:
    database = Database(sqlite_url)
    pool = InstantPool(tmp_path, "pending", "pending")
    setting = Setting(database, pool, runs=2, reconcile_s=0.001)
    setting.run(until=lambda: len(pool.submitted) == 2)
    RunQueue(database).hand_back([pool.placed[0][1]])
    setting.run(until=lambda: len(pool.submitted) == 3)
    assert pool.stopped == [pool.futures[0]]
    for future in pool.futures[1:]:
        future.finish(tmp_path)
    setting.run()
    assert setting.grids.grid(setting.grid_id).counts.done == 2
    database.close()


HOSTILE = [
    {"code": "a\x00b", "message": "m\x00", "permanent": True},
    {"code": "c" * 5000, "message": "m" * 100_000, "permanent": True},
    {"code": "\ud800", "message": "\udfff", "permanent": True},
    {"code": "\N{RIGHT-TO-LEFT OVERRIDE}x", "message": {"nested": ["\x00"]}, "permanent": True},
    {"code": 7, "message": 7, "permanent": 7},
    {"code": ["list"], "permanent": True},
    {"message": "no code", "permanent": True},
    {"permanent": True},
    {"code": ""},
    {},
    None,
    "text",
    ["list"],
    7,
]


@pytest.mark.parametrize("error", HOSTILE, ids=lambda error: ascii(error)[:40])
def test_whatever_a_worker_calls_an_error_ends_its_run_on_every_database(
    url: str, tmp_path: Path, error: object
) -> None:
    database = Database(url)
    pool = InstantPool(tmp_path, "pending")
    setting = Setting(database, pool, runs=1)
    setting.run(until=lambda: len(pool.submitted) == 1)
    pool.futures[0].status = "finished"
    pool.futures[0]._answers = to_bytes({"answers": [{"error": error, "engine": engine_digest()}]})
    pool.futures[0]._told(pool.futures[0])
    setting.run()
    (found,) = setting.grids.runs(setting.grid_id, 10).items
    assert found.state == "failed"
    assert found.error is not None
    assert 0 < len(found.error.code) <= 64
    assert "\x00" not in found.error.code
    database.close()


def a_lease(engine: str | None = None) -> Lease:
    run = planned(1)[0]
    return Lease("r", "g", 1, "t", 1, run.digest, run.spec, None, engine)  # type: ignore[arg-type]


@pytest.mark.parametrize("permanent", [None, 1, "yes", [True], False])
def test_nothing_but_a_plain_yes_forbids_another_attempt(permanent: object) -> None:
    ending = judge_answer(a_lease(), {"error": {"code": "error", "message": "", "permanent": permanent}})
    assert isinstance(ending, Failure)
    assert ending.retries == 2
    ending = judge_answer(a_lease(), {"error": {"code": "error", "message": ""}})
    assert isinstance(ending, Failure)
    assert ending.retries == 2


@pytest.mark.parametrize("engine", [None, 7, "\x00" * 100, {"a": 1}, "x" * 10_000])
def test_an_engine_that_is_no_digest_is_another_engine(engine: object) -> None:
    ending = judge_answer(a_lease("e" * 64), {"payload": {}, "engine": engine})
    assert isinstance(ending, OtherEngine)
    assert len(ending.digest) <= 64
    assert "\x00" not in ending.digest


@pytest.mark.parametrize(
    "change",
    [
        {"versions": {"numpy": "1\x00"}},
        {"versions": {"num\x00py": "1"}},
        {"versions": {str(number): "1" for number in range(10_000)}},
        {"warnings": ["\x00"]},
        {"warnings": ["w"] * 10_000},
        {"noise_treatment": "\x00"},
        {"stages": [{"stage": "\x00", "wall_s": 1.0, "cpu_s": 1.0}]},
        {"lens": {"theta_E": {"mean": 1e300, "sd": 1.0}}},
    ],
    ids=lambda change: next(iter(change)),
)
def test_a_payload_that_a_database_could_not_hold_is_refused_at_the_door(change: dict[str, Any]) -> None:
    good = synthetic_payload(planned(1)[0].spec)
    read_payload(good)
    with pytest.raises(InvalidResultError):
        read_payload({**good, **change})


def test_suspects_of_two_engines_take_turns_and_neither_clears_the_other_s_lane(
    sqlite_url: str, tmp_path: Path
) -> None:
    class TwoEngines(InstantPool):
        def workers(self) -> Any:
            from dataclasses import replace

            first, second = super().workers()
            return [first, replace(second, engine="f" * 64)]

    database = Database(sqlite_url)
    pool = TwoEngines(tmp_path)
    setting = Setting(database, pool, runs=3, engine=engine_digest())
    other = setting.grids.create(body(3, 50), lambda: planned(3, 50), engine="f" * 64).grid.id
    for engine in (engine_digest(), "f" * 64):
        setting.queue.suspect(setting.queue.claim(1, 3, engine), "each may have done it")
    served: list[str] = []
    submits = pool.submit

    def noted(lease: Lease, worker: Any) -> Any:
        served.append(worker.engine[:1])
        future = submits(lease, worker)
        future._answers = to_bytes({"answer": {**json.loads(future._answers)["answer"], "engine": worker.engine}})
        return future

    pool.submit = noted  # type: ignore[method-assign]
    setting.run(
        until=lambda: all(setting.grids.grid(each).finished_at is not None for each in (setting.grid_id, other)),
        steps=2000,  # a look for suspects is due each second
    )
    assert setting.grids.grid(setting.grid_id).counts.done == setting.grids.grid(other).counts.done == 3
    # Neither engine has to wait until the other has no suspect left.
    assert len(set(served[:3])) == 2
    database.close()
