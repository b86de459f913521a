"""A real PgBouncer before a PostgreSQL server, for tests; it may be killed."""

from __future__ import annotations

import os
import pwd
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import psycopg
import pytest

from tests.drills.installation import free_port

_START_S = 120.0


def program() -> Path:
    """Where PgBouncer is; without one the test is skipped, except in CI, which installs it and must not go without."""
    found = shutil.which("pgbouncer", path=os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin"]))
    if found is None:
        if "CI" in os.environ:
            pytest.fail("PgBouncer is not installed, and .ci/run should have done so")
        pytest.skip("PgBouncer is not installed (Debian: apt-get install pgbouncer)")
    return Path(found)


class Pooler:
    """PgBouncer in a folder of its own, before a server that is reached through the socket in ``home``."""

    def __init__(self, room: Path, home: str, settings: dict[str, str]) -> None:
        self.port = free_port()
        self._log = room / "pgbouncer.log"
        self._process: subprocess.Popen[bytes] | None = None
        # As root it refuses to run, and the folder of the server's socket is open to the server's user alone.
        owner = Path(home).stat().st_uid
        self._who: dict[str, Any] = {"user": owner, "extra_groups": []} if os.geteuid() == 0 else {}
        user = pwd.getpwuid(owner).pw_name
        own = {
            "listen_addr": "127.0.0.1",
            "listen_port": str(self.port),
            "unix_socket_dir": "",
            "auth_type": "any",
            "pool_mode": "transaction",
            "default_pool_size": "4",
            "max_client_conn": "200",
            "admin_users": user,
            **settings,
        }
        lines = [
            "[databases]",
            f"* = host={home} user=hostlens",
            "[pgbouncer]",
            *(f"{k} = {v}" for k, v in own.items()),
        ]
        self._configuration = room / "pgbouncer.ini"
        self._configuration.write_text("\n".join(lines) + "\n", encoding="utf-8")
        self._program = program()

    def url(self, database: str, options: str = "") -> str:
        """URL of a database by way of the pooler."""
        return f"postgresql://hostlens@127.0.0.1:{self.port}/{database}{options}"

    def start(self) -> None:
        """Start it, and wait until it hands a connection on."""
        with self._log.open("ab") as log:
            command = [self._program, "-q", self._configuration]
            self._process = subprocess.Popen(command, stdout=log, stderr=log, cwd="/", **self._who)
        until = time.monotonic() + _START_S
        while True:
            try:
                psycopg.connect(self.url("postgres"), connect_timeout=2).close()
            except psycopg.OperationalError:
                if time.monotonic() > until or self._process.poll() is not None:
                    raise RuntimeError(f"PgBouncer did not start:\n{self._log.read_text()[-2000:]}") from None
                time.sleep(0.05)
            else:
                return

    def kill(self) -> None:
        """End it with -9: every connection through it breaks."""
        if self._process is not None:
            with suppress(ProcessLookupError):
                self._process.send_signal(signal.SIGKILL)
            self._process.wait()
            self._process = None


@contextmanager
def pooler(server: str, **settings: str) -> Iterator[Pooler]:
    """PgBouncer before the server of the fixture ``postgres_server``, gone afterwards."""
    home = server.rpartition("host=")[2]
    room = Path(tempfile.mkdtemp(prefix="hostlens-pooler-"))
    room.chmod(0o755)
    found = Pooler(room, home, settings)
    try:
        found.start()
        yield found
    finally:
        found.kill()
        shutil.rmtree(room, ignore_errors=True)
