"""The body of a request from a file of the user's, whatever is in it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NoReturn

import typer

_MOST = 64 * 2**20
"""No service takes so much by far; a device might go on for ever."""


def read_request(path: Path) -> dict[str, Any]:
    """The JSON object in a file; a refusal that says what else is there."""
    try:
        # A pipe without a writer would be waited for, for ever.
        if path.exists() and not path.is_file():
            raise _refusal(path, "is not a regular file")
        with path.open("rb") as file:
            data = file.read(_MOST + 1)
    except OSError as error:
        raise _refusal(path, f"cannot be read ({error.strerror})") from None
    if len(data) > _MOST:
        raise _refusal(path, f"has more than {_MOST} bytes")
    try:
        document = json.loads(data.decode("utf-8-sig"), parse_constant=_no_number, object_pairs_hook=_unrepeated)
    except UnicodeDecodeError:
        raise _refusal(path, "is not text in UTF-8") from None
    except (ValueError, RecursionError) as error:
        raise _refusal(path, f"is not JSON ({error})") from None
    if not isinstance(document, dict):
        raise _refusal(path, f"holds a JSON {type(document).__name__}, allowed is an object") from None
    return document


def _refusal(path: Path, what: str) -> typer.BadParameter:
    return typer.BadParameter(f"--file: {path} {what}")


def _no_number(text: str) -> NoReturn:
    raise ValueError(f"{text} is not a number")


def _unrepeated(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object; the json module would keep the last of two fields of one name without a word."""
    table = dict(pairs)
    if len(table) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"{next(name for name in names if names.count(name) > 1)!r} is given twice")
    return table
