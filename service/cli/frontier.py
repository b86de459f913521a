"""``hostlens frontier``: the cheapest profile that keeps a numerical error."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.cli.connection import Token, Url, connected, console
from service.cli.grids import Format, Where, filters

if TYPE_CHECKING:
    from rich.table import Table

    from service.domain.answers import FrontierAnswer


def frontier(
    max_error: Annotated[float, typer.Argument(help="The largest numerical error, as 0.02 magnitudes")],
    quantity: Annotated[str, typer.Option(help="magnitude, r_eff or n")] = "magnitude",
    where: Where = None,
    estimator: Annotated[str | None, typer.Option(help="The recommended one without, which is image")] = None,
    index_prior: Annotated[str | None, typer.Option(help="wide (n in 0.3-8) without")] = None,
    style: Annotated[Format, typer.Option("--format", help="table or json")] = Format.TABLE,
    url: Url = None,
    token: Token = None,
) -> None:
    """The cheapest profile that keeps a numerical error, by stored runs; exit code 1 where none is known to."""
    if style is Format.CSV:
        raise typer.BadParameter("--format: got 'csv', allowed are table and json")
    asked: dict[str, Any] = filters(where)
    asked |= {"estimator": estimator} if estimator else {}
    asked |= {"index_prior": index_prior} if index_prior else {}
    with connected(url, token) as client:
        found = client.frontier(max_error, quantity, **asked)
    if style is Format.JSON:
        typer.echo(found.model_dump_json(indent=2))
    else:
        typer.echo(found.told)
        if found.profiles:
            console().print(_table(found))
    if found.cheapest is None:
        raise typer.Exit(1)


def _table(found: FrontierAnswer) -> Table:
    """A line for each profile, the cheapest first."""
    from rich import box  # noqa: PLC0415 - as above
    from rich.table import Table  # noqa: PLC0415

    unit = "" if found.unit is None else f" ({found.unit})"
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, title_justify="left")
    table.title = f"Numerical error of {found.quantity}{unit} by {found.estimator}, n {found.index_prior}"
    for name in ("profile", "runs", "median", "95 %", f"below {found.max_error:g}", "68 % interval", "CPU s"):
        table.add_column(name, justify="left" if name == "profile" else "right")
    for row in found.profiles:
        runs = str(row.stored) if row.stored == row.with_error else f"{row.with_error}/{row.stored}"
        share, interval = "", ""
        if row.keeps is not None:
            share, interval = f"{row.keeps.fraction:.2f}", f"{row.keeps.low:.2f}-{row.keeps.high:.2f}"
        numbers = ("" if value is None else f"{value:.2g}" for value in (row.median_error, row.p95_error))
        took = "" if row.cpu_s is None else f"{row.cpu_s:.3g}"
        table.add_row(row.profile, runs, *numbers, share, interval, took)
    return table
