"""``hostlens demo``: the whole system once, with four runs of HE0435-1223."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from types import FrameType

import httpx
from rich.console import Console

from service.cli.formatting import duration, summary_table
from service.cli.watch import Show, progress
from service.client import Client, ClientError
from service.domain.views import GridView
from service.runtime import preflight
from service.runtime.installation import DidNotHappenError, Installation, eventually, free_port
from service.runtime.settings import Settings
from service.runtime.start import STOPS
from service.runtime.supervisor import as_environment
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
    own = {"data_dir": folder, "database_url": None, "artefact_url": None, "host": "127.0.0.1"}
    settings = settings.model_copy(update=own)
    preflight.require_data(settings)
    with _running(folder, settings) as (service, stop):
        client = service.client
        said = f"API, dispatcher and {settings.workers} workers; data in {folder}"
        console.print(said, highlight=False, soft_wrap=True)
        try:
            eventually(lambda: stop.is_set() or service.is_ready(), _READY_S, "readiness")
            stop.require_unset()
            console.print(f"ready after {duration(time.monotonic() - began)}: http://127.0.0.1:{service.port}")
            grid = client.submit(REQUEST)
            console.print(f"submitted {grid.id}: {grid.n_runs} runs", highlight=False)
            with progress(console) as show:
                grid = client.wait(grid.id, _until(stop, show), timeout_s=timeout_s)
            _report(console, client, settings, grid)
        except (ClientError, httpx.RequestError, TimeoutError, DidNotHappenError, _StoppedError) as error:
            console.print(f"the demo ends early: {error}", markup=False, soft_wrap=True)
            return 128 + stop.number if stop.number else 1
    console.print(f"wall time {duration(time.monotonic() - began)}; all processes have ended")
    return 0 if grid.counts.done == grid.n_runs else 1


def _report(console: Console, client: Client, settings: Settings, grid: GridView) -> None:
    console.print(summary_table(client.grid_summary(grid.id)))
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

    def require_unset(self) -> None:
        """Go no further once it is set."""
        if self.is_set():
            raise _StoppedError("interrupted")


def _until(stop: _Wanted, show: Show) -> Show:
    def shown(grid: GridView) -> None:
        show(grid)
        stop.require_unset()

    return shown


@contextmanager
def _running(folder: Path, settings: Settings) -> Iterator[tuple[Installation, _Wanted]]:
    """The supervised service for as long as the context lasts; the event is set when the user wants to stop."""
    variables = as_environment(settings.model_copy(update={"port": free_port()}))
    wanted = _Wanted()
    before = {number: signal.signal(number, wanted.by_signal) for number in STOPS}
    unset = [name for name in os.environ if name.startswith("HOSTLENS_")]
    service = Installation(folder, variables, without=unset)
    try:
        yield service, wanted
    finally:
        with suppress(subprocess.TimeoutExpired):
            service.end(signal.SIGTERM)
        service.kill_all()
        for number, handler in before.items():
            signal.signal(number, handler)
