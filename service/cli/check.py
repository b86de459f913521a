"""``hostlens check``: does this installation keep its promise? Processes are killed, and each result is there once."""

from __future__ import annotations

import os
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import httpx
import psutil
from rich.console import Console

from service.client import ClientError
from service.domain.views import GridView
from service.runtime.installation import DidNotHappenError, Installation, eventually
from service.runtime.start import ConfigurationError
from service.store.database import Database
from service.store.grids import GridStore
from service.store.migrate import upgrade

_RUNS = 40
_REQUEST = {
    "name": "hostlens check", "preset": "h0licow-vi/HE0435", "replicates": _RUNS,
    "n": [2], "magnitude": [20.5], "l_eta": [1.0], "r_eff": [0.39],
}  # fmt: skip
_SETTINGS = {
    "HOSTLENS_TASK": "service.worker.synthetic:brief",
    "HOSTLENS_DRILL_SLEEP": "0.5",
    "HOSTLENS_WORKERS": "2",
    "HOSTLENS_RECONCILE_S": "1",
}
_PATIENCE_S = 300.0


def check(console: Console, database_url: str | None = None) -> int:
    """Kill a worker and the dispatcher of a service of its own while a grid is under way; 0 if the promise holds.

    Runs stand in for those of the engine. ``database_url`` is that of an empty database, a SQLite file where None.

    Raises
    ------
    service.runtime.start.ConfigurationError
        The database holds grids: their runs would be given results that are none.
    """
    if database_url is not None:
        _require_empty(database_url)
    others = [name for name in os.environ if name.startswith("HOSTLENS_")]
    with tempfile.TemporaryDirectory(prefix="hostlens-check-", ignore_cleanup_errors=True) as folder:
        console.print(f"a service of its own in {folder}, {_RUNS} runs of half a second", highlight=False)
        chosen = {} if database_url is None else {"HOSTLENS_DATABASE_URL": database_url}
        service = Installation(Path(folder), {**_SETTINGS, **chosen}, without=others)
        try:
            return _carry_out(console, service)
        except (DidNotHappenError, ClientError, httpx.RequestError, psutil.Error) as error:
            console.print(f"could not be carried out: {error}", markup=False, highlight=False, soft_wrap=True)
            console.print(service.tail(), markup=False, highlight=False)
            return 1
        finally:
            service.kill_all()


def _carry_out(console: Console, service: Installation) -> int:
    began = time.monotonic()
    service.wait_ready(workers=2, timeout_s=_PATIENCE_S)
    console.print(f"ready after {time.monotonic() - began:.0f} s")
    grid = service.client.submit(_REQUEST)
    for done, what, find in (
        (_RUNS // 8, "a worker", lambda: next(iter(service.workers()), None)),
        (_RUNS // 3, "the dispatcher", lambda: service.child("service.dispatcher")),
    ):
        _kill(console, service, grid, done, what, find)
    ended = service.watch(grid.id, timeout_s=_PATIENCE_S)
    found = [service.client.run(run.id) for run in service.client.runs(grid.id)]
    outcomes = Counter(attempt.outcome for run in found for attempt in run.attempts)
    once = [run for run in found if run.result is not None and [a.outcome for a in run.attempts].count("done") == 1]
    code = service.end()
    claims = {
        f"{_RUNS} runs done: {ended.counts.done}": ended.counts.done == _RUNS,
        f"each result stored exactly once: {len(once)} of {len(found)}": len(once) == len(found) == _RUNS,
        f"the service stopped as it was told: exit code {code}, {len(service.processes())} processes left": (
            code == 0 and not service.processes()
        ),
    }
    for claim, holds in claims.items():
        console.print(f"{'ok    ' if holds else 'FAILED'} {claim}", highlight=False)
    told = ", ".join(f"{count} {outcome}" for outcome, count in outcomes.items())
    console.print(f"attempts: {told}; {time.monotonic() - began:.0f} s", highlight=False)
    return 0 if all(claims.values()) else 1


def _kill(
    console: Console,
    service: Installation,
    grid: GridView,
    done: int,
    what: str,
    find: Callable[[], psutil.Process | None],
) -> None:
    """Kill -9, once so many runs are done; wait for the next result."""
    eventually(lambda: service.client.status(grid.id).counts.done >= done, _PATIENCE_S, f"{done} results")
    process = eventually(find, _PATIENCE_S, what)
    if process is not None:
        process.kill()
    killed, before = time.monotonic(), service.client.status(grid.id).counts.done
    eventually(lambda: service.client.status(grid.id).counts.done > before, _PATIENCE_S, f"a result after {what} died")
    console.print(f"killed {what} after {before} results; the next one {time.monotonic() - killed:.1f} s later")


def _require_empty(url: str) -> None:
    upgrade(url)
    with closing(Database(url, pooled=False)) as database:
        if GridStore(database).grids(1, kind="all").items:
            raise ConfigurationError("--database: it holds grids; a check needs an empty one, or none at all")
