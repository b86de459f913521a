"""The database goes away: PostgreSQL killed, SQLite locked, a disk that is full, a file that may not be written."""

from __future__ import annotations

import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from threading import Event, Thread
from typing import Any, ClassVar

import httpx
from sqlalchemy import text

from service.client import ApiError, Client
from service.store.database import Database
from tests.drills.drill import Drill, Ground, body
from tests.drills.installation import Installation, eventually, free_port, installation
from tests.drills.kills import identical, progress, stored_once, undisturbed
from tests.drills.postgres import postgres_server
from tests.drills.report import Claim, Figure, Report
from tests.drills.stored import records

_LOCK = """
import sqlite3, sys, time
connection = sqlite3.connect(sys.argv[1], timeout=30, isolation_level=None)
connection.execute("BEGIN EXCLUSIVE")
print("locked", flush=True)
time.sleep(float(sys.argv[2]))
connection.execute("ROLLBACK")
"""
_ALMOST_NOTHING = 4096


@dataclass(frozen=True)
class PostgresKills(Drill):
    """kill -9 of the postmaster, and a new start, every few seconds."""

    name: ClassVar[str] = "postgres"
    what: ClassVar[str] = "kill -9 of a PostgreSQL server and a new start every 4 s, in a grid of 240 runs"
    claim: ClassVar[str] = "all done and stored once; no result is lost because the database was away"
    small: ClassVar[dict[str, object]] = {"runs": 40, "every_s": 3.0}

    runs: int = 240
    every_s: float = 4.0
    sleep_s: float = 0.2

    def run(self, ground: Ground) -> Report:
        """Use a throw-away server, whatever database was named: somebody else's is not to be killed."""
        calm = undisturbed(self.runs)
        kills, stop = 0, Event()
        with postgres_server() as server:
            settings = {"HOSTLENS_DRILL_SLEEP": str(self.sleep_s), "HOSTLENS_DATABASE_URL": server.create("drill")}
            with installation(ground.folder / "drill", settings) as service:
                service.wait_ready(2)
                grid = service.client.submit(body(self.runs))
                began = time.monotonic()

                def kill() -> None:
                    nonlocal kills
                    done = 0
                    while not stop.wait(self.every_s):
                        # A busy machine may need longer to get anything done between two kills.
                        if (now := _stored(service, grid.id)) > done:
                            done = now
                            server.kill()
                            server.start()
                            kills += 1

                killer = Thread(target=kill, name="killer")
                killer.start()
                try:
                    service.watch(grid.id)
                finally:
                    stop.set()
                    killer.join()
                took = time.monotonic() - began
                found, executed = records(service, grid.id), service.executed()
        return Report(
            self.name,
            f"{self.runs} runs of {self.sleep_s:g} s, two local workers, server with its default durability",
            (
                Figure("kills", kills),
                Figure("stored", found.stored),
                Figure("executions that ended", len(executed)),
                Figure("attempts that did not end well", sum(found.outcomes.values()) - found.outcomes["done"]),
                Figure("wall time", took, "s"),
            ),
            (
                stored_once(found, self.runs),
                identical(found, calm),
                Claim("the server was killed", kills > 0),
                Claim("nobody charged", not {"error", "worker_lost", "deadline"} & set(found.outcomes)),
            ),
        )


