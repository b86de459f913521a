"""The dispatcher's loop against a pool that answers at once and a database that comes and goes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any

import pytest
from sqlalchemy.exc import OperationalError

from service.dispatcher.heartbeat import Heartbeat
from service.dispatcher.loop import Dispatcher
from service.payload import ResultPayload
from service.settings import Settings
from service.store.database import Database
from service.store.grids import GridStore
from service.store.leadership import Leadership, LeadershipLostError
from service.store.leases import Lease
from service.store.queue import RunQueue, Stored
from service.store.states import GridState
from service.worker import call_task
from tests.service.plans import submit


class Answered:
    """A Dask future that has its answer already, or never gets one."""

    def __init__(self, answer: Any = None, status: str = "finished") -> None:
        self._answer = answer
        self.status = status
        self.key = "key"

    def result(self, timeout: float) -> Any:
        return self._answer

    def done(self) -> bool:
        return self.status != "pending"

    def cancel(self) -> None:
        self.status = "cancelled"


class InstantPool:
    """Runs everything at once in this thread; ``statuses`` makes the first runs end otherwise."""

    running = True

    def __init__(self, folder: Path, *statuses: str) -> None:
        self.folder = folder
        self.statuses = list(statuses)
        self.stopped: list[Any] = []
        self.submitted: list[str] = []

    def threads(self) -> int:
        return 2

    def submit(self, lease: Lease, done: Callable[[Any], None]) -> Answered:
        self.submitted.append(lease.run_id)
        status = self.statuses.pop(0) if self.statuses else "finished"
        answer = call_task("tests.service.tasks:fast", lease.spec, str(self.folder)) if status == "finished" else None
        future = Answered(answer, status)
        if status == "finished":
            done(future)
        return future

    def stop(self, future: Any) -> None:
        self.stopped.append(future)


class ShakyQueue(RunQueue):
    """A queue whose database is away when results come."""

    away = 0
    events: list[str]

    def claim(self, generation: int, limit: int) -> list[Lease]:
        self.events.append("claim")
        return super().claim(generation, limit)

    def store(self, lease: Lease, payload: ResultPayload) -> Stored:
        if self.away:
            self.away -= 1
            self.events.append("away")
            raise OperationalError("INSERT", {}, Exception("the database is away"))
        self.events.append("store")
        return super().store(lease, payload)


@pytest.fixture(autouse=True)
def no_sleep(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOSTLENS_TEST_SLEEP", "0")


@pytest.fixture
def database(sqlite_url: str) -> Iterator[Database]:
    found = Database(sqlite_url)
    yield found
    found.close()


class Setting:
    """A grid, a queue and a dispatcher that stops when the grid has ended."""

    def __init__(self, database: Database, pool: InstantPool, runs: int, **settings: Any) -> None:
        self.grids = GridStore(database)
        self.grid_id = submit(self.grids, runs)
        self.queue = ShakyQueue(database, retry_delay_s=0.01)
        self.queue.events = []
        self.leadership = Leadership(database)
        generation = self.leadership.take("test")
        assert generation == 1
        self.pool = pool
        self.heartbeat: Any = SimpleNamespace(workers=0, lost=Event())
        chosen = Settings(poll_s=0.01, **settings)
        self.dispatcher = Dispatcher(chosen, self.queue, pool, self.heartbeat, generation)  # type: ignore[arg-type]

    def run(self, until: Callable[[], bool] | None = None, steps: int = 200) -> None:
        looks = iter(range(steps))
        ended = until or (lambda: self.grids.grid(self.grid_id).finished_at is not None)
        stop: Any = SimpleNamespace(is_set=lambda: next(looks, None) is None or ended(), wait=lambda _: None)
        self.dispatcher.run(stop)


def test_a_result_is_kept_while_the_database_is_away_and_nothing_is_claimed_meanwhile(
    database: Database, tmp_path: Path
) -> None:
    setting = Setting(database, InstantPool(tmp_path), runs=6)
    setting.queue.away = 3
    setting.run()
    assert setting.grids.grid(setting.grid_id).state is GridState.DONE
    assert len(setting.pool.submitted) == len(set(setting.pool.submitted)) == 6
    assert setting.queue.events[:6] == ["claim", "away", "away", "away", "store", "store"]


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
    pool.threads = lambda: 0  # type: ignore[method-assign]
    setting.run(steps=2)
    pool.threads = lambda: 2  # type: ignore[method-assign]
    setting.run(steps=1)
    assert setting.grids.grid(setting.grid_id).counts.leased == 2
    pool.threads = lambda: 0  # type: ignore[method-assign]
    setting.run(steps=4)
    assert setting.grids.grid(setting.grid_id).counts.queued == 2
    del pool.threads
    setting.run()
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
    heartbeat.workers = 2
    until = time.monotonic() + 10
    while (view := leadership.view()) is None or view.workers != 2:
        assert time.monotonic() < until
        time.sleep(0.02)
    assert leadership.take("next", lambda _: True) == 2
    assert heartbeat.lost.wait(10)
    heartbeat.stop()
