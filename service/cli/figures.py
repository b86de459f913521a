"""``hostlens figures``: the figures of a grid as files."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from service.client import Client

OF_GRID = ("sample", "trends", "coverage", "pull", "montage")
_NOTHING = 404


def write_figures(client: Client, grid_id: str, folder: Path, kind: str) -> Iterator[Path]:
    """Write the bias figure of each system and the others of the grid; the files, as they come.

    A figure that has nothing to show yet is left out.
    """
    systems = sorted({str(run.inputs["system"]) for run in client.runs(grid_id)})
    wanted = [(f"bias_{system}", "bias", {"system": system}) for system in systems]
    wanted += [(name, name, {}) for name in OF_GRID]
    for file, name, asked in wanted:
        data = _figure(client, grid_id, name, kind, asked)
        if data is not None:
            path = folder / f"{file}.{kind}"
            path.write_bytes(data)
            yield path


def _figure(client: Client, grid_id: str, name: str, kind: str, asked: dict[str, str]) -> bytes | None:
    from service.client import ApiError  # noqa: PLC0415 - loads httpx, which help needs not

    try:
        return client.figure(grid_id, name, kind, **asked)
    except ApiError as error:
        if error.status == _NOTHING:
            return None
        raise
