"""A service of its own for a drill: real processes in a temporary folder, all gone afterwards."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TypeVar

import httpx
import psutil

import service
from service.client import ApiError, Client
from service.domain.views import GridView, Readiness
from service.runtime.process import PARENT_FD

T = TypeVar("T")
ROOT = Path(service.__file__).resolve().parents[1]
_MARK = "HOSTLENS_DRILL_MARK"
PATIENCE_S = 120.0
"""How long anything is waited for that takes a moment, or ten seconds, on a machine that has nothing else to do."""


class DrillError(RuntimeError):
    """The drill could not be carried out: what it waited for did not happen."""


def free_port() -> int:
    """A port that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def eventually(look: Callable[[], T], timeout_s: float = PATIENCE_S, what: str = "it") -> T:
    """Wait until ``look`` gives something that is true; a DrillError names what did not happen."""
    until = time.monotonic() + timeout_s
    while time.monotonic() < until:
        found = look()
        if found:
            return found
        time.sleep(0.05)
    raise DrillError(f"{what} did not happen within {timeout_s:g} s")


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
    """A supervised service and whatever else a drill starts beside it.

    Parameters
    ----------
    folder
        Of its data, logs and executions.
    settings
        Environment variables on top of a drill's own: a brief task, a free port, a reconciliation every second.
    commands
        What is started: ``hostlens serve``, or processes one by one, which nobody then starts again.
    """

    def __init__(
        self, folder: Path, settings: Mapping[str, str], commands: Sequence[tuple[str, ...]] = (("service", "serve"),)
    ) -> None:
        self.folder = folder
        self.port = free_port()
        self.log = folder / "serve.log"
        self.executions = folder / "executions"
        self.executions.touch()
        # Every process of this service, and of no other, has this in its environment.
        self._mark = f"hostlens-drill-{self.port}-{time.time_ns()}"
        paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
        self.environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(paths),
            _MARK: self._mark,
            "HOSTLENS_DRILL_LOG": str(self.executions),
            "HOSTLENS_TASK": "tests.drills.tasks:brief",
            "HOSTLENS_DATA_DIR": str(folder / "data"),
            "HOSTLENS_PORT": str(self.port),
            "HOSTLENS_RECONCILE_S": "1",
            **settings,
        }
        # Closed with this process, however it ends: the service then ends too.
        self._pipe = os.pipe()
        self.client = Client(f"http://127.0.0.1:{self.port}")
        self.started = [self.start(*command) for command in commands]

    @property
    def process(self) -> subprocess.Popen[bytes]:
        """The process that was started first: the supervisor, unless the drill does without."""
        return self.started[0]

    @property
    def database(self) -> str:
        """URL of its database."""
        file = self.folder / "data" / "hostlens.sqlite"
        return self.environment.get("HOSTLENS_DATABASE_URL", f"sqlite:///{file}")

    def start(self, module: str, *arguments: str, **changes: str) -> subprocess.Popen[bytes]:
        """Start ``python -m module`` with the service's settings; it ends with the drill."""
        with self.log.open("ab") as log:
            return subprocess.Popen(
                [sys.executable, "-m", module, *arguments],
                cwd=self.folder,
                env={**self.environment, PARENT_FD: str(self._pipe[0]), **changes},
                pass_fds=(self._pipe[0],),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )

    def wait_ready(self, workers: int = 1, timeout_s: float = 2 * PATIENCE_S) -> Readiness:
        """Wait until it computes with at least so many worker threads."""

        def look() -> Readiness | None:
            found = self.readiness()
            return found if found is not None and found.status == "ready" and found.workers >= workers else None

        found = eventually(look, timeout_s, "readiness")
        if found is None:  # pragma: no cover - eventually raises instead
            raise DrillError("not ready")
        return found

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

    def executed(self) -> list[str]:
        """Digest of each execution that came to its end."""
        return [line.split()[0] for line in self.executions.read_text().splitlines()]

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
        raise DrillError(f"the grid did not end within {timeout_s:g} s: {self.tail()}")

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
        psutil.wait_procs(left, timeout=PATIENCE_S)
        for started in self.started:
            started.wait(timeout=120)
        self.client.__exit__()
        for end in self._pipe:
            os.close(end)

    def tail(self) -> str:
        """The last lines of the log."""
        return self.log.read_text(errors="replace")[-3000:]


@contextmanager
def installation(
    folder: Path,
    settings: Mapping[str, str],
    *,
    commands: Sequence[tuple[str, ...]] = (("service", "serve"),),
    ready: bool = True,
) -> Iterator[Installation]:
    """A service that computes (or, where it is not to be ``ready``, answers), and is gone afterwards in any case."""
    folder.mkdir(parents=True, exist_ok=True)
    own = Installation(folder, settings, commands)
    try:
        if ready:
            own.wait_ready()
        else:
            eventually(own.readiness, what="an answer")
        yield own
    finally:
        own.kill_all()
