"""The artefact store as a dependency: full, away, silent, damaged; and who notices what of it."""

from __future__ import annotations

import errno
import os
import subprocess
import tempfile
import threading
import time
import tracemalloc
from base64 import b64encode
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import fsspec
import pytest
from fastapi.testclient import TestClient
from fsspec.implementations.memory import MemoryFileSystem

from service.api.app import create_app
from service.dispatcher import backlog
from service.dispatcher.backlog import Backlog, NoRoomError
from service.dispatcher.outcomes import read_artefacts
from service.dispatcher.telemetry import DispatcherMetrics
from service.domain.payload import ArtefactPayload, InvalidResultError, ResultPayload, read_payload
from service.runtime.settings import Settings
from service.store import artefacts
from service.store.artefacts import ArtefactDamagedError, ArtefactGoneError, ArtefactStore, ArtefactStoreError, keeping
from service.store.database import Database
from service.store.leadership import Leadership
from service.store.leases import Lease
from service.store.queue import Failure
from service.worker.tasks import call_task
from tests.service.plans import body
from tests.service.small_files import small_files
from tests.service.tasks import PNG, synthetic_payload
from tests.service.test_api import assert_problem, work
from tests.service.test_dispatcher import InstantPool, Setting, outcomes

SPEC = {"system": "HE0435", "l_eta": 1.0, "host": {"n": 2.0, "r_eff": 0.39, "magnitude": 21.0}, "seed": 7}


