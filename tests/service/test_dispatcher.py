"""The dispatcher's loop against a pool that answers at once and a database that comes and goes."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import pytest
from distributed import KilledWorker
from distributed.client import ClosedClientError
from sqlalchemy.exc import DataError, InternalError, OperationalError, StatementError

from engine import engine_digest
from service.dispatcher.attribution import Deaths
from service.dispatcher.heartbeat import Heartbeat
from service.dispatcher.loop import Dispatcher
from service.dispatcher.pool import Pool, Worker
from service.dispatcher.stalls import Stall, WorkerMemory
from service.domain.payload import ResultPayload
from service.domain.states import GridState
from service.runtime.settings import Settings
from service.store.database import Database
from service.store.grids import GridStore
from service.store.leadership import Leadership, LeadershipLostError
from service.store.leases import Lease
from service.store.queue import RunQueue, Stored
from service.worker.tasks import answer_run
from tests.service.plans import body, planned
from tests.service.service_process import eventually


class Answered:
    """A Dask future that has its answer already, or never gets one."""

    def __init__(self, lease: Lease, status: str, task: str = "tests.service.tasks:fast") -> None:
        self._task = task
        self.key = lease.key
        self.status = status
        self._spec = lease.spec
        self._answers: Any = None
        self._told: Callable[[Any], None] = lambda _: None

    def add_done_callback(self, told: Callable[[Any], None]) -> None:
        self._told = told
        if self.done() and self.status not in {"lost", "cancelled"}:
            told(self)

    def answer(self, folder: Path) -> None:
        """It has run."""
        self._answers = answer_run(self._task, self._spec, str(folder))
        self.status = "finished"

    def kill(self) -> None:
        """Its worker dies."""
        self.status = "error"
        self._told(self)

    def finish(self, folder: Path) -> None:
        """It ends well, if it has not ended."""
        if self.status == "pending":
            self.answer(folder)
            self._told(self)

    def exception(self, timeout: float) -> BaseException:
        return KilledWorker(self.key, None, 0)

    def result(self, timeout: float) -> Any:
        return self._answers

    def done(self) -> bool:
        return self.status != "pending"

    def cancel(self) -> None:
        self.status = "cancelled"


class InstantPool:
    """Runs everything at once in this thread; ``statuses`` makes the first runs end otherwise."""

    running = True
    task = "tests.service.tasks:fast"

    def __init__(self, folder: Path, *statuses: str, threads: int = 1) -> None:
        self.folder = folder
        self.statuses = list(statuses)
        self.threads = threads
        self.addresses = ["a", "b"]
        self.engine = engine_digest()
        self.stopped: list[Any] = []
        self.submitted: list[str] = []
        self.placed: list[tuple[str, Lease]] = []
        self.futures: list[Answered] = []

    def workers(self) -> list[Worker]:
        return [Worker(address, self.threads, self.engine, 0.0) for address in self.addresses]

    def present(self) -> list[str]:
        return self.addresses

    def submit(self, lease: Lease, worker: Worker) -> Answered:
        self.submitted.append(lease.run_id)
        self.placed.append((worker.address, lease))
        future = Answered(lease, self.statuses.pop(0) if self.statuses else "finished", self.task)
        if future.status == "finished":
            future.answer(self.folder)
        self.futures.append(future)
        return future

    def stop(self, addresses: Iterable[str], futures: Iterable[Any] = ()) -> None:
        self.stopped += futures

    def forget(self, address: str) -> None:
        pass

    def was_stopped(self, address: str) -> bool:
        return False

    def stalled(self, busy: Mapping[str, float]) -> list[Stall]:
        return []

    def memory_kill(self, memory: WorkerMemory) -> int | None:
        return None

    def closed_on_purpose(self, address: str) -> bool:
        return False


class ShakyQueue(RunQueue):
    """A queue whose database is away when results come."""

    away = 0
    events: list[str]

    def claim(self, generation: int, limit: int, engine: str | None = None, *, suspects: bool = False) -> list[Lease]:
        self.events.append("claim")
        return super().claim(generation, limit, engine, suspects=suspects)

    def store_all(self, results: Sequence[tuple[Lease, ResultPayload]]) -> list[Stored]:
        if self.away:
            self.away -= 1
            self.events.append("away")
            raise OperationalError("INSERT", {}, Exception("the database is away"))
        self.events.append("store")
        return super().store_all(results)


@pytest.fixture(autouse=True)
def no_sleep(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOSTLENS_DRILL_SLEEP", "0")


@pytest.fixture
def database(sqlite_url: str) -> Iterator[Database]:
    found = Database(sqlite_url)
    yield found
    found.close()


class Setting:
    """A grid, a queue and a dispatcher that stops when the grid has ended."""

    def __init__(
        self, database: Database, pool: InstantPool, runs: int, engine: str | None = None, **settings: Any
    ) -> None:
        self.grids = GridStore(database)
        self.grid_id = self.grids.create(body(runs), lambda: planned(runs), engine=engine).grid.id
        self.queue = ShakyQueue(database, retry_delay_s=0.01)
        self.queue.events = []
        self.leadership = Leadership(database)
        generation = self.leadership.take("test")
        assert generation == 1
        self.pool = pool
        self.heartbeat: Any = SimpleNamespace(engines={}, lost=Event())
        chosen = Settings(poll_s=0.01, data_dir=pool.folder, **settings)
        self.dispatcher = Dispatcher(chosen, self.queue, self.heartbeat, generation)
        self.dispatcher._blame.deaths = Deaths(judge_after_s=0.05)

    def run(self, until: Callable[[], bool] | None = None, steps: int = 200) -> None:
        looks = iter(range(steps))
        ended = until or (lambda: self.grids.grid(self.grid_id).finished_at is not None)
        stop: Any = SimpleNamespace(is_set=lambda: next(looks, None) is None or ended(), wait=lambda _: None)
        # Where every worker is busy the loop waits so long for one that is not, and here nobody comes meanwhile.
        with patch("service.dispatcher.loop._LOOK_S", 0.02):
            self.dispatcher.run(self.pool, stop)  # type: ignore[arg-type]


def test_a_result_is_kept_while_the_database_is_away_and_nothing_is_claimed_meanwhile(
    database: Database, tmp_path: Path
) -> None:
    setting = Setting(database, InstantPool(tmp_path), runs=6)
    setting.queue.away = 3
    setting.run()
    assert setting.grids.grid(setting.grid_id).state is GridState.DONE
    assert len(setting.pool.submitted) == len(set(setting.pool.submitted)) == 6
    assert setting.queue.events[:7] == ["claim", "claim", "away", "away", "away", "store", "claim"]


def test_a_dispatcher_outlives_the_moment_in_which_dasks_client_closes_itself(
    database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def closed(_: Answered) -> None:
        raise ClosedClientError("Client is closed. Can't send cancel-keys message.")

    monkeypatch.setattr(Answered, "cancel", closed)
    setting = Setting(database, InstantPool(tmp_path, "lost", "cancelled"), runs=3, reconcile_s=0.02)
    setting.run()
    assert setting.grids.grid(setting.grid_id).counts.done == 3


def test_a_run_that_dask_has_lost_is_run_again_uncharged(database: Database, tmp_path: Path) -> None:
    setting = Setting(database, InstantPool(tmp_path, "lost", "cancelled"), runs=3, reconcile_s=0.02)
    setting.run()
    assert setting.grids.grid(setting.grid_id).counts.done == 3
    outcomes = [
        end.outcome
        for run in setting.grids.runs(setting.grid_id, 10).items
        for end in setting.grids.run(run.id).attempts
    ]
    assert sorted(outcomes) == ["done", "done", "done", "forgotten", "forgotten"]


def test_a_run_past_its_deadline_is_stopped_and_tried_once_more(database: Database, tmp_path: Path) -> None:
    pool = InstantPool(tmp_path, "pending", "pending")
    setting = Setting(database, pool, runs=1, reconcile_s=0.02, deadline_s=0.05)
    setting.run()
    assert len(pool.stopped) == 2
    (run,) = setting.grids.runs(setting.grid_id, 10).items
    assert (run.state, run.error and run.error.code, run.attempt) == ("failed", "deadline", 2)


def test_workers_that_are_away_for_a_moment_keep_their_runs_and_ones_that_stay_away_lose_them(
    database: Database, tmp_path: Path
) -> None:
    pool = InstantPool(tmp_path, "pending", "pending")
    setting = Setting(database, pool, runs=2, reconcile_s=0.001)
    setting.run(until=lambda: len(pool.submitted) == 2)
    pool.addresses = []
    setting.run(steps=2)
    pool.addresses = ["a", "b"]
    setting.run(steps=1)
    assert setting.grids.grid(setting.grid_id).counts.leased == 2
    pool.addresses = []
    setting.run(steps=4)
    assert setting.grids.grid(setting.grid_id).counts.queued == 2
    pool.addresses = ["c", "d"]
    setting.run()
    assert setting.grids.grid(setting.grid_id).counts.done == 2


def outcomes(setting: Setting) -> list[list[str]]:
    runs = setting.grids.runs(setting.grid_id, 100).items
    return [[end.outcome for end in setting.grids.run(run.id).attempts] for run in runs]


def test_a_run_alone_on_a_worker_that_died_is_charged_and_tried_again_alone(database: Database, tmp_path: Path) -> None:
    pool = InstantPool(tmp_path, "error")
    setting = Setting(database, pool, runs=4)
    setting.run()
    assert setting.grids.grid(setting.grid_id).counts.done == 4
    assert outcomes(setting) == [["worker_lost", "done"], ["done"], ["done"], ["done"]]
    assert [lease.attempt for _, lease in pool.placed if lease.suspect] == [2]


def test_runs_that_shared_a_dead_worker_are_charged_nothing_and_run_one_at_a_time_alone(
    database: Database, tmp_path: Path
) -> None:
    pool = InstantPool(tmp_path, *["pending"] * 6, threads=3)
    setting = Setting(database, pool, runs=8)
    setting.run(until=lambda: len(pool.submitted) == 6)
    for (address, _), future in list(zip(pool.placed, pool.futures, strict=True)):
        if address == "a":
            future.kill()
    pool.statuses = ["finished", "finished", "pending"]
    # The two that were never started go to the free places at once; then a suspect gets the worker for itself.
    setting.run(until=lambda: len(pool.submitted) == 9, steps=2000)
    assert [lease.suspect for _, lease in pool.placed[6:]] == [False, False, True]
    assert pool.placed[8][0] == "a"
    setting.run(steps=3)
    assert len(pool.submitted) == 9, "a second suspect was started beside the first"
    for future in pool.futures:
        future.finish(tmp_path)
    setting.run()
    assert setting.grids.grid(setting.grid_id).counts.done == 8
    assert sorted(outcomes(setting)) == [["done"]] * 5 + [["suspected", "done"]] * 3


def test_a_run_that_had_ended_on_a_worker_that_the_next_one_killed_is_not_suspected(
    database: Database, tmp_path: Path
) -> None:
    class Unreachable(InstantPool):
        """The answer of the first run never comes: its worker is at the second, which kills it."""

        def submit(self, lease: Lease, worker: Worker) -> Answered:
            future = super().submit(lease, worker)
            if len(self.futures) == 1:
                future.result = self._no_answer  # type: ignore[method-assign]
            return future

        def _no_answer(self, timeout: float) -> Any:
            for second in self.futures[1:2]:
                second.kill()
            raise TimeoutError

    pool = Unreachable(tmp_path, "pending", "pending")
    pool.addresses = ["a"]
    setting = Setting(database, pool, runs=2)
    setting.run(until=lambda: len(pool.submitted) == 1)
    pool.futures[0].finish(tmp_path)
    setting.run(steps=2000)
    assert setting.grids.grid(setting.grid_id).counts.done == 2
    assert outcomes(setting) == [["forgotten", "done"], ["worker_lost", "done"]]


def test_runs_of_workers_that_died_in_the_same_moment_are_charged_nothing(database: Database, tmp_path: Path) -> None:
    setting = Setting(database, InstantPool(tmp_path, "error", "error"), runs=3)
    setting.run()
    assert setting.grids.grid(setting.grid_id).counts.done == 3
    assert outcomes(setting) == [["suspected", "done"], ["suspected", "done"], ["done"]]


def test_a_run_that_kills_three_workers_is_quarantined_and_no_other_is_charged(
    database: Database, tmp_path: Path
) -> None:
    class Poisoned(InstantPool):
        def submit(self, lease: Lease, worker: Worker) -> Answered:
            self.statuses = ["error" if lease.run_id.endswith("1") else "finished"]
            return super().submit(lease, worker)

    setting = Setting(database, Poisoned(tmp_path), runs=5)
    setting.run(steps=2000)
    counts = setting.grids.grid(setting.grid_id).counts
    assert (counts.done, counts.quarantined) == (4, 1)
    assert outcomes(setting) == [["done"], ["worker_lost"] * 3, ["done"], ["done"], ["done"]]


def test_the_next_run_is_given_to_a_worker_before_the_last_one_s_answer_is_stored(
    database: Database, tmp_path: Path
) -> None:
    class Noted(InstantPool):
        def submit(self, lease: Lease, worker: Worker) -> Answered:
            setting.queue.events.append("submit")
            return super().submit(lease, worker)

    setting = Setting(database, Noted(tmp_path), runs=6)
    setting.run()
    round_ = ["claim", *["submit"] * 2]
    assert setting.queue.events == [*round_, *round_, "store", *round_, "store", "store"]
    assert setting.grids.grid(setting.grid_id).counts.done == 6


def test_the_worker_of_each_cancelled_run_is_stopped_though_the_database_goes_away_in_between(
    database: Database, tmp_path: Path
) -> None:
    class Failing(ShakyQueue):
        def cancel_leased(self, lease: Lease) -> bool:
            if self.away == 1:
                self.away = 0
                raise OperationalError("UPDATE", {}, Exception("the database is away"))
            self.away += len(self.events) > 0 and self.events[-1] == "claim"
            self.events.append("cancelled")
            return super().cancel_leased(lease)

    pool = InstantPool(tmp_path, "pending", "pending")
    setting = Setting(database, pool, runs=2)
    setting.queue.__class__ = Failing
    setting.run(until=lambda: len(pool.submitted) == 2)
    setting.grids.cancel(setting.grid_id)
    setting.dispatcher._due.clear()
    setting.run(steps=3)
    setting.dispatcher._due.clear()
    setting.run(steps=3)
    assert setting.grids.grid(setting.grid_id).state is GridState.CANCELLED
    assert len(pool.stopped) == 2


def test_one_result_that_the_database_refuses_keeps_no_other_out(database: Database, tmp_path: Path) -> None:
    class Fussy(ShakyQueue):
        def store_all(self, results: Sequence[tuple[Lease, ResultPayload]]) -> list[Stored]:
            if any(lease.spec["seed"] == 3 for lease, _ in results):
                raise DataError("INSERT", {}, Exception("numeric value out of range"))
            return super().store_all(results)

    setting = Setting(database, InstantPool(tmp_path), runs=8)
    setting.queue.__class__ = Fussy
    setting.run()
    counts = setting.grids.grid(setting.grid_id).counts
    assert (counts.done, counts.failed) == (7, 1)


def test_a_result_that_cannot_even_be_handed_to_the_database_ends_its_run_and_not_the_dispatcher(
    database: Database, tmp_path: Path
) -> None:
    class Surprised(ShakyQueue):
        def store_all(self, results: Sequence[tuple[Lease, ResultPayload]]) -> list[Stored]:
            if any(lease.spec["seed"] == 1 for lease, _ in results):
                raise StatementError("a value is required", "INSERT", {}, Exception("for a parameter"))
            return super().store_all(results)

    setting = Setting(database, InstantPool(tmp_path), runs=3)
    setting.queue.__class__ = Surprised
    setting.run()
    counts = setting.grids.grid(setting.grid_id).counts
    assert (counts.done, counts.failed) == (2, 1)


def test_results_are_kept_while_the_database_is_a_read_only_replica(database: Database, tmp_path: Path) -> None:
    class ReadOnly(ShakyQueue):
        def store_all(self, results: Sequence[tuple[Lease, ResultPayload]]) -> list[Stored]:
            if self.away:
                self.away -= 1
                raise InternalError("INSERT", {}, Exception("cannot execute INSERT in a read-only transaction"))
            return super().store_all(results)

    setting = Setting(database, InstantPool(tmp_path), runs=2)
    setting.queue.__class__, setting.queue.away = ReadOnly, 2
    setting.run()
    assert setting.grids.grid(setting.grid_id).counts.done == 2
    assert len(setting.pool.submitted) == 2


def test_a_worker_that_died_where_another_was_told_to_go_before_has_died() -> None:
    """With fixed ports the next worker has the address of the last."""

    def closed(*actions: str) -> bool:
        client = SimpleNamespace(get_events=lambda _: [(0.0, {"action": action}) for action in actions])
        return Pool(client, Settings()).closed_on_purpose("tcp://worker:1")

    told_to_go = ("add-worker", "closing-worker", "remove-worker")
    assert closed(*told_to_go)
    assert closed(*told_to_go, "add-worker"), "the next has come before anybody asked"
    assert not closed(*told_to_go, "add-worker", "remove-worker")
    assert not closed(*told_to_go, "add-worker", "remove-worker", "add-worker")


def test_a_run_whose_worker_left_without_dask_blaming_it_goes_back_uncharged(
    database: Database, tmp_path: Path
) -> None:
    pool = InstantPool(tmp_path, "pending")
    setting = Setting(database, pool, runs=2)
    setting.run(until=lambda: len(pool.submitted) == 2)
    pool.addresses = ["b"]
    setting.run(steps=2000)
    assert outcomes(setting) == [["forgotten", "done"], ["done"]]


def test_a_worker_with_another_engine_gets_no_run_and_its_answer_is_not_taken(
    database: Database, tmp_path: Path
) -> None:
    pool = InstantPool(tmp_path)
    setting = Setting(database, pool, runs=1, engine="e" * 64)
    setting.run(steps=10)
    assert pool.submitted == []
    assert setting.heartbeat.engines == {engine_digest(): 2}
    pool.engine = "e" * 64  # what it said when it was greeted; what it answers with is another
    setting.run(steps=10)
    assert len(pool.submitted) >= 1
    assert {end for ends in outcomes(setting) for end in ends} == {"other_engine"}
    assert setting.grids.grid(setting.grid_id).counts.done == 0


def test_at_a_stop_runs_that_end_soon_are_waited_for(database: Database, tmp_path: Path) -> None:
    pool = InstantPool(tmp_path, "pending", "pending")
    setting = Setting(database, pool, runs=2, drain_s=120.0, stop_grace_s=150.0)
    setting.run(until=lambda: len(pool.submitted) == 2)
    threading.Timer(0.3, lambda: pool.futures[0].finish(tmp_path)).start()
    threading.Timer(0.6, lambda: pool.futures[1].finish(tmp_path)).start()
    began = time.monotonic()
    setting.dispatcher.drain()
    setting.dispatcher.hand_back()
    # Not for longer than they take: half of what it may wait leaves a busy machine its time.
    assert time.monotonic() - began < 60.0
    assert setting.grids.grid(setting.grid_id).counts.done == 2


def test_a_stop_hands_back_what_is_in_flight_and_writes_what_has_ended(database: Database, tmp_path: Path) -> None:
    setting = Setting(database, InstantPool(tmp_path, "pending"), runs=4)
    setting.run(until=lambda: len(setting.pool.submitted) >= 2)
    setting.dispatcher.hand_back()
    counts = setting.grids.grid(setting.grid_id).counts
    assert counts.leased == 0
    assert counts.done >= 1
    assert counts.done + counts.queued == 4


def test_a_deposed_dispatcher_stops(database: Database, tmp_path: Path) -> None:
    setting = Setting(database, InstantPool(tmp_path), runs=2)
    assert setting.leadership.take("next", lambda _: True) == 2
    with pytest.raises(LeadershipLostError):
        setting.run()
    assert setting.pool.submitted == []


def test_a_lost_heartbeat_ends_the_loop(database: Database, tmp_path: Path) -> None:
    setting = Setting(database, InstantPool(tmp_path), runs=2)
    setting.heartbeat.lost.set()
    setting.run()
    assert setting.pool.submitted == []


def test_a_heartbeat_outlasts_the_database_and_ends_once_another_leads(database: Database, tmp_path: Path) -> None:
    leadership = Leadership(database)
    generation = leadership.take("test")
    assert generation == 1
    file = Path(str(database.url.database))
    settings = Settings(database_url=f"sqlite:///{file}", heartbeat_s=0.05, leader_ttl_s=0.1)
    heartbeat = Heartbeat(settings, generation)
    hidden = file.with_name("hidden")
    database.close()
    file.rename(hidden)
    file.mkdir()  # SQLite cannot open it, and would make a new file where there is none
    heartbeat.start()
    assert not heartbeat.lost.wait(0.5)
    file.rmdir()
    hidden.rename(file)
    heartbeat.engines = {"e": 2}
    eventually(lambda: (view := leadership.view()) is not None and view.workers == 2, what="a beat")
    assert leadership.take("next", lambda _: True) == 2
    assert heartbeat.lost.wait(120)
    heartbeat.stop()


class StallingPool(InstantPool):
    """A pool one of whose workers takes no work, or was ended by its nanny for its memory."""

    def __init__(self, folder: Path, *statuses: str, threads: int = 1) -> None:
        super().__init__(folder, *statuses, threads=threads)
        self.memory = {address: WorkerMemory(1, 200, 200, 1000, 0.8) for address in self.addresses}
        self.stalls: list[Stall] = []
        self.killed_at: int | None = None

    def workers(self) -> list[Worker]:
        return [Worker(worker, self.threads, self.engine, 0.0, self.memory[worker]) for worker in self.addresses]

    def stalled(self, busy: Mapping[str, float]) -> list[Stall]:
        stalls, self.stalls = self.stalls, []
        return stalls

    def memory_kill(self, memory: WorkerMemory) -> int | None:
        return self.killed_at


@pytest.mark.parametrize(
    ("stall", "latest", "first"),
    [
        (Stall("a", "paused", begun=True, memory=900), 200, "worker_lost"),
        (Stall("a", "paused", begun=True, memory=900), 600, "stalled"),
        (Stall("a", "paused", begun=True, memory=900), None, "stalled"),
        (Stall("a", "paused", begun=False, memory=900), 200, "stalled"),
        (Stall("a", "not_started", begun=False, memory=900), 200, "stalled"),
        (Stall("a", "closing", begun=False, memory=0), 200, "stalled"),
        (Stall("a", "silent", begun=True, memory=900), 200, "worker_lost"),
    ],
)
def test_of_runs_on_a_worker_that_takes_no_work_only_one_that_filled_it_or_silenced_it_is_charged(
    database: Database, tmp_path: Path, stall: Stall, latest: int | None, first: str
) -> None:
    pool = StallingPool(tmp_path, "pending")
    pool.memory["a"].latest = latest
    setting = Setting(database, pool, runs=2)
    setting.run(until=lambda: len(pool.submitted) == 2)
    pool.stalls = [stall]
    setting.run(steps=2000)
    assert setting.grids.grid(setting.grid_id).counts.done == 2
    assert outcomes(setting) == [[first, "done"], ["done"]]
    assert pool.stopped == pool.futures[:1]


def test_runs_beside_each_other_on_a_worker_whose_memory_is_full_are_suspects(
    database: Database, tmp_path: Path
) -> None:
    pool = StallingPool(tmp_path, "pending", "pending", threads=2)
    pool.addresses = ["a"]
    setting = Setting(database, pool, runs=2)
    setting.run(until=lambda: len(pool.submitted) == 2)
    pool.stalls = [Stall("a", "paused", begun=True, memory=900)]
    setting.run(steps=2000)
    assert outcomes(setting) == [["suspected", "done"]] * 2


@pytest.mark.parametrize(("latest", "outcome"), [(200, "worker_lost"), (600, "stalled")])
def test_each_of_two_runs_whose_workers_were_ended_for_memory_at_once_answers_for_itself(
    database: Database, tmp_path: Path, latest: int, outcome: str
) -> None:
    pool = StallingPool(tmp_path, "error", "error")
    pool.killed_at = 950
    pool.memory["b"].latest = latest
    setting = Setting(database, pool, runs=2)
    setting.run(steps=2000)
    assert outcomes(setting) == [["worker_lost", "done"], [outcome, "done"]]


def test_a_run_that_needs_too_much_memory_three_times_is_quarantined_with_that(
    database: Database, tmp_path: Path
) -> None:
    pool = StallingPool(tmp_path, *["error"] * 3)
    pool.killed_at = 950
    setting = Setting(database, pool, runs=1)
    setting.run(steps=2000)
    (run,) = setting.grids.runs(setting.grid_id, 10).items
    assert (run.state, run.error and run.error.code, run.attempt) == ("quarantined", "memory", 3)
