"""``python -m tests.drills``: the drills by name, one carried out, its report shown and written."""

from __future__ import annotations

import logging
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Annotated, NoReturn

import httpx
import typer
from rich.console import Console
from rich.table import Table

from service.cli.outputs import require_file
from service.client import ClientError
from service.runtime import preflight, start
from service.runtime.settings import read_settings
from tests.drills.drill import Drill, OccupiedError, SizeError, ground
from tests.drills.installation import DrillError
from tests.drills.kills import DispatcherKills, SchedulerKills, WorkerKills
from tests.drills.outages import DiskFull, PostgresKills, SqliteLock
from tests.drills.remote import TwoWorkers
from tests.drills.rivals import Poison, StoppedWorker, TwoDispatchers
from tests.drills.scale import Breadth, Overhead, Throughput
from tests.drills.stores import StoreAway
from tests.drills.users import Cancel, Idempotency
from tests.drills.volume import Listing, Submission
from tests.drills.workers import SilentWorker

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
        TwoDispatchers,
        Poison,
        Cancel,
        Idempotency,
        Throughput,
        Breadth,
        Submission,
        Listing,
        Overhead,
        TwoWorkers,
    )
}


app = typer.Typer(add_completion=False)


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


def _require_changes(sizes: list[str]) -> None:
    if any("=" not in changed for changed in sizes):
        raise DrillError(f"sizes are given as name=value: {' '.join(sizes)}")


@app.command()
def drill(
    name: Annotated[str, typer.Argument(help="One of those that ``list`` shows")],
    size: Annotated[list[str] | None, typer.Argument(help="Sizes to change, as runs=100")] = None,
    small: Annotated[bool, typer.Option("--small", help="Sizes that take seconds")] = False,
    database_url: Annotated[
        str | None,
        typer.Option(
            "--database", help="URL of an empty database instead of SQLite, or postgresql: a server of its own"
        ),
    ] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="Where to write the report")] = None,
) -> None:
    """Put a promise of the service to the test, on a service of its own; exit code 1 if it does not hold."""
    logging.getLogger("alembic").setLevel(logging.WARNING)
    sizes = size or []
    try:
        _require_changes(sizes)
        if json_file is not None:
            require_file(json_file)
        if database_url is not None and database_url != "postgresql":
            preflight.require_database(read_settings(database_url=database_url))
        code = carry_out(Console(), name, sizes=sizes, small=small, database_url=database_url, json_file=json_file)
    except (DrillError, start.ConfigurationError) as error:
        typer.echo(f"{error}", err=True)
        raise typer.Exit(start.CONFIGURATION) from error
    raise typer.Exit(code)


if __name__ == "__main__":
    start.begin(service=False)
    start.interruptible()
    app()
