"""``hostlens figures``: the figures of a grid as files."""

from __future__ import annotations

from collections.abc import Iterator
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.cli.connection import FailedError, Token, Url, connected
from service.cli.outputs import require_folder

if TYPE_CHECKING:
    from service.client import Client

_OF_GRID = ("sample", "trends", "coverage", "pull", "montage")
_NOTHING = 404


class FigureFormat(StrEnum):
    """How figures are written."""

    SVG = "svg"
    PNG = "png"


def figures(
    grid: Annotated[str, typer.Argument(help="Its id")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder")] = Path(),
    kind: Annotated[FigureFormat, typer.Option("--format", help="Of the files")] = FigureFormat.SVG,
    url: Url = None,
    token: Token = None,
) -> None:
    """Write the figures of a grid: biases of each system, sample, trends, coverage, pulls, montage."""
    require_folder(output)
    with connected(url, token) as client:
        written = 0
        for name, data in _drawn(client, grid, kind):
            path = output / f"{name}.{kind}"
            path.write_bytes(data)
            typer.echo(path)
            written += 1
        if not written:
            raise FailedError(f"grid {grid} has no result yet that a figure could show")


def _drawn(client: Client, grid_id: str, kind: str) -> Iterator[tuple[str, bytes]]:
    """Each figure that has something to show, as it comes."""
    from service.client import ApiError  # noqa: PLC0415 - what a command needs it loads itself

    client.status(grid_id)
    systems = [str(row.group["system"]) for row in client.summary(grid_id, group_by="system").rows]
    wanted = [(f"bias_{system}", "bias", {"system": system}) for system in systems]
    for name, figure, asked in (*wanted, *((name, name, {}) for name in _OF_GRID)):
        try:
            yield name, client.figure(grid_id, figure, kind, **asked)
        except ApiError as error:
            if error.status != _NOTHING:
                raise
