"""``hostlens serve``: API and dispatcher as two processes of one machine, restarted when they die, ended together."""

from __future__ import annotations

import json
import logging
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from threading import Event, Thread

import httpx

from service.client import Client, ClientError
from service.runtime import preflight, start
from service.runtime.process import API_NUMBER, LISTENER_FD, METRICS_DIR, PARENT_FD, stop_with_parent
from service.runtime.settings import Settings
from service.store.database import is_at_head

_LOG = logging.getLogger(__name__)
_FIRST_DELAY_S = 0.1
_MAX_DELAY_S = 30.0
_STEADY_S = 2.0
"""A child that has run for so long could start: when it ends, its next start is not put off."""
_LOOK_S = 0.05
_ASK_S = 0.2
_BACKLOG = 2048
API = "service.api"


@dataclass
class _Child:
    """One supervised process and how it has been doing."""

    module: str
    number: int = 0
    """Among those of its module."""
    process: subprocess.Popen[bytes] | None = None
    started: float = 0.0
    due: float = 0.0
    delay: float = _FIRST_DELAY_S
    starts: int = field(default=0)
    steady: bool = False


class Supervisor:
    """Keeps the processes of one machine running.

    There may be several API processes. All accept from one socket, which is listened on here: a connection goes to
    whichever is free, and while one starts again those that came for it wait. Their metrics lie in files, so that any
    of them tells those of all.

    Each child leads a process group of its own: Ctrl-C in a terminal reaches the supervisor alone, and whatever a
    dead dispatcher leaves behind (Dask's workers) can be ended with it. Each child also watches a pipe from here, so
    that it ends when the supervisor is killed.
    """

    def __init__(
        self,
        settings: Settings,
        modules: tuple[str, ...] = (API, "service.dispatcher"),
    ) -> None:
        self._settings = settings
        counts = {API: settings.api_processes}
        self._children = [_Child(module, number) for module in modules for number in range(counts.get(module, 1))]
        self._serves_api = API in modules
        self._listener: socket.socket | None = None
        several = settings.api_processes > 1
        self._metrics = settings.data_dir.absolute() / f"metrics-{settings.port}" if several else None
        self._pipe = os.pipe()
        os.set_inheritable(self._pipe[0], True)

    def prepare(self) -> None:
        """Look whether all is there, create the data folder and bring the database up to date.

        Raises
        ------
        service.runtime.settings.ConfigurationError
            Something is not there, or belongs to somebody else.
        """
        preflight.for_both(self._settings)
        if not is_at_head(self._settings.database):
            from service.store.migrate import upgrade  # noqa: PLC0415 - Alembic takes a third of this process's start

            upgrade(self._settings.database)
        preflight.require_token(self._settings)

    def run(self, stop: Event, serves: Callable[[], None] = lambda: None) -> int:
        """Start the processes and keep them running until ``stop`` is set; none is left afterwards.

        ``serves`` is called, from another thread, once requests are answered and somebody dispatches. The exit code is
        0, or that of a child that could not start for its configuration: the next start would end in the same way.
        """
        ended = Event()
        try:
            self._settle()
            for child in self._children:
                self._start(child)
            Thread(target=self._announce, args=(ended, serves), name="announce", daemon=True).start()
            while not stop.wait(_LOOK_S):
                for child in self._children:
                    if self._look_after(child) == start.CONFIGURATION:
                        return start.CONFIGURATION
            return 0
        finally:
            ended.set()
            self._end_all()

    def _settle(self) -> None:
        """Listen, and take away what API processes of an earlier time have left of their metrics."""
        if self._serves_api:
            self._listener = preflight.listening(self._settings.host, self._settings.port, preflight.API_PORT)
            self._listener.listen(_BACKLOG)
        if self._metrics is not None:
            shutil.rmtree(self._metrics, ignore_errors=True)
            self._metrics.mkdir(parents=True)

    def _given(self, child: _Child) -> tuple[dict[str, str], tuple[int, ...]]:
        """What a child is told of its siblings and of this process, and the descriptors that it takes over."""
        environment = {PARENT_FD: str(self._pipe[0])}
        descriptors: tuple[int, ...] = (self._pipe[0],)
        if child.module == API and self._listener is not None:
            descriptors += (self._listener.fileno(),)
            environment[LISTENER_FD] = str(self._listener.fileno())
            if self._metrics is not None:
                environment |= {API_NUMBER: str(child.number), METRICS_DIR: str(self._metrics)}
        return environment, descriptors

    def _start(self, child: _Child) -> None:
        given, descriptors = self._given(child)
        environment = {**os.environ, **given, **as_environment(self._settings)}
        with start.kept_back():
            child.process = subprocess.Popen(
                [sys.executable, "-m", child.module],
                env=environment,
                stdin=subprocess.DEVNULL,
                pass_fds=descriptors,
                start_new_session=True,
            )
        child.started = time.monotonic()
        child.starts += 1
        _LOG.info("%s runs as process %d", child.module, child.process.pid)

    def _announce(self, ended: Event, serves: Callable[[], None]) -> None:
        """Ask until the service answers and has a leader, be it one of another machine."""
        with Client(self._settings.url) as client:
            while not ended.wait(_ASK_S):
                try:
                    if client.readiness().dispatcher != "ok":
                        continue
                except (ClientError, httpx.RequestError):
                    continue
                serves()
                return

    def _look_after(self, child: _Child) -> int | None:
        """Start a child that is due; the exit code of one that has just ended and never ran well."""
        if child.process is None:
            if time.monotonic() >= child.due:
                self._start(child)
            return None
        if not _has_ended(child.process):
            return None
        _end_group(child.process)
        code = child.process.wait()
        child.process = None
        if time.monotonic() - child.started > _STEADY_S:
            child.delay = 0.0
            child.steady = True
        if code == start.CONFIGURATION and not child.steady:
            _LOG.error("%s cannot start: its last line says why", child.module)
            return code
        _LOG.warning("%s ended with %d; next start in %.1f s", child.module, code, child.delay)
        child.due = time.monotonic() + child.delay
        child.delay = min(max(2 * child.delay, _FIRST_DELAY_S), _MAX_DELAY_S)
        return None

    def _end_all(self) -> None:
        running = [child.process for child in self._children if child.process is not None]
        for process in running:
            with suppress(ProcessLookupError):
                process.terminate()
        until = time.monotonic() + self._settings.stop_grace_s
        while time.monotonic() < until and not all(_has_ended(process) for process in running):
            time.sleep(_LOOK_S / 2)
        for process in running:
            _end_group(process)
            process.wait()
        for end in self._pipe:
            os.close(end)
        if self._listener is not None:
            self._listener.close()
        if self._metrics is not None:
            shutil.rmtree(self._metrics, ignore_errors=True)


