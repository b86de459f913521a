"""The artefact store goes away in the middle of a grid, and comes back."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import httpx

from tests.drills.drill import Drill, Ground, body
from tests.drills.installation import Installation, eventually, installation
from tests.drills.kills import progress, stored_once
from tests.drills.report import Claim, Figure, Report
from tests.drills.stored import records

_RUN_WITH_ITS_FIGURE = "tests.drills.tasks:pictured"


@dataclass(frozen=True)
class StoreAway(Drill):
    """The folder of the artefacts is no folder for a while: that stops root too, whom permissions do not stop."""

    name: ClassVar[str] = "artefact-store"
    what: ClassVar[str] = "the artefact store takes nothing for 20 s, in a grid of 120 runs"
    claim: ClassVar[str] = "readiness says so, nothing is claimed meanwhile, no run is executed twice or charged"
    small: ClassVar[dict[str, object]] = {"runs": 24, "away_s": 4.0}

    runs: int = 120
    away_s: float = 20.0
    sleep_s: float = 0.2

    def run(self, ground: Ground) -> Report:
        """Take the store away once a quarter of the grid is done."""
        store = ground.folder / "drill" / "store"
        settings = {"HOSTLENS_TASK": _RUN_WITH_ITS_FIGURE, "HOSTLENS_ARTEFACT_URL": str(store)}
        settings |= {"HOSTLENS_DRILL_SLEEP": str(self.sleep_s), **ground.settings}
        with installation(ground.folder / "drill", settings) as service:
            service.wait_ready(2)
            grid = service.client.submit(body(self.runs))
            progress(service, grid.id, self.runs // 4)
            with _away(store):
                gone = time.monotonic()
                eventually(lambda: _is_told(service), what="a readiness that tells of the store")
                told = time.monotonic() - gone
                eventually(lambda: service.client.status(grid.id).counts.leased == _held(service, grid.id), what="rest")
                before = service.client.status(grid.id).counts
                time.sleep(max(self.away_s - (time.monotonic() - gone), 0.0))
                after = service.client.status(grid.id).counts
            back = time.monotonic()
            progress(service, grid.id, after.done + 1)
            resumed = time.monotonic() - back
            service.watch(grid.id)
            found, executed = records(service, grid.id), service.executed()
            shown = _figures_shown(service, grid.id)
        left = [path.name for path in store.rglob("*") if path.is_file() and path.suffix not in {".png", ".npz"}]
        return Report(
            self.name,
            f"{self.runs} runs of {self.sleep_s:g} s, two local workers, {ground.backend}, away for {self.away_s:g} s",
            (
                Figure("stored", found.stored),
                Figure("executions that ended", len(executed)),
                Figure("results held while it was away", before.leased),
                Figure("away to readiness", told, "s"),
                Figure("back to next result", resumed, "s"),
            ),
            (
                stored_once(found, self.runs),
                Claim("no run is executed twice", len(executed) == self.runs),
                Claim("nobody is charged", set(found.outcomes) == {"done"}),
                Claim(
                    "nothing is claimed or stored while it is away",
                    (before.leased, before.done) == (after.leased, after.done),
                ),
                Claim("every figure can be seen", shown == self.runs),
                Claim("nothing is left but artefacts", not left),
            ),
        )


@contextmanager
def _away(store: Path) -> Iterator[None]:
    aside = store.with_name("store.aside")
    store.rename(aside)
    store.touch()
    try:
        yield
    finally:
        store.unlink()
        aside.rename(store)


def _is_told(service: Installation) -> bool:
    found = service.readiness()
    return found is not None and (found.status, found.artefacts) == ("degraded", "away")


def _held(service: Installation, grid_id: str) -> int:
    """Runs that have been executed and are not stored."""
    return len(service.executed()) - service.client.status(grid_id).counts.done


def _figures_shown(service: Installation, grid_id: str) -> int:
    with httpx.Client(base_url=f"http://127.0.0.1:{service.port}", timeout=60.0) as asking:
        runs = asking.get(f"/v1/grids/{grid_id}/runs?limit=1000").json()["items"]
        return sum(asking.get(f"/v1/runs/{run['id']}/figure").status_code == 200 for run in runs)
