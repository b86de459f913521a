"""A service of one's own: real processes in a folder, all gone afterwards. For the demo, the check and the tests."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

import httpx
import psutil

from service.client import ApiError, Client
from service.domain.views import GridView, Readiness
from service.runtime.process import PARENT_FD

T = TypeVar("T")
_MARK = "HOSTLENS_DRILL_MARK"
PATIENCE_S = 120.0
"""How long anything is waited for that takes a moment, or ten seconds, on a machine that has nothing else to do."""


class DidNotHappenError(RuntimeError):
    """What was waited for did not happen in time."""


def free_port() -> int:
    """A port that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def eventually(look: Callable[[], T], timeout_s: float = PATIENCE_S, what: str = "it") -> T:
    """Wait until ``look`` gives something that is true; a DidNotHappenError names what did not happen."""
    until = time.monotonic() + timeout_s
    while time.monotonic() < until:
        found = look()
        if found:
            return found
        time.sleep(0.05)
    raise DidNotHappenError(f"{what} did not happen within {timeout_s:g} s")


def is_worker(process: psutil.Process) -> bool:
    """Whether a Dask nanny started this process: on its own, or had it forked from a nursery."""
    if "--multiprocessing-fork" in process.cmdline():
        return True
    parent = process.parent()
    return _is_nursery(process) and parent is not None and _is_nursery(parent)


def _is_nursery(process: psutil.Process) -> bool:
    # What is forked has its parent's command line.
    return any("multiprocessing.forkserver" in argument for argument in process.cmdline())


class Installation:
    """A supervised service and whatever else is started beside it.

    Parameters
    ----------
    folder
        Of its data, logs and executions.
    settings
        Environment variables on top of this process's own and of its folder and port.
    commands
        What is started: ``hostlens serve``, or processes one by one, which nobody then starts again.
    without
        Variables of this process that the others do not inherit.
    """

    cwd: Path | None = None
    """Where the processes are at home; where this one is, without."""

    def __init__(
        self,
        folder: Path,
        settings: Mapping[str, str],
        commands: Sequence[tuple[str, ...]] = (("service", "serve"),),
        without: Collection[str] = (),
    ) -> None:
        self.folder = folder
        self.port = int(settings.get("HOSTLENS_PORT", 0)) or free_port()
        self.log = folder / "serve.log"
        # Every process of this service, and of no other, has this in its environment.
        self._mark = f"hostlens-{self.port}-{time.time_ns()}"
        self.environment = {
            **{name: value for name, value in os.environ.items() if name not in without},
            _MARK: self._mark,
            "HOSTLENS_DATA_DIR": str(folder / "data"),
            "HOSTLENS_PORT": str(self.port),
            **settings,
        }
        # Closed with this process, however it ends: the service then ends too.
        self._pipe = os.pipe()
        # Without repetitions: whoever looks for outages has to see each.
        self.client = Client(f"http://127.0.0.1:{self.port}", retries=0)
        self.started = [self.start(*command) for command in commands]

    @property
    def process(self) -> subprocess.Popen[bytes]:
        """The process that was started first: the supervisor, unless it does without."""
        return self.started[0]

    @property
    def database(self) -> str:
        """URL of its database."""
        file = self.folder / "data" / "hostlens.sqlite"
        return self.environment.get("HOSTLENS_DATABASE_URL", f"sqlite:///{file}")

    def start(self, module: str, *arguments: str, **changes: str) -> subprocess.Popen[bytes]:
        """Start ``python -m module`` with the service's settings; it ends with this process."""
        with self.log.open("ab") as log:
            return subprocess.Popen(
                [sys.executable, "-m", module, *arguments],
                cwd=self.cwd,
                env={**self.environment, PARENT_FD: str(self._pipe[0]), **changes},
                pass_fds=(self._pipe[0],),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )

    def wait_ready(self, workers: int = 1, timeout_s: float = 2 * PATIENCE_S) -> None:
        """Wait until it computes with at least so many worker threads."""
        eventually(lambda: self.is_ready(workers), timeout_s, "readiness")

    def is_ready(self, workers: int = 1) -> bool:
        """Whether it computes with at least so many worker threads."""
        found = self.readiness()
        return found is not None and found.status == "ready" and found.workers >= workers

    def readiness(self) -> Readiness | None:
        """What /readyz says, None where it does not answer with 200."""
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
                if alive and process.environ().get(_MARK) == self._mark:
                    found.append(process)
        return found

    def child(self, module: str) -> psutil.Process | None:
        """The process of a module, or one of several; None while it is not running."""
        return next(iter(self.children(module)), None)

    def children(self, module: str) -> list[psutil.Process]:
        """All processes of a module: there may be several that answer requests."""
        found = []
        for process in self.processes():
            with suppress(psutil.Error):
                if process.cmdline()[1:3] == ["-m", module]:
                    found.append(process)
        return found

    def workers(self) -> list[psutil.Process]:
        """The processes that compute."""
        found = []
        for process in self.processes():
            with suppress(psutil.Error):
                if is_worker(process):
                    found.append(process)
        return found

    def watch(
        self,
        grid_id: str,
        seen: Callable[[GridView], None] = lambda _: None,
        timeout_s: float = 600.0,
        every_s: float = 0.1,
    ) -> GridView:
        """Wait for the end of a grid, through times in which nobody answers; to ask seldom leaves the cores to it."""
        until = time.monotonic() + timeout_s
        while time.monotonic() < until:
            with suppress(httpx.TransportError, ApiError):
                grid = self.client.status(grid_id)
                seen(grid)
                if grid.finished_at is not None:
                    return grid
            time.sleep(every_s)
        raise DidNotHappenError(f"the grid did not end within {timeout_s:g} s: {self.tail()}")

    def end(self, number: int = signal.SIGINT) -> int:
        """Stop the service as a user would; its exit code."""
        self.process.send_signal(number)
        return self.process.wait(timeout=PATIENCE_S)

    def kill_all(self) -> None:
        """End every process that is left, at once."""
        left = self.processes()
        for process in left:
            with suppress(psutil.Error):
                process.kill()
        # Not until they are reaped: the first process of a container may never do that.
        eventually(lambda: not self.processes(), what="the end of all processes")
        for started in self.started:
            started.wait(timeout=PATIENCE_S)
        self.client.__exit__()
        for end in self._pipe:
            os.close(end)

    def tail(self) -> str:
        """The last lines of the log."""
        return self.log.read_text(errors="replace")[-3000:]
