"""A real ``hostlens serve`` with a fast task, for tests that kill things."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TypeVar

import httpx
import psutil

from service.client import ApiError, Client
from service.schemas import Readiness

T = TypeVar("T")
ROOT = Path(__file__).resolve().parents[2]


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def eventually(look: Callable[[], T], timeout_s: float = 30.0, what: str = "it") -> T:
    """Wait until ``look`` gives something that is true."""
    until = time.monotonic() + timeout_s
    while time.monotonic() < until:
        found = look()
        if found:
            return found
        time.sleep(0.05)
    raise AssertionError(f"{what} did not happen within {timeout_s} s")


class Serving:
    """A supervised service in processes of its own."""

    def __init__(self, folder: Path, **settings: str) -> None:
        self.folder = folder
        self.port = free_port()
        self.log = folder / "serve.log"
        self.executions = folder / "executions"
        # Every process of this service, and of no other, has this in its environment.
        self.mark = f"hostlens-test-{self.port}-{time.time_ns()}"
        self.environment = {
            **os.environ,
            "PYTHONPATH": str(ROOT),
            "HOSTLENS_TEST_MARK": self.mark,
            "HOSTLENS_TEST_LOG": str(self.executions),
            "HOSTLENS_TASK": "tests.service.tasks:fast",
            "HOSTLENS_DATA_DIR": str(folder / "data"),
            "HOSTLENS_PORT": str(self.port),
            "HOSTLENS_RECONCILE_S": "1",
            **settings,
        }
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "service", "serve"],
                cwd=folder,
                env=self.environment,
                stdout=log,
                stderr=log,
            )
        self.client = Client(f"http://127.0.0.1:{self.port}")

    def wait_ready(self) -> None:
        eventually(lambda: (found := self.readiness()) and found.status == "ready", 60, "readiness")

    def readiness(self) -> Readiness | None:
        try:
            return self.client.readiness()
        except (httpx.TransportError, ApiError):
            return None

    def processes(self) -> list[psutil.Process]:
        """All processes of this service that are alive, orphans included."""
        found = []
        for process in psutil.process_iter():
            with suppress(psutil.Error):
                alive = process.status() != psutil.STATUS_ZOMBIE
                if alive and process.environ().get("HOSTLENS_TEST_MARK") == self.mark:
                    found.append(process)
        return found

    def child(self, module: str) -> psutil.Process | None:
        """The process of a module, none while it is not running."""
        for process in self.processes():
            with suppress(psutil.Error):
                if process.cmdline()[1:3] == ["-m", module]:
                    return process
        return None

    def executed(self) -> list[str]:
        """Digest of each execution that came to its end."""
        return [line.split()[0] for line in self.executions.read_text().splitlines()]

    def end(self, number: int = signal.SIGINT) -> int:
        self.process.send_signal(number)
        return self.process.wait(timeout=40)


@contextmanager
def serving(folder: Path, **settings: str) -> Iterator[Serving]:
    """A service that is gone afterwards, whatever happened."""
    service = Serving(folder, **settings)
    try:
        service.wait_ready()
        yield service
    except BaseException:
        print(service.log.read_text()[-8000:])
        raise
    finally:
        for process in service.processes():
            with suppress(psutil.Error):
                process.kill()
        service.process.wait(timeout=20)
