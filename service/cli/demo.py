"""``hostlens demo``: the whole system once, with four runs of HE0435-1223."""

from __future__ import annotations

import os
import time
from datetime import datetime

import httpx
from rich.console import Console

from service.cli.formatting import duration, summary_table
from service.cli.own_service import StoppedError, own_service, wait_until_ready
from service.cli.watch import progress
from service.client import Client, ClientError
from service.domain.views import GridView
from service.runtime.installation import DidNotHappenError
from service.runtime.settings import Settings
from service.store.artefacts import ArtefactStore

REQUEST = {
    "name": "demo: HE0435-1223, 4 of the paper's 48 runs",
    "preset": "h0licow-vi/HE0435",
    "n": [2, 4],
    "magnitude": [20.5, 21.5],
    "l_eta": [1.0],
    "r_eff": [0.39],
}


def demo(settings: Settings, console: Console, timeout_s: float = 3600.0) -> int:
    """Run the demo; 0 only if every run was stored.

    A fresh database and a free port each time, under ``settings.data_dir``, so that it neither needs nor touches a
    service that is already there.
    """
    began = time.monotonic()
    folder = settings.data_dir.absolute() / f"demo-{datetime.now().astimezone():%Y%m%d-%H%M%S}-{os.getpid()}"
    own = {"data_dir": folder, "database_url": None, "artefact_url": None}
    settings = settings.model_copy(update=own)
    with own_service(settings) as (service, stop):
        client = service.client
        said = f"API, dispatcher and {settings.workers} workers; data in {folder}"
        console.print(said, highlight=False, soft_wrap=True)
        try:
            wait_until_ready(service, stop)
            console.print(f"ready after {duration(time.monotonic() - began)}: http://127.0.0.1:{service.port}")
            grid = client.submit(REQUEST)
            console.print(f"submitted {grid.id}: {grid.n_runs} runs", highlight=False)
            with progress(console) as show:
                grid = client.wait(grid.id, stop.until(show), timeout_s=timeout_s)
            _report(console, client, settings, grid)
        except (ClientError, httpx.RequestError, TimeoutError, DidNotHappenError, StoppedError) as error:
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
