"""Hosts and deflectors as the command line gives them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from service.cli.request_file import named_or_read

HostOption = Annotated[
    list[str] | None,
    typer.Option("--host", help="A made-up galaxy as spiral:3 (kind and seed), or a TOML or JSON file of its fields"),
]
HostImageOption = Annotated[
    list[str] | None,
    typer.Option("--host-image", help="A galaxy's FITS image as the host; FILE.fits[NAME] where it has several"),
]
DeflectorOption = Annotated[
    list[str] | None,
    typer.Option("--deflector", help="A TOML or JSON file of what the lens has beside one profile and one power law"),
]
_MOST = 32
"""Letters of a name."""


def hosts_asked(hosts: Sequence[str] | None, images: Sequence[str] | None) -> list[dict[str, Any]]:
    """Hosts as a request has them."""
    return [*map(_host, hosts or ()), *map(_image, images or ())]


def deflectors_asked(choices: Sequence[str] | None) -> list[dict[str, Any]]:
    """Deflectors as a request has them."""
    found = []
    for choice in choices or ():
        read = named_or_read(choice, "--deflector")
        if isinstance(read, str):
            raise typer.BadParameter(f"--deflector: {choice} is neither a .toml nor a .json file")
        found.append(read)
    return found


def _host(choice: str) -> dict[str, Any]:
    read = named_or_read(choice, "--host")
    if not isinstance(read, str):
        return read
    kind, _, seed = choice.partition(":")
    if seed and not seed.isdecimal():
        raise typer.BadParameter(f"--host: the seed of {choice} is no whole number")
    return {"made": {"kind": kind, "seed": int(seed or 0)}}


def _image(choice: str) -> dict[str, Any]:
    from engine import EngineError, read_host_image  # noqa: PLC0415 - takes a second to load

    name, bracket, rest = choice.partition("[")
    path, extension = Path(name), rest.removesuffix("]") if bracket else None
    try:
        image = read_host_image(path, extension=extension)
    except (EngineError, OSError) as error:
        raise typer.BadParameter(f"--host-image: {path}: {error}") from error
    name = re.sub(r"[^A-Za-z0-9+._-]+", "-", extension or path.stem).strip("-._+")[:_MOST]
    return {"image": asdict(image)} | ({"name": name} if name else {})