@pytest.fixture(autouse=True)
def no_sleep(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOSTLENS_DRILL_SLEEP", "0")


@pytest.fixture
def database(sqlite_url: str) -> Iterator[Database]:
    found = Database(sqlite_url)
    yield found
    found.close()


def files(folder: Path) -> list[str]:
    """Every file below a folder that is no artefact."""
    return [path.name for path in folder.rglob("*") if path.is_file() and path.suffix not in {".png", ".npz"}]


@contextmanager
def away(folder: Path) -> Iterator[None]:
    """A store whose folder is no folder any more: permissions stop nobody who is root, this stops everybody."""
    aside = folder.with_name(f"{folder.name}.aside")
    folder.mkdir(parents=True, exist_ok=True)
    folder.rename(aside)
    folder.touch()
    try:
        yield
    finally:
        folder.unlink()
        aside.rename(folder)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A real file system of 64 kB."""
    place = tmp_path / "small"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(place)]
    if os.geteuid() != 0 or subprocess.run(mount, capture_output=True, check=False).returncode != 0:
        pytest.skip("a file system of its own needs root, and the right to mount one")
    yield place
    subprocess.run(["umount", str(place)], check=True)  # noqa: S607 - wherever it is installed


def test_what_a_file_holds_is_stored_from_its_beginning_without_memory_for_it(tmp_path: Path) -> None:
    store, size = ArtefactStore(str(tmp_path / "artefacts")), 64 * 2**20
    with (tmp_path / "large").open("w+b") as file:
        file.truncate(size)
        file.seek(17)
        tracemalloc.start()
        made = store.put_file(file, "fits")
        again = store.put_file(file, "fits")
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert made == again
    assert peak < size / 10  # a piece of 1 MiB, and what is being read meanwhile
    assert Path(store.path(made.key)).stat().st_size == size
    assert made == store.put(bytes(size), "fits")


@pytest.mark.parametrize("left", [b"", PNG[:20], PNG[::-1]], ids=["empty", "cut off", "other bytes"])
def test_what_lies_damaged_under_its_name_is_written_again(tmp_path: Path, left: bytes) -> None:
    store = ArtefactStore(str(tmp_path))
    key = store.put(PNG, "png").key
    Path(store.path(key)).write_bytes(left)
    with pytest.raises(ArtefactDamagedError, match=key):
        store.read(key)
    assert store.put(PNG, "png").key == key
    assert store.read(key) == PNG
    assert files(tmp_path) == []


def test_what_is_written_again_is_as_young_as_the_last_who_wrote_it(tmp_path: Path) -> None:
    store = ArtefactStore(str(tmp_path))
    place = Path(store.path(store.put(PNG, "png").key))
    os.utime(place, (0, 0))
    store.put(PNG, "png")
    assert place.stat().st_mtime > 0


def test_a_folder_in_the_place_of_an_artefact_is_damage_and_set_aside_by_the_next_write(tmp_path: Path) -> None:
    store = ArtefactStore(str(tmp_path))
    place = Path(store.path(store.put(PNG, "png").key))
    place.unlink()
    (place / "somebody's").mkdir(parents=True)
    key = f"{place.parent.name}/{place.name}"
    with pytest.raises(ArtefactDamagedError):
        store.read(key)
    store.put(PNG, "png")
    assert store.read(key) == PNG
    assert list(place.parent.glob("*.damaged/somebody's"))


def test_an_artefact_that_is_gone_is_told_from_a_store_that_is_away(tmp_path: Path) -> None:
    folder = tmp_path / "store"
    store = ArtefactStore(str(folder))
    key = store.put(PNG, "png").key
    Path(store.path(key)).unlink()
    with pytest.raises(ArtefactGoneError, match=key):
        store.read(key)
    Path(store.path(key)).parent.rmdir()
    Path(store.path(key)).parent.touch()
    with pytest.raises(ArtefactGoneError):
        store.read(key)
    with away(folder), pytest.raises(ArtefactStoreError):
        store.read(key)
    folder.rename(tmp_path / "not mounted")
    with pytest.raises(ArtefactStoreError):
        store.read(key)


@contextmanager
def nobody() -> Iterator[None]:
    """Without the rights of root, whom permissions do not stop."""
    before = os.geteuid()
    if before == 0:
        os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(before)


def test_what_may_not_be_read_or_written_is_the_store_s_fault() -> None:
    # Not below pytest's folder, which only its owner may enter.
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o777)
        with nobody():
            store = ArtefactStore(f"{folder}/store")
            place = Path(store.path(store.put(PNG, "png").key))
            place.chmod(0)
            with pytest.raises(ArtefactStoreError, match="PermissionError"):
                store.read(f"{place.parent.name}/{place.name}")
            place.parent.chmod(0o500)
            with pytest.raises(ArtefactStoreError, match="PermissionError"):
                store.put(PNG, "png")
            place.parent.chmod(0o700)


def test_a_full_disk_is_said_to_be_full_and_nothing_is_left_of_the_attempt(small_disk: Path) -> None:
    store = ArtefactStore(str(small_disk / "store"))
    kept = store.put(PNG, "png")
    (small_disk / "filler").write_bytes(bytes(40_000))
    for _ in range(3):
        with pytest.raises(ArtefactStoreError) as refused:
            store.put(bytes(60_000), "npz")
        assert refused.value.full
    assert store.read(kept.key) == PNG
    assert sorted(files(small_disk)) == ["filler"]
    (small_disk / "filler").unlink()
    assert store.read(store.put(bytes(50_000), "npz").key) == bytes(50_000)


def test_a_write_that_fails_half_way_leaves_nothing(tmp_path: Path) -> None:
    store = ArtefactStore(str(tmp_path))
    with small_files(1000), pytest.raises(ArtefactStoreError) as refused:
        store.put(bytes(5000), "npz")
    assert refused.value.full
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_file_and_folders_are_on_the_disk_before_an_artefact_counts_as_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[str] = []
    fsync = os.fsync

    def watched(descriptor: int) -> None:
        synced.append(os.readlink(f"/proc/self/fd/{descriptor}"))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", watched)
    folder = tmp_path / "new"
    key = ArtefactStore(str(folder)).put(PNG, "png").key
    prefix = str(folder / key[:2])
    # The names of the new folders, the bytes, and last of all the name of the file.
    assert synced[:2] == [str(tmp_path), str(folder)]
    assert synced[2].startswith(f"{prefix}/")
    assert synced[3:] == [prefix]


@contextmanager
def silent(*places: Path) -> Iterator[None]:
    """Files whose reading says nothing and never ends, as on a file server that is gone."""
    for place in places:
        place.parent.mkdir(parents=True, exist_ok=True)
        place.unlink(missing_ok=True)
        os.mkfifo(place)  # who opens it waits until somebody writes
    before = threading.active_count()
    try:
        yield
    finally:
        until = time.monotonic() + 120
        while any(thread.name == "artefacts" for thread in threading.enumerate()) and time.monotonic() < until:
            for place in places:
                with suppress(OSError):  # nobody waits there any more
                    os.close(os.open(place, os.O_WRONLY | os.O_NONBLOCK))
            time.sleep(0.01)
        for place in places:
            place.unlink(missing_ok=True)
    assert threading.active_count() <= before


def test_a_store_that_says_nothing_holds_nobody_up_and_few_calls_hang(tmp_path: Path) -> None:
    patience_s = 0.1
    store = ArtefactStore(str(tmp_path), patience_s)
    keys = [store.put(PNG + bytes([number]), "png").key for number in range(8)]
    places = [Path(store.path(key)) for key in keys]
    with silent(*places):
        before = threading.active_count()
        for key in keys * 3:
            with pytest.raises(ArtefactStoreError, match=r"did not answer|still hang"):
                store.read(key)
        assert threading.active_count() - before == 4
        began = time.monotonic()
        calls = 1000
        for _ in range(calls):
            with pytest.raises(ArtefactStoreError, match="still hang"):
                store.probe()
        # Not one of them is waited for: that would be a hundred seconds.
        assert time.monotonic() - began < 0.5 * calls * patience_s
    assert store.read(store.put(PNG, "png").key) == PNG


def test_one_artefact_that_says_nothing_is_refused_and_the_store_is_not_away(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(backlog, "_FIRST_BACK_OFF_S", 0.0)
    store = ArtefactStore(str(tmp_path / "store"), patience_s=0.1)
    holding = Backlog(store, tmp_path, DispatcherMetrics())
    held = [held_result(number) for number in range(3)]
    with silent(*[Path(store.path(key)) for key in held[1][1]]):
        for number, (payload, artefacts) in enumerate(held):
            holding.add(lease(number), payload, artefacts)
        ended: dict[str, Any] = {}
        for _ in range(20):
            holding._next = 0.0
            ended |= {found.run_id: ending for found, ending in holding.attend()}
        assert holding.away is None
    assert {name: isinstance(ending, Failure) for name, ending in ended.items()} == {
        "r0": False,
        "r2": False,
        "r1": True,
    }
    assert ended["r1"].code == "artefact_refused"


class Unfriendly(MemoryFileSystem):
    """A driver that raises what is no OSError, once a file is to get its name."""

    protocol = "unfriendly"
    store: ClassVar[dict[str, Any]] = {}
    pseudo_dirs = [""]  # noqa: RUF012 - as its parent has it

    def mv(self, *_: Any, **__: Any) -> None:
        raise RuntimeError("the bucket is on fire")


@pytest.mark.parametrize("url", ["http://127.0.0.1:1/store", "nothing-like-this://x/y", "s4:/x", "unfriendly://x"])
def test_whatever_a_driver_raises_is_one_kind_of_error(url: str) -> None:
    fsspec.register_implementation("unfriendly", Unfriendly, clobber=True)
    store = ArtefactStore(url)
    if url != "s4:/x":  # a folder of that name, for all that fsspec knows
        with pytest.raises(ArtefactStoreError):
            store.put(PNG, "png")
    assert [name for name in Unfriendly.store if "partial" in name] == []


def test_a_store_behind_a_driver_keeps_checks_and_heals() -> None:
    store = ArtefactStore("memory://drivers/store")
    store.probe()
    key = store.put(PNG, "png").key
    assert store.read(key) == PNG
    files = fsspec.filesystem("memory")
    files.pipe_file(store.path(key), b"")
    with pytest.raises(ArtefactDamagedError):
        store.read(key)
    store.put(PNG, "png")
    assert store.read(key) == PNG
    assert [path for path in files.find("/drivers") if not path.endswith(".png")] == []
    files.rm_file(store.path(key))
    with pytest.raises(ArtefactGoneError):
        store.read(key)


def test_a_worker_sends_home_what_the_store_does_not_take(tmp_path: Path) -> None:
    with away(tmp_path / "store"):
        answer = call_task("tests.drills.tasks:pictured", SPEC, str(tmp_path / "store"))
    payload = read_payload(answer["payload"])
    artefacts = read_artefacts(payload, answer)
    assert payload.figure is not None
    assert payload.products is not None
    assert artefacts.keys() == {payload.figure.key, payload.products.key}
    assert artefacts[payload.figure.key].startswith(PNG)
    with keeping() as kept:
        again = call_task("tests.drills.tasks:pictured", SPEC, str(tmp_path / "store"))
    assert "artefacts" not in again
    assert kept == {}


@pytest.mark.parametrize(
    "brought",
    [[], {"figure": 7}, {"figure": "not base64"}, {"figure": b64encode(b"other").decode()}, "text"],
)
def test_artefacts_that_are_not_the_payload_s_are_an_invalid_result(brought: Any) -> None:
    figure = ArtefactStore("memory://brought").put(PNG, "png")
    payload = read_payload(synthetic_payload(SPEC) | {"figure": figure.model_dump()})
    if isinstance(brought, dict) and "figure" in brought:
        brought = {figure.key: brought["figure"]}
    with pytest.raises(InvalidResultError, match="artefacts"):
        read_artefacts(payload, {"artefacts": brought})


@pytest.mark.parametrize("key", ["../etc/passwd", "ab/" + "0" * 64 + ".png", "x"])
def test_a_payload_cannot_name_an_artefact_otherwise_than_by_its_digest(key: str) -> None:
    with pytest.raises(InvalidResultError):
        read_payload(synthetic_payload(SPEC) | {"figure": {"key": key, "digest": "f" * 64}})


class Pictured(InstantPool):
    """Every run has a figure and products of its own."""

    task = "tests.drills.tasks:pictured"


class Heavy(InstantPool):
    """Every run has six megabytes of artefacts."""

    task = "tests.service.tasks:heavy"


def setting_of(
    database: Database, folder: Path, runs: int = 6, kind: type[InstantPool] = Pictured, **settings: Any
) -> Setting:
    pool = kind(folder / "store")
    pool.folder.mkdir(exist_ok=True)
    return Setting(database, pool, runs, artefact_url=str(pool.folder), reconcile_s=0.01, **settings)


def test_while_the_store_is_away_results_wait_nothing_is_claimed_and_nobody_is_charged(
    database: Database, tmp_path: Path
) -> None:
    setting = setting_of(database, tmp_path)
    with away(setting.pool.folder):
        setting.dispatcher._backlog._next = time.monotonic() + 60  # it has just been asked, and was there
        setting.run(steps=30)
        counts = setting.grids.grid(setting.grid_id).counts
        # The first two, and the two that their workers were given before it was seen what these had brought home.
        assert (counts.done, counts.leased, len(setting.pool.submitted)) == (0, 4, 4)
        assert setting.heartbeat.artefacts_away
    setting.run(until=lambda: setting.grids.grid(setting.grid_id).finished_at is not None, steps=5000)
    assert outcomes(setting) == [["done"]] * 6
    assert len(setting.pool.submitted) == 6, "nothing was computed twice"
    assert not setting.heartbeat.artefacts_away
    assert files(tmp_path / "store") == []
    store = ArtefactStore(str(setting.pool.folder))
    for run in setting.grids.runs(setting.grid_id, 10).items:
        found = setting.grids.run(run.id).result
        assert found is not None
        for key in (found.figure, found.products):
            assert key is not None
            assert store.read(key)


def test_artefacts_of_megabytes_come_home_too(database: Database, tmp_path: Path) -> None:
    setting = setting_of(database, tmp_path, runs=2, kind=Heavy)
    with away(setting.pool.folder):
        setting.dispatcher._backlog._next = time.monotonic() + 60
        setting.run(until=lambda: len(setting.dispatcher._backlog.leases) == 2, steps=200)
    setting.run(steps=5000)
    assert outcomes(setting) == [["done"]] * 2


def test_without_its_store_a_dispatcher_does_not_even_start_what_it_could_not_keep(
    database: Database, tmp_path: Path
) -> None:
    setting = setting_of(database, tmp_path)
    with away(setting.pool.folder):
        setting.run(steps=20)
        assert setting.pool.submitted == []
    setting.run(steps=5000)
    assert outcomes(setting) == [["done"]] * 6


def test_one_artefact_that_is_refused_for_what_it_is_stops_nobody_else(
    database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(backlog, "_FIRST_BACK_OFF_S", 0.001)
    setting = setting_of(database, tmp_path)
    plain = setting.pool.folder / "plain"
    plain.mkdir()
    payload = read_payload(call_task(setting.pool.task, planned_spec(setting), str(plain))["payload"])
    assert payload.figure is not None
    # A file where the folder of this figure ought to be.
    (setting.pool.folder / payload.figure.key[:2]).touch()
    setting.run(steps=5000)
    ended = setting.grids.runs(setting.grid_id, 10).items
    refused = [run for run in ended if run.error is not None]
    assert 1 <= len(refused) < 6
    assert {run.error and run.error.code for run in refused} == {"artefact_refused"}
    assert {run.attempt for run in refused} == {1}
    assert len([run for run in ended if run.state == "done"]) == 6 - len(refused)


def planned_spec(setting: Setting) -> dict[str, Any]:
    (run, *_) = setting.grids.runs(setting.grid_id, 1).items
    return setting.grids.run(run.id).spec


def test_held_results_of_a_stopped_dispatcher_are_given_back(database: Database, tmp_path: Path) -> None:
    setting = held(database, tmp_path)
    with away(setting.pool.folder):
        setting.dispatcher.hand_back()
        assert setting.grids.grid(setting.grid_id).counts.queued == 6
        assert setting.dispatcher._backlog.leases == []
    assert {end for run in outcomes(setting) for end in run} == {"handed_back"}


def test_held_results_of_a_cancelled_grid_are_dropped(database: Database, tmp_path: Path) -> None:
    setting = held(database, tmp_path)
    with away(setting.pool.folder):
        setting.grids.cancel(setting.grid_id)
        setting.dispatcher._due.clear()
        setting.run(steps=500)
        assert setting.grids.grid(setting.grid_id).finished_at is not None
        assert setting.dispatcher._backlog.leases == []
    assert {end for run in outcomes(setting) for end in run} == {"cancelled"}


def held(database: Database, folder: Path) -> Setting:
    """A dispatcher that holds results which its store, away, did not take."""
    setting = setting_of(database, folder)
    with away(setting.pool.folder):
        setting.dispatcher._backlog._next = time.monotonic() + 60
        setting.run(until=lambda: len(setting.dispatcher._backlog.leases) == 4)
        assert len(setting.dispatcher._backlog.leases) == 4
    return setting


def test_what_was_half_written_when_its_folder_was_taken_away_is_removed_once_that_is_back(tmp_path: Path) -> None:
    store, aside = tmp_path / "store", tmp_path / "aside"
    first, second = ("ab" * 32 + ".png", "cd" * 32 + ".png")

    def pieces() -> Iterator[bytes]:
        yield b"half"
        store.rename(aside)
        store.touch()
        yield b"of it"

    with pytest.raises(OSError, match=r"Not a directory|No such file"):
        artefacts._write_file(store / "ab" / first, pieces())
    store.unlink()
    aside.rename(store)
    assert [path.suffix for path in store.rglob("*") if path.is_file()] == [".partial"]
    artefacts._write_file(store / "cd" / second, [b"whole"])
    assert [path.name for path in store.rglob("*") if path.is_file()] == [second]
    assert not artefacts._out_of_reach


def lease(number: int) -> Lease:
    names: Any = SimpleNamespace(run_id=f"r{number}", grid_id="g", attempt=1)
    return names  # type: ignore[no-any-return]


def held_result(number: int) -> tuple[ResultPayload, dict[str, bytes]]:
    data = PNG + bytes([number]) * 1000
    figure = ArtefactStore("memory://held").put(data, "png")
    return read_payload(synthetic_payload(SPEC) | {"figure": figure.model_dump()}), {figure.key: data}


def test_more_than_memory_should_keep_waits_in_a_file_without_a_name_and_beyond_it_there_is_no_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(backlog, "_IN_MEMORY", 3000)
    monkeypatch.setattr(backlog, "_ON_DISK", 4500)
    monkeypatch.setattr(backlog, "_LEFT_FREE", 0)
    folder = tmp_path / "store"
    holding = Backlog(ArtefactStore(str(folder)), tmp_path / "scratch", DispatcherMetrics())
    for turn in range(3):  # the room is there again once it is empty
        with away(folder):
            assert holding.attend() == []
            for number in range(6):
                holding.add(lease(number), *held_result(number + 10 * turn))
            with pytest.raises(NoRoomError):
                holding.add(lease(6), *held_result(6 + 10 * turn))
            assert list((tmp_path / "scratch").iterdir()) == [], "nothing would be left by a crash"
        holding._next = 0.0
        assert [found.run_id for found, _ in holding.attend()] == [f"r{number}" for number in range(6)]
        assert holding.leases == []
        holding._next = 0.0
    assert len(list(folder.rglob("*.png"))) == 18


def test_a_full_store_is_waited_for_even_where_it_takes_small_things(small_disk: Path, tmp_path: Path) -> None:
    (small_disk / "filler").write_bytes(bytes(50_000))
    holding = Backlog(ArtefactStore(str(small_disk / "store")), tmp_path, DispatcherMetrics())
    data = bytes(20_000)
    figure = ArtefactStore("memory://held").put(data, "png")
    holding.add(lease(1), read_payload(synthetic_payload(SPEC) | {"figure": figure.model_dump()}), {figure.key: data})
    for _ in range(20):
        holding._next = 0.0
        assert holding.attend() == []
        assert holding.away is not None
    (small_disk / "filler").unlink()
    holding._next = 0.0
    ((_, ending),) = holding.attend()
    assert not isinstance(ending, Failure)
    assert holding.away is None


@pytest.fixture
def finished(sqlite_url: str, tmp_path: Path) -> Iterator[tuple[TestClient, Path, str, str]]:
    """An API, the place of the figure of a run that is done, its address and its key."""
    settings = Settings(database_url=sqlite_url, data_dir=tmp_path)
    figure = ArtefactStore(settings.artefacts).put(PNG, "png")
    with TestClient(create_app(settings), raise_server_exceptions=False) as api:
        grid = api.post("/v1/grids", json=body(1)).json()
        work(settings, figure)
        (run,) = api.get(grid["links"]["runs"]).json()["items"]
        place = Path(ArtefactStore(settings.artefacts).path(figure.key))
        yield api, place, f"/v1/runs/{run['id']}/figure", figure.key


def test_a_figure_comes_with_a_tag_and_is_not_sent_to_who_has_it(finished: tuple[TestClient, Path, str, str]) -> None:
    api, place, address, key = finished
    answer = api.get(address)
    assert (answer.status_code, answer.content, answer.headers["etag"]) == (200, PNG, f'"{key}"')
    place.unlink()
    again = api.get(address, headers={"If-None-Match": f'"other", W/"{key}"'})
    assert (again.status_code, again.content) == (304, b"")


@pytest.mark.parametrize("what", ["gone", "empty", "cut off", "other bytes", "a folder"])
def test_a_figure_that_cannot_be_given_is_a_problem_with_its_key_and_a_rerun_heals_it(
    finished: tuple[TestClient, Path, str, str], what: str
) -> None:
    api, place, address, key = finished
    place.unlink()
    if what == "a folder":
        place.mkdir()
    elif what != "gone":
        place.write_bytes({"empty": b"", "cut off": PNG[:-1], "other bytes": b"GIF89a"}[what])
    problem = assert_problem(api.get(address), 410 if what == "gone" else 500)
    assert problem["artefact"] == key
    assert key in problem["detail"]
    call_task("tests.service.tasks:fast", SPEC, str(place.parent.parent))
    assert api.get(address).content == PNG


def test_without_its_store_the_api_says_503_and_to_come_back(finished: tuple[TestClient, Path, str, str]) -> None:
    api, place, address, _ = finished
    with away(place.parent.parent):
        answer = api.get(address)
        assert_problem(answer, 503)
        assert answer.headers["retry-after"]
    assert api.get(address).status_code == 200


def test_readiness_names_the_store_that_the_dispatcher_waits_for(sqlite_url: str, tmp_path: Path) -> None:
    settings = Settings(database_url=sqlite_url, data_dir=tmp_path)
    database = Database(sqlite_url)
    leadership = Leadership(database)
    generation = leadership.take("someone")
    assert generation is not None
    with TestClient(create_app(settings)) as api:
        leadership.beat(generation, {"e" * 64: 2}, artefacts_away=True)
        answer = api.get("/readyz").json()
        assert (answer["status"], answer["artefacts"], answer["workers"]) == ("degraded", "away", 2)
        leadership.beat(generation, {"e" * 64: 2})
        assert api.get("/readyz").json()["status"] == "ready"
    database.close()


def test_an_error_of_the_store_says_whether_it_is_full() -> None:
    assert ArtefactStoreError(OSError(errno.EDQUOT, "quota")).full
    assert not ArtefactStoreError(OSError(errno.EIO, "broken")).full


def test_artefact_payloads_are_named_by_their_digest() -> None:
    made = ArtefactStore("memory://named").put(PNG, "png")
    assert ArtefactPayload.model_validate(made.model_dump()) == made
