"""Old rows and orphan files can be deleted beside a running service; what anything may still need stays."""

from __future__ import annotations

import os
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import func, select
from typer.testing import CliRunner

from service.api.app import create_app
from service.cli.app import app
from service.cli.pruning import read_age
from service.domain.states import RunState
from service.runtime.settings import Settings
from service.store import retention
from service.store.artefacts import ArtefactStore
from service.store.database import Database
from service.store.grids import GridStore
from service.store.leadership import Leadership
from service.store.leases import Outcome
from service.store.orphans import DAMAGED, FOREIGN, REFERRED, YOUNG, Orphans, oldest_kept
from service.store.outbox import EventStore
from service.store.queue import Failure, RunQueue
from service.store.retention import NEWEST, OPEN, YOUNGER, Retention, Share
from service.store.tables import attempt, event, idempotency, measurement, result
from tests.service.conftest import Clock
from tests.service.plans import body, planned, result_of

ERROR = Failure(Outcome.ERROR, "error", "broken", retries=2)
DAYS = timedelta(days=1)


class Service:
    """Grids that came one a day."""

    def __init__(self, database: Database, clock: Clock) -> None:
        self.database, self.clock = database, clock
        self.grids = GridStore(database, clock)
        self.queue = RunQueue(database, clock, retry_delay_s=1.0)
        self.generation = Leadership(database, clock=clock).take("me") or 0

    def grid(self, number: int, runs: int = 2) -> str:
        request = body(runs, 100 * number)
        return self.grids.create(request, lambda: planned(runs, 100 * number), key=f"key-{number}").grid.id

    def work(self, runs: int) -> None:
        for lease in self.queue.claim(self.generation, runs):
            self.queue.store(lease, result_of(lease))

    def done(self, number: int) -> str:
        made = self.grid(number)
        self.work(2)
        self.clock.advance(86400.0)
        return made

    def fail(self) -> RunState | None:
        (lease,) = self.queue.claim(self.generation, 1)
        state = self.queue.fail(lease, ERROR)
        self.clock.advance(60.0)
        return state


@pytest.fixture
def service(database: Database, clock: Clock) -> Service:
    return Service(database, clock)


def rows(database: Database) -> tuple[int, ...]:
    with database.read() as connection:
        tables = (event, attempt, idempotency, measurement)
        return tuple(connection.scalar(select(func.count()).select_from(table)) or 0 for table in tables)


def prune(found: Retention) -> dict[str, int]:
    return {kind: sum(found.prune(kind)) for kind in retention.KINDS}


def test_what_has_ended_long_ago_goes_and_what_stays_is_told_with_its_reason(service: Service) -> None:
    old = [service.done(1), service.done(2)]
    service.clock.advance(100 * 86400.0)
    young = service.done(3)
    opened = service.grid(4)
    found = Retention(service.database, service.clock() - 90 * DAYS)
    shares = list(found.shares())
    # A grid has events of its submission, of each run's start and end and of its own end, an attempt a run, and a key.
    assert shares == [
        Share("events", 10, {NEWEST: 2, YOUNGER: 6, OPEN: 1}),
        Share("attempts", 4, {YOUNGER: 2}),
        Share("idempotency keys", 2, {YOUNGER: 1, OPEN: 1}),
        Share("measurements", 0, {}),
    ]
    before = rows(service.database)
    shown = {grid_id: service.grids.grid(grid_id) for grid_id in (*old, young, opened)}
    assert prune(found) == {share.kind: share.going for share in shares}
    assert rows(service.database) == tuple(had - share.going for had, share in zip(before, shares, strict=True))
    assert {grid_id: service.grids.grid(grid_id) for grid_id in shown} == shown
    with service.database.read() as connection:
        assert connection.scalar(select(func.count()).select_from(result)) == 6
    assert prune(found) == dict.fromkeys(retention.KINDS, 0)
    assert all(share.going == 0 for share in found.shares())


