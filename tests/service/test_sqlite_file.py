"""The embedded database: readers beside waiting writers, a file that is taken away, a log that stays bounded."""

from __future__ import annotations

import shutil
import sqlite3
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import func, select, text

from service.api.app import create_app
from service.runtime.settings import Settings
from service.store import sqlite_file
from service.store.database import Database
from service.store.faults import DatabaseAwayError
from service.store.grids import GridStore
from service.store.tables import grid, run
from tests.service.plans import body, submit
from tests.service.service_process import eventually, serving
from tests.service.small_files import small_files


@pytest.fixture
def file(sqlite_url: str) -> Path:
    return Path(sqlite_url.removeprefix("sqlite:///"))


@contextmanager
def locked(file: Path) -> Iterator[None]:
    """Somebody else holds the write lock."""
    with closing(sqlite3.connect(file, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        yield
        other.execute("ROLLBACK")


def test_a_write_that_finds_no_room_costs_no_reader_its_connection(sqlite_url: str) -> None:
    """A new one could not be opened where nobody else has the file open: its index is a file that has to grow."""
    database = Database(sqlite_url)
    with closing(database.reader.raw_connection()) as kept:
        driver = kept.driver_connection
    with small_files(4096), pytest.raises(DatabaseAwayError):
        submit(GridStore(database), 100)
    with small_files(4096), database.read() as connection:
        assert connection.connection.driver_connection is driver
        assert connection.scalar(select(func.count()).select_from(run)) == 0
    submit(GridStore(database), 1)
    database.close()


@pytest.mark.parametrize("writers", [20, 60])
def test_reads_do_not_wait_for_writers_who_wait_for_the_lock(sqlite_url: str, tmp_path: Path, writers: int) -> None:
    """Half of them within a second, against the thirty that SQLite waits for a lock where they share a pool."""
    file = Path(sqlite_url.removeprefix("sqlite:///"))
    settings = Settings(database_url=sqlite_url, data_dir=tmp_path)
    took = []
    with TestClient(create_app(settings), raise_server_exceptions=False) as api:
        api.get("/v1/grids")
        with ThreadPoolExecutor(writers) as threads:
            with locked(file):
                answers = [threads.submit(api.post, "/v1/grids", json=body(1, seed=n)) for n in range(writers)]
                # Beyond what may wait they are refused after a second without progress.
                eventually(lambda: waiting(api) + ended(answers) >= writers, what="writers that wait")
                for _ in range(30):
                    began = time.monotonic()
                    assert api.get("/v1/grids").status_code == 200
                    took.append(time.monotonic() - began)
            found = [answer.result() for answer in answers]
        statuses = [answer.status_code for answer in found]
        assert set(statuses) <= {202, 503}
        assert all("retry-after" in answer.headers for answer in found if answer.status_code == 503)
        # Those that may wait are accepted once the lock is gone, and what was answered is what is stored.
        assert statuses.count(202) >= min(writers, 20)
        assert len(api.get("/v1/grids").json()["items"]) == statuses.count(202)
    print(f"median {1e3 * statistics.median(took):.0f} ms, slowest {1e3 * max(took):.0f} ms")
    assert statistics.median(took) < 1.0


def waiting(api: TestClient) -> float:
    """Requests that are being answered, but for the one that asks."""
    shown = api.get("/metrics").text.splitlines()
    return next(float(line.split()[1]) for line in shown if "_in_progress " in line and line[0] != "#") - 1.0


def ended(answers: Sequence[Future[Any]]) -> int:
    return sum(answer.done() for answer in answers)


def test_only_an_upgrade_makes_a_file(tmp_path: Path) -> None:
    missing = tmp_path / "missing.sqlite"
    database = Database(f"sqlite:///{missing}")
    for transaction in (database.read, database.write):
        with pytest.raises(DatabaseAwayError, match="there is no database file"), transaction():
            pass
    with pytest.raises(DatabaseAwayError, match="there is no database file"):
        database.revision()
    assert not missing.exists()
    database.close()


def moved(file: Path) -> Callable[[], object]:
    hidden = file.with_name("hidden")
    file.rename(hidden)
    return lambda: hidden.rename(file)


def folder_moved(file: Path) -> Callable[[], object]:
    hidden = file.parent.with_name(f"{file.parent.name}-hidden")
    file.parent.rename(hidden)
    return lambda: hidden.rename(file.parent)


def folder_in_its_place(file: Path) -> Callable[[], object]:
    back = moved(file)
    file.mkdir()

    def undo() -> None:
        file.rmdir()
        back()

    return undo


def link_away(file: Path) -> Callable[[], object]:
    elsewhere = file.with_name("elsewhere.sqlite")
    file.rename(elsewhere)
    return lambda: elsewhere.rename(file)


def replaced_for_a_while(file: Path) -> Callable[[], object]:
    back = moved(file)
    shutil.copy(file.with_name("hidden"), file)
    return back


@pytest.mark.parametrize("take", [moved, folder_moved, folder_in_its_place, link_away, replaced_for_a_while])
def test_without_its_file_nothing_is_read_or_accepted_until_it_is_back(
    tmp_path: Path, migrated_sqlite: Path, take: Callable[[Path], Callable[[], object]]
) -> None:
    (tmp_path / "data").mkdir()
    file = tmp_path / "data" / "own.sqlite"
    shutil.copy(migrated_sqlite, file)
    settings = Settings(database_url=f"sqlite:///{file}", data_dir=tmp_path)
    with TestClient(create_app(settings), raise_server_exceptions=False) as api:
        assert api.post("/v1/grids", json=body(1)).status_code == 202
        back = take(file)
        for _ in range(2):
            answers = [api.get("/readyz"), api.get("/v1/grids"), api.post("/v1/grids", json=body(1, seed=2))]
            assert [answer.status_code for answer in answers] == [503] * 3
        back()
        assert api.post("/v1/grids", json=body(1, seed=3)).status_code == 202
        assert len(api.get("/v1/grids").json()["items"]) == 2
    with closing(sqlite3.connect(file)) as own:
        assert own.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        assert own.execute("SELECT count(*) FROM grid").fetchone() == (2,)


def test_a_file_that_is_gone_for_good_is_never_made_anew(file: Path, caplog: pytest.LogCaptureFixture) -> None:
    settings = Settings(database_url=f"sqlite:///{file}", data_dir=file.parent)
    with TestClient(create_app(settings), raise_server_exceptions=False) as api:
        assert api.post("/v1/grids", json=body(1)).status_code == 202
        for part in file.parent.glob(f"{file.name}*"):
            part.unlink()
        assert api.post("/v1/grids", json=body(1, seed=2)).status_code == 503
        assert api.get("/readyz").status_code == 503
    assert not file.exists()
    assert f"there is no database file {file}" in caplog.text


def test_a_file_put_in_place_of_the_old_one_asks_for_a_restart_and_stays_whole(
    file: Path, migrated_sqlite: Path, caplog: pytest.LogCaptureFixture
) -> None:
    settings = Settings(database_url=f"sqlite:///{file}", data_dir=file.parent)
    with TestClient(create_app(settings), raise_server_exceptions=False) as api:
        for seed in range(3):
            assert api.post("/v1/grids", json=body(1, seed=seed)).status_code == 202
        old = file.with_name("old.sqlite")
        file.rename(old)
        shutil.copy(migrated_sqlite, file)
        assert api.post("/v1/grids", json=body(1, seed=9)).status_code == 503
        assert api.get("/v1/grids").status_code == 503
        assert "restart hostlens" in caplog.text
    # What was accepted is in the old file, which the log beside the new one no longer holds anything of.
    for path, grids in ((old, 3), (file, 0)):
        with closing(sqlite3.connect(path)) as own:
            assert own.execute("PRAGMA integrity_check").fetchone() == ("ok",)
            assert own.execute("SELECT count(*) FROM grid").fetchone() == (grids,)
    with TestClient(create_app(settings), raise_server_exceptions=False) as api:
        assert api.post("/v1/grids", json=body(1, seed=9)).status_code == 202


def test_a_commit_into_a_file_that_was_just_taken_away_is_not_answered_as_stored(file: Path) -> None:
    database = Database(f"sqlite:///{file}")

    def write() -> None:
        with database.write() as connection:
            connection.execute(text("UPDATE grid SET name = 'other'"))
            file.unlink()

    with pytest.raises(DatabaseAwayError, match="taken away while it was written"):
        write()
    database.close()


@pytest.mark.parametrize("suffixes", [("-wal",), ("-shm",), ("-wal", "-shm")])
def test_a_log_that_is_deleted_takes_nothing_with_it(file: Path, suffixes: tuple[str, ...]) -> None:
    """By two processes at once, as API and dispatcher are: each has what it needs open."""
    first, second = Database(f"sqlite:///{file}"), Database(f"sqlite:///{file}")
    made = [submit(GridStore(store), 1, seed) for seed, store in enumerate((first, second, first))]
    for suffix in suffixes:
        file.with_name(file.name + suffix).unlink()
    for seed, store in enumerate((first, second, second, first)):
        made.append(submit(GridStore(store), 1, 10 + seed))
        for each in (first, second):
            assert {item.id for item in GridStore(each).grids(100).items} == set(made)
    first.close()
    second.close()
    with closing(sqlite3.connect(file)) as own:
        assert own.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        assert own.execute("SELECT count(*) FROM grid").fetchone() == (len(made),)


def test_a_file_that_is_no_database_is_told_as_that(tmp_path: Path) -> None:
    file = tmp_path / "none.sqlite"
    file.write_bytes(b"no database at all, " * 500)
    database = Database(f"sqlite:///{file}")
    with pytest.raises(DatabaseAwayError, match=f"file is not a database: {file}"):
        database.revision()
    database.close()


def test_a_file_that_was_read_only_for_a_while_is_written_again_once_it_may_be(file: Path) -> None:
    """As permissions that are taken away and given back, which do not stop root: opened so as SQLite would open it."""
    database = Database(f"sqlite:///{file}")
    grids = GridStore(database)
    assert database._file is not None
    allowed = database._file._uri
    database._file._uri = allowed.replace("mode=rw", "mode=ro")
    for seed in range(2):
        with pytest.raises(DatabaseAwayError, match="readonly database"):
            submit(grids, 1, seed)
    assert grids.grids(10).items == []
    database._file._uri = allowed
    submit(grids, 1, 2)
    database.close()


def test_a_running_service_goes_on_once_its_file_is_back(tmp_path: Path) -> None:
    with serving(tmp_path, HOSTLENS_DRILL_SLEEP="0.2") as service:
        made = service.client.submit(body(20))
        eventually(lambda: service.client.status(made.id).counts.done > 2, what="progress")
        leader = service.child("service.dispatcher")
        file = tmp_path / "data" / "hostlens.sqlite"
        hidden = tmp_path / "hidden.sqlite"
        file.rename(hidden)
        eventually(lambda: service.readiness() is None, what="503")
        eventually(lambda: "there is no database file" in service.tail(), what="a line in the log")
        eventually(lambda: "the database is away" in service.tail(), what="a line of the dispatcher in the log")
        assert not file.exists()
        hidden.rename(file)
        ended = service.client.wait(made.id, timeout_s=300)
        assert ended.counts.done == 20
        now = service.child("service.dispatcher")
        assert leader is not None
        assert now is not None
        assert now.pid == leader.pid


def test_the_log_is_cut_once_a_long_reader_is_gone(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sqlite_file, "LOG_LIMIT", 200_000)
    database = Database(f"sqlite:///{file}")
    grids = GridStore(database)
    with database.read() as reader:
        assert reader.scalar(select(func.count()).select_from(run)) == 0
        for seed in range(4):
            submit(grids, 200, seed)
            database.cut_log()
        while_read = database.log_bytes()
        assert reader.scalar(select(func.count()).select_from(run)) == 0
    assert while_read > 200_000
    database.cut_log()
    assert database.log_bytes() == 0
    # By SQLite itself, too, where nobody asks for it: the next writes begin anew in a log that is no longer long. It
    # looks to that once the log has a thousand pages.
    with database.read() as reader:
        assert reader.scalar(select(func.count()).select_from(grid)) == 4
        for seed in range(4, 8):
            submit(grids, 800, seed)
    assert database.log_bytes() > 1000 * 4096
    for seed in range(8, 11):
        submit(grids, 1, seed)
    assert database.log_bytes() <= 200_000
    database.close()


def test_the_log_is_cut_though_there_is_always_a_reader(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each brief, but one always there: SQLite alone finds no moment to begin the log anew."""
    monkeypatch.setattr(sqlite_file, "LOG_LIMIT", 200_000)
    database = Database(f"sqlite:///{file}")
    grids = GridStore(database)
    written, longest, left = 0, 0, 0
    with ThreadPoolExecutor(2) as threads:
        ended = False

        def read() -> None:
            while not ended:
                with database.read() as connection:
                    connection.scalar(select(func.count()).select_from(run))
                    time.sleep(0.01)

        reading = [threads.submit(read) for _ in range(2)]
        try:
            for seed in range(12):
                submit(grids, 200, seed)
                grown = database.log_bytes()
                written += grown - left
                longest = max(longest, grown)
                database.cut_log()
                left = database.log_bytes()
        finally:
            ended = True
        for one in reading:
            one.result()
    database.cut_log()
    assert database.log_bytes() == 0
    # Never all that was written; half of it leaves room for a machine on which every second cut comes too late.
    assert longest < 0.5 * written
    database.close()


def test_the_size_of_the_log_is_a_metric(file: Path) -> None:
    settings = Settings(database_url=f"sqlite:///{file}", data_dir=file.parent)
    with TestClient(create_app(settings), raise_server_exceptions=False) as api:
        assert api.post("/v1/grids", json=body(1)).status_code == 202
        (line,) = [line for line in api.get("/metrics").text.splitlines() if line.startswith("hostlens_database_log")]
        name, size = line.split()
        assert name == "hostlens_database_log_bytes"
        assert float(size) == file.with_name(f"{file.name}-wal").stat().st_size > 0