def _has_ended(process: subprocess.Popen[bytes]) -> bool:
    """Whether a child has ended, without taking its exit status.

    Until that is taken its number cannot go to another process, and neither can its group's.
    """
    if process.returncode is not None:
        return True
    return os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None


def _end_group(process: subprocess.Popen[bytes]) -> None:
    """End whatever is left of a child and of what it started."""
    if process.returncode is None:
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)


def as_environment(settings: Settings) -> dict[str, str]:
    """The settings as the variables that the children read, so that all agree whatever came from the command line."""
    values = settings.model_dump(mode="json", exclude_none=True)
    plain = {name: json.dumps(value) if isinstance(value, list) else str(value) for name, value in values.items()}
    return {f"HOSTLENS_{name.upper()}": value for name, value in plain.items()}


def serve(settings: Settings, serves: Callable[[], None] = lambda: None) -> int:
    """Run API and dispatcher until SIGINT or SIGTERM; the exit code, as :meth:`Supervisor.run`."""
    stop_with_parent()
    supervisor = Supervisor(settings)
    # A signal meanwhile ends this process at once; a migration is a transaction, and does not happen then.
    supervisor.prepare()
    stop = Event()
    for number in start.STOPS:
        signal.signal(number, lambda *_: stop.set())
    return supervisor.run(stop, serves)