def test_it_goes_in_pieces(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(retention, "PIECE", 2)
    for number in range(1, 4):
        service.done(number)
    found = Retention(service.database, service.clock() + DAYS)
    assert list(found.prune("events")) == [2, 2, 2, 2, 2, 2, 2, 1]
    assert list(found.prune("attempts")) == [2, 2, 2]


def test_attempts_go_on_counting_against_runs_of_a_grid_that_is_open(service: Service) -> None:
    service.grid(1, runs=1)
    assert [service.fail(), service.fail()] == [RunState.QUEUED, RunState.QUEUED]
    service.clock.advance(200 * 86400.0)
    assert prune(Retention(service.database, service.clock() - 90 * DAYS)) == dict.fromkeys(retention.KINDS, 0)
    assert service.fail() is RunState.FAILED


def test_a_run_that_is_retried_after_its_attempts_were_deleted_has_a_fresh_count(service: Service) -> None:
    grid_id = service.grid(1, runs=1)
    assert [service.fail() for _ in range(3)][-1] is RunState.FAILED
    found = Retention(service.database, service.clock() + DAYS)
    assert prune(found)["attempts"] == 3
    assert service.grids.revive(grid_id) == 1
    assert [service.fail() for _ in range(3)] == [RunState.QUEUED, RunState.QUEUED, RunState.FAILED]


def test_a_grid_that_is_retried_meanwhile_loses_nothing(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    grid_id = service.grid(1, runs=1)
    for _ in range(3):
        service.fail()
    found = Retention(service.database, service.clock() + DAYS)
    before = rows(service.database)
    monkeypatch.setattr(retention.Turns, "wait", lambda _: service.grids.revive(grid_id))
    assert list(found.prune("attempts")) == [0]
    assert rows(service.database)[1] == before[1]


def test_numbers_of_events_go_on_after_all_old_ones_are_gone(service: Service) -> None:
    grid_id = service.done(1)
    events = EventStore(service.database)
    latest = events.latest(grid_id)
    prune(Retention(service.database, service.clock() + DAYS))
    assert events.latest(grid_id) == latest
    assert events.page(grid_id, 0, 10).items[0].id == latest
    assert events.latest(service.grid(2)) > latest


def test_a_stream_that_was_left_before_what_is_kept_begins_anew_with_the_whole_state(
    service: Service, url: str, tmp_path: Path
) -> None:
    grid_id = service.done(1)
    events = EventStore(service.database)
    first, *_, last = [item.id for item in events.page(grid_id, 0, 10).items]

    def kinds(seen: int) -> list[str]:
        with TestClient(create_app(Settings(database_url=url, data_dir=tmp_path))) as api:
            headers = {"Accept": "text/event-stream", "Last-Event-ID": str(seen)}
            answer = api.get(f"/v1/grids/{grid_id}/events", headers=headers)
        lines = answer.text.splitlines()
        return [line.removeprefix("event: ") for line in lines if line.startswith("event: ")]

    assert kinds(first) == ["run_started", "run_started", "run_done", "run_done", "grid_finished"]
    prune(Retention(service.database, service.clock() + DAYS))
    assert kinds(first) == ["grid"]
    assert kinds(last) == []


# Files.


@pytest.fixture(params=["local", "memory"])
def store_url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    return str(tmp_path / "artefacts") if request.param == "local" else f"memory://{uuid4().hex}"


def age_file(url: str, name: str, days: float) -> None:
    """As if it had been written so many days ago."""
    files, root = Orphans(url, datetime.now(UTC))._files, Orphans(url, datetime.now(UTC))._root
    path = f"{root}/{name}"
    if url.startswith("memory"):
        files.store[path].created = datetime.now(UTC) - days * DAYS
    else:
        os.utime(path, (time.time() - 86400.0 * days,) * 2)


def write(url: str, name: str, data: bytes = b"data") -> None:
    orphans = Orphans(url, datetime.now(UTC))
    orphans._files.makedirs(f"{orphans._root}/{name}".rpartition("/")[0], exist_ok=True)
    orphans._files.pipe_file(f"{orphans._root}/{name}", data)


def test_only_old_files_that_no_result_refers_to_go(store_url: str) -> None:
    store = ArtefactStore(store_url)
    referred, orphan, young = (store.put(data, "png").key for data in (b"referred", b"orphan", b"young"))
    partial, young_partial = f"{orphan}.{uuid4().hex}.partial", f"{young}.{uuid4().hex}.partial"
    damaged = f"{orphan}.{uuid4().hex}.damaged/what_was_there"
    for name in (partial, young_partial, "README", "ab/notes.txt", ".probe", damaged):
        write(store_url, name)
    for name in (referred, orphan, partial, "README", "ab/notes.txt", ".probe", damaged):
        age_file(store_url, name, 10.0)
    orphans = Orphans(store_url, datetime.now(UTC) - 2 * DAYS)
    found = orphans.sort(orphans.listed(), {referred})
    assert (found.orphans, set(found.partial)) == ([orphan], {partial, ".probe"})
    assert {why: files for why, (files, _) in found.kept.items()} == {REFERRED: 1, YOUNG: 2, FOREIGN: 2, DAMAGED: 1}
    assert found.sizes[orphan] == len(b"orphan")
    assert [orphans.remove(name) for name in found.orphans + found.partial] == [True, True, True]
    assert sorted(name for name, _, _ in orphans.listed()) == sorted(
        [referred, young, young_partial, "README", "ab/notes.txt", damaged]
    )
    assert not orphans.remove(orphan)


def test_an_orphan_that_is_written_again_after_it_was_listed_stays(store_url: str) -> None:
    """The run whose result will refer to it may have found it there."""
    store = ArtefactStore(store_url)
    key = store.put(b"twice", "png").key
    age_file(store_url, key, 10.0)
    orphans = Orphans(store_url, datetime.now(UTC) - 2 * DAYS)
    assert orphans.sort(orphans.listed(), set()).orphans == [key]
    assert store.put(b"twice", "png").key == key
    assert not orphans.remove(key)
    assert store.read(key) == b"twice"


def test_a_store_that_is_not_there_yet_has_nothing_to_go(tmp_path: Path) -> None:
    orphans = Orphans(str(tmp_path / "none"), datetime.now(UTC))
    assert list(orphans.listed()) == []


def test_files_stay_for_a_day_and_as_long_as_a_run_is_under_way_that_may_have_written_them() -> None:
    now = datetime(2026, 6, 1, tzinfo=UTC)
    assert oldest_kept(now, now - 90 * DAYS, None) == now - 90 * DAYS
    assert oldest_kept(now, now - timedelta(hours=1), None) == now - DAYS
    assert oldest_kept(now, now - 2 * DAYS, now - 3 * DAYS) == now - 3 * DAYS - timedelta(hours=1)


# The command.


def run_command(*arguments: str, answer: str | None = None) -> Any:
    return CliRunner().invoke(app, ["db", "prune", *arguments], input=answer, env={"COLUMNS": "200"})


@pytest.fixture
def aged(service: Service, url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A service whose clock stands months ago, with an orphan; its key."""
    monkeypatch.setenv("HOSTLENS_DATA_DIR", str(tmp_path))
    monkeypatch.setenv("HOSTLENS_DATABASE_URL", url)
    service.clock.now = datetime.now(UTC) - 200 * DAYS
    service.done(1)
    key = ArtefactStore(str(tmp_path / "artefacts")).put(b"orphan", "npz").key
    age_file(str(tmp_path / "artefacts"), key, 199.0)
    return key


def test_a_dry_run_shows_all_and_deletes_nothing(aged: str, service: Service, tmp_path: Path) -> None:
    before = rows(service.database)
    answer = run_command("--older-than", "90d", "--dry-run")
    assert answer.exit_code == 0, answer.output
    for shown in ("events", "attempts", "idempotency keys", "artefacts", "half-written files", NEWEST, "6 bytes"):
        assert shown in answer.output
    assert rows(service.database) == before
    assert (tmp_path / "artefacts" / aged).exists()


def test_nothing_is_deleted_without_a_yes(aged: str, service: Service, tmp_path: Path) -> None:
    before = rows(service.database)
    for answer in ("n\n", None):
        refused = run_command("--older-than", "90d", answer=answer)
        assert refused.exit_code == 1
        assert "delete this?" in refused.output
    assert rows(service.database) == before
    agreed = run_command("--older-than", "90d", answer="y\n")
    assert agreed.exit_code == 0
    assert rows(service.database) == (1, 0, 0, 0)
    assert not (tmp_path / "artefacts" / aged).exists()


def test_with_yes_it_does_not_ask_and_a_repetition_finds_nothing(aged: str, service: Service) -> None:
    first = run_command("--older-than", "90d", "--yes")
    assert first.exit_code == 0, first.output
    assert "deleted 8 rows and 1 files" in first.output
    again = run_command("--older-than", "90d")
    assert (again.exit_code, "nothing to delete" in again.output) == (0, True)


def test_the_age_of_something_under_way_is_that_of_its_claim(aged: str, service: Service, tmp_path: Path) -> None:
    service.grid(2)
    assert service.queue.claim(service.generation, 1)
    assert run_command("--older-than", "90d", "--yes").exit_code == 0
    assert (tmp_path / "artefacts" / aged).exists()


@pytest.mark.parametrize("text", ["90", "d", "0d", "-1d", "1.5d", "90 d", "90m", "", "9999999d"])
def test_a_bad_age_is_refused_with_an_example(text: str) -> None:
    answer = run_command("--older-than", text, "--dry-run")
    assert answer.exit_code == 2
    assert "90d" in answer.output


def test_ages() -> None:
    assert [read_age(text).days for text in ("90d", "48h", "4w")] == [90, 2, 28]