@dataclass(frozen=True)
class SqliteLock(Drill):
    """Another process locks the database file for a while."""

    name: ClassVar[str] = "sqlite-lock"
    what: ClassVar[str] = "another process holds SQLite's write lock for 10 s"
    claim: ClassVar[str] = "reads go on; a submission waits and is accepted; all done, stored once, same leader"
    small: ClassVar[dict[str, object]] = {"runs": 16, "lock_s": 3.0}

    runs: int = 60
    lock_s: float = 10.0
    sleep_s: float = 0.2

    def run(self, ground: Ground) -> Report:
        """Lock in the middle of a grid; read all the time, submit once."""
        calm = undisturbed(self.runs)
        reads: list[float] = []
        with installation(ground.folder / "drill", {"HOSTLENS_DRILL_SLEEP": str(self.sleep_s)}) as service:
            service.wait_ready(2)
            grid = service.client.submit(body(self.runs))
            progress(service, grid.id, self.runs // 4)
            file = str(service.folder / "data" / "hostlens.sqlite")
            locker = subprocess.Popen([sys.executable, "-c", _LOCK, file, str(self.lock_s)], stdout=subprocess.PIPE)
            try:
                if locker.stdout is not None:
                    locker.stdout.readline()
                locked = time.monotonic()
                second: list[float] = []

                def submit() -> None:
                    with Client(f"http://127.0.0.1:{service.port}") as client:
                        client.submit(body(2, seed=10_000))
                    second.append(time.monotonic() - locked)

                other = Thread(target=submit, name="submitter")
                other.start()
                while time.monotonic() - locked < self.lock_s - 0.5:
                    began = time.monotonic()
                    service.client.status(grid.id)
                    reads.append(time.monotonic() - began)
                    time.sleep(0.05)
            finally:
                locker.wait(timeout=120)
                if locker.stdout is not None:
                    locker.stdout.close()
            other.join(60)
            service.watch(grid.id)
            found = records(service, grid.id)
            generation = _generation(service)
        return Report(
            self.name,
            f"{self.runs} runs of {self.sleep_s:g} s, two local workers, write lock for {self.lock_s:g} s",
            (
                Figure("stored", found.stored),
                Figure("reads during the lock", len(reads)),
                Figure("slowest of them", 1e3 * max(reads), "ms"),
                Figure("submission answered after", second[0] if second else "never", "s"),
                Figure("generation of the leader", generation),
            ),
            (
                stored_once(found, self.runs),
                identical(found, calm),
                Claim("no read waits for the lock", max(reads) < self.lock_s / 2),
                Claim("the submission is accepted once the lock is gone", bool(second)),
                Claim("the leader stays", generation == 1),
            ),
        )


@dataclass(frozen=True)
class DiskFull(Drill):
    """A disk that takes nothing more, then does again; and a database that may only be read.

    The kernel's limit on the size of files (RLIMIT_FSIZE) is lowered for the running API and dispatcher: their next
    write fails in SQLite where one to a full disk would, and nobody needs root for it. Read-only is SQLite's own
    mode, because permissions stop nobody who is root.
    """

    name: ClassVar[str] = "disk-full"
    what: ClassVar[str] = "writes of API and dispatcher fail as on a full disk for 8 s; an API on a read-only database"
    claim: ClassVar[str] = "503 as problem+json, reads go on, nothing corrupt, all done once there is room"
    small: ClassVar[dict[str, object]] = {"runs": 16, "full_s": 3.0}

    runs: int = 60
    full_s: float = 8.0
    sleep_s: float = 0.2

    def run(self, ground: Ground) -> Report:
        """Take the room away in the middle of a grid."""
        calm = undisturbed(self.runs)
        with installation(ground.folder / "drill", {"HOSTLENS_DRILL_SLEEP": str(self.sleep_s)}) as service:
            service.wait_ready(2)
            grid = service.client.submit(body(self.runs))
            progress(service, grid.id, self.runs // 4)
            with _no_room(service):
                until = time.monotonic() + self.full_s
                refused = _refusal(service.client)
                read = _answers(lambda: service.client.status(grid.id))
                time.sleep(max(until - time.monotonic(), 0.0))
                stuck = service.client.status(grid.id).counts.done
            freed = time.monotonic()
            eventually(lambda: _answers(lambda: service.client.submit(body(1, seed=10_000))), what="an accepted grid")
            accepted = time.monotonic() - freed
            progress(service, grid.id, min(stuck + 1, self.runs))
            resumed = time.monotonic() - freed
            service.watch(grid.id)
            found = records(service, grid.id)
            port = free_port()
            file = service.folder / "data" / "hostlens.sqlite"
            read_only = f"sqlite:///file:{file}?mode=ro&uri=true"
            service.start("service.api", HOSTLENS_PORT=str(port), HOSTLENS_DATABASE_URL=read_only)
            with Client(f"http://127.0.0.1:{port}") as client:
                eventually(lambda: _answers(lambda: client.status(grid.id)), what="an answer from the read-only API")
                refused_too = _refusal(client)
            intact = _integrity(service)
        return Report(
            self.name,
            f"{self.runs} runs of {self.sleep_s:g} s, two local workers, SQLite, no room for {self.full_s:g} s",
            (
                Figure("stored", found.stored),
                Figure("answer to a submission", refused),
                Figure("answer on a read-only database", refused_too),
                Figure("room to accepted submission", accepted, "s"),
                Figure("room to next result", resumed, "s"),
                Figure("integrity_check", intact),
            ),
            (
                stored_once(found, self.runs),
                identical(found, calm),
                Claim("503 as problem+json without room", refused == "503 problem+json"),
                Claim("503 as problem+json on a read-only database", refused_too == "503 problem+json"),
                Claim("reads go on without room", read),
                Claim("nothing corrupt", intact == "ok"),
            ),
        )


@contextmanager
def _no_room(service: Installation) -> Iterator[None]:
    """No API process and no dispatcher can make a file longer than a page while this lasts."""
    modules = ("service.api", "service.dispatcher")
    pids = [process.pid for module in modules for process in service.children(module)]
    before = {pid: resource.prlimit(pid, resource.RLIMIT_FSIZE) for pid in pids}
    try:
        for pid, (_, hard) in before.items():
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (_ALMOST_NOTHING, hard))
        yield
    finally:
        for pid, limits in before.items():
            resource.prlimit(pid, resource.RLIMIT_FSIZE, limits)


def _refusal(client: Client) -> str:
    """How a submission is refused."""
    try:
        client.submit(body(1, seed=20_000))
    except ApiError as error:
        complete = {"type", "title", "status"} <= set(error.problem)
        return f"{error.status} {'problem+json' if complete else 'without a problem'}"
    return "accepted"


def _stored(service: Installation, grid_id: str) -> int:
    """Results so far; none where nobody can be asked."""
    try:
        return service.client.status(grid_id).counts.done
    except (ApiError, httpx.TransportError):
        return 0


def _answers(ask: Callable[[], Any]) -> bool:
    try:
        ask()
    except (ApiError, httpx.TransportError):
        return False
    return True


def _integrity(service: Installation) -> str:
    with closing(Database(service.database, pooled=False)) as database, database.read() as connection:
        return str(connection.scalar(text("PRAGMA integrity_check")))


def _generation(service: Installation) -> int:
    with closing(Database(service.database, pooled=False)) as database, database.read() as connection:
        return int(connection.scalar(text("SELECT generation FROM leader")) or 0)
