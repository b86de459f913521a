"""``hostlens demo``: the whole system once, with four runs of HE0435-1223."""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from types import FrameType

import httpx
from rich.console import Console

from service.cli.formatting import duration, summary_table
from service.cli.watch import Show, progress
from service.client import Client, ClientError
from service.domain.views import GridView
from service.runtime.settings import Settings
from service.runtime.start import STOPS
from service.runtime.supervisor import Supervisor
from service.store.artefacts import ArtefactStore

REQUEST = {
    "name": "demo: HE0435-1223, 4 of the paper's 48 runs",
    "preset": "h0licow-vi/HE0435",
    "n": [2, 4],
    "magnitude": [20.5, 21.5],
    "l_eta": [1.0],
    "r_eff": [0.39],
}
_READY_S = 120.0


def demo(settings: Settings, console: Console, timeout_s: float = 3600.0) -> int:
    """Run the demo; 0 only if every run was stored.

    A fresh database and a free port each time, under ``settings.data_dir``, so that it neither needs nor touches a
    service that is already there.
    """
    began = time.monotonic()
    folder = settings.data_dir.absolute() / f"demo-{datetime.now().astimezone():%Y%m%d-%H%M%S}-{os.getpid()}"
    own = {
        "data_dir": folder,
        "database_url": None,
        "artefact_url": None,
        "host": "127.0.0.1",
        "port": _free_port(),
    }
    settings = settings.model_copy(update=own)
    with _running(settings) as stop, Client(f"http://127.0.0.1:{settings.port}") as client:
        said = f"API, dispatcher and {settings.workers} workers; data in {folder}"
        console.print(said, highlight=False, soft_wrap=True)
        try:
            _wait_ready(client, stop)
            console.print(f"ready after {duration(time.monotonic() - began)}: http://127.0.0.1:{settings.port}")
            grid = client.submit(REQUEST)
            console.print(f"submitted {grid.id}: {grid.n_runs} runs", highlight=False)
            with progress(console) as show:
                grid = client.wait(grid.id, _until(stop, show), timeout_s=timeout_s)
            _report(console, client, settings, grid)
        except (ClientError, httpx.RequestError, TimeoutError, _StoppedError) as error:
            console.print(f"the demo ends early: {error}", markup=False, soft_wrap=True)
            return 128 + stop.number if stop.number else 1
    console.print(f"wall time {duration(time.monotonic() - began)}; all processes have ended")
    return 0 if grid.counts.done == grid.n_runs else 1


def _report(console: Console, client: Client, settings: Settings, grid: GridView) -> None:
    console.print(summary_table(client.summary(grid.id)))
    artefacts = ArtefactStore(settings.artefacts)
    for run in client.runs(grid.id):
        found = client.run(run.id)
        if found.result is not None and found.result.figure is not None:
            where: str = artefacts.path(found.result.figure)
        else:
            where = f"{run.state}" + (f", {run.error.code}: {run.error.detail}" if run.error else "")
        console.print(f"figure of {run.label}: {where}", markup=False, highlight=False, soft_wrap=True)


class _StoppedError(RuntimeError):
    """Someone pressed Ctrl-C."""


class _Wanted(threading.Event):
    """Set by the signal ``number``."""

    number = 0

    def by_signal(self, number: int, _frame: FrameType | None) -> None:
        """Handle it."""
        self.number = number
        self.set()


def _until(stop: threading.Event, show: Show) -> Show:
    def shown(grid: GridView) -> None:
        show(grid)
        if stop.is_set():
            raise _StoppedError("interrupted")

    return shown


@contextmanager
def _running(settings: Settings) -> Iterator[_Wanted]:
    """The supervised service for as long as the context lasts; the event is set when the user wants to stop."""
    supervisor = Supervisor(settings, log_folder=settings.data_dir)
    supervisor.prepare()
    wanted, end = _Wanted(), threading.Event()
    before = {number: signal.signal(number, wanted.by_signal) for number in STOPS}
    thread = threading.Thread(target=supervisor.run, args=(end,), name="supervisor")
    thread.start()
    try:
        yield wanted
    finally:
        end.set()
        thread.join()
        for number, handler in before.items():
            signal.signal(number, handler)


def _wait_ready(client: Client, stop: threading.Event) -> None:
    until = time.monotonic() + _READY_S
    while time.monotonic() < until:
        try:
            if client.readiness().status == "ready":
                return
        except (httpx.RequestError, ClientError):
            pass  # the API is still starting
        if stop.wait(0.2):
            raise _StoppedError("interrupted")
    raise TimeoutError(f"the service is not ready after {_READY_S:g} s")


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port
