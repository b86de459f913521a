"""``hostlens drill``: the drills by name, one carried out, its report shown and written."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import NoReturn

import httpx
from rich.console import Console
from rich.table import Table

from service.client import ClientError
from service.drills.drill import Drill, OccupiedError, SizeError, ground
from service.drills.installation import DrillError
from service.drills.kills import DispatcherKills, SchedulerKills, WorkerKills
from service.drills.outages import DiskFull, PostgresKills, SqliteLock
from service.drills.remote import TwoWorkers
from service.drills.requests import Cancel, Idempotency
from service.drills.rivals import Poison, StoppedWorker, TwoDispatchers
from service.drills.scale import Overhead, Throughput
from service.drills.stores import StoreAway
from service.drills.volume import Listing, Submission
from service.drills.workers import Lifetime, SilentWorker

DRILLS: dict[str, type[Drill]] = {
    drill.name: drill
    for drill in (
        DispatcherKills,
        WorkerKills,
        SchedulerKills,
        PostgresKills,
        SqliteLock,
        DiskFull,
        StoreAway,
        StoppedWorker,
        SilentWorker,
        Lifetime,
        TwoDispatchers,
        Poison,
        Cancel,
        Idempotency,
        Throughput,
        Submission,
        Listing,
        Overhead,
        TwoWorkers,
    )
}


def drills_table() -> Table:
    """What there is."""
    table = Table("drill", "what it does to the service", "what must hold")
    for name, drill in DRILLS.items():
        table.add_row(name, drill.what, drill.claim)
    return table


def carry_out(
    console: Console, name: str, *, sizes: Sequence[str], small: bool, database_url: str | None, json_file: Path | None
) -> int:
    """Carry out a drill; 0 if its claims hold, 1 if one does not; a DrillError where it could not be carried out."""
    if name == "list":
        console.print(drills_table())
        return 0
    if name not in DRILLS:
        raise DrillError(f"there is no drill {name}: there are {', '.join(DRILLS)}")
    try:
        drill = DRILLS[name].sized(dict(size.split("=", 1) for size in sizes), small=small)
        with _interruptible(), ground(database_url) as place:
            report = drill.run(place)
    except (DrillError, ClientError, httpx.RequestError, OccupiedError, SizeError) as error:
        raise DrillError(f"drill {name}: {error}") from error
    console.print(report.table())
    if json_file is not None:
        json_file.write_text(report.to_json() + "\n", encoding="utf-8")
    return 0 if report.holds else 1


@contextmanager
def _interruptible() -> Iterator[None]:
    """SIGTERM ends a drill as Ctrl-C does: with everything that it started."""

    def end(_number: int, _frame: FrameType | None) -> NoReturn:
        sys.exit(143)

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
