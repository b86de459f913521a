"""Files that a command reads and writes: looked at before the work, not after it."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Collection, Iterable
from pathlib import Path

import typer

PICTURES = frozenset({".png", ".pdf", ".svg"})
FITS = frozenset({".fits", ".fit"})


def as_file_name(name: str) -> str:
    """The name of a system of anybody's, without what a file cannot be called."""
    return re.sub(r"[^\w.+-]", "_", name)[:80]


def require_folder(folder: Path) -> None:
    """Make a folder that can be written; a refusal where that is not allowed."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _try_to_write(folder)
    except OSError as error:
        raise typer.BadParameter(f"{folder}: cannot be written ({error.strerror})") from None


def require_kind(path: Path, suffixes: Collection[str]) -> None:
    """A name that ends in one of ``suffixes``, or any name where there are none; a refusal otherwise."""
    if suffixes and path.suffix.lower() not in suffixes:
        raise typer.BadParameter(f"{path}: allowed is a name that ends in {', '.join(sorted(suffixes))}")


def require_file(path: Path, suffixes: Collection[str] = ()) -> None:
    """A file that can be written, of a kind that its name tells by one of ``suffixes``; a refusal otherwise."""
    require_kind(path, suffixes)
    if path.is_dir():
        raise typer.BadParameter(f"{path}: is a folder")
    if path.exists() and not path.is_file():
        raise typer.BadParameter(f"{path}: is not a file")
    try:
        # A file of this name, because a name may be too long too.
        with tempfile.NamedTemporaryFile(dir=path.absolute().parent, prefix=f".{path.name}."):
            pass
    except OSError as error:
        raise typer.BadParameter(f"{path}: its folder is not there or cannot be written ({error.strerror})") from None


def require_readable(paths: Iterable[Path]) -> None:
    """Files that are there and can be read; a refusal otherwise, before anything that takes time."""
    for path in paths:
        if path.exists() and not path.is_file():
            raise typer.BadParameter(f"{path}: is not a regular file")
        try:
            path.open("rb").close()
        except OSError as error:
            raise typer.BadParameter(f"{path}: cannot be read ({error.strerror})") from None


def require_apart(outputs: Collection[Path], inputs: Collection[Path] = ()) -> None:
    """No file is written twice, and none that is read; a refusal otherwise."""
    seen = {path.resolve() for path in inputs}
    for path in outputs:
        if path.resolve() in seen:
            raise typer.BadParameter(f"{path}: is given twice, or is read as well")
        seen.add(path.resolve())


def _try_to_write(folder: Path) -> None:
    with tempfile.TemporaryFile(dir=folder):
        pass
