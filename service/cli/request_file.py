"""What the user has written to a file, whatever is in it: the body of a request, a lens system, a camera.

Without the engine, which takes seconds to load: the service checks what is in it.
"""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any, NoReturn

import typer

_MOST = 64 * 2**20
"""No service takes so much by far; a device might go on for ever."""


def named_or_read(choice: str, option: str) -> str | dict[str, Any]:
    """A system or camera for a request: its name as it is, a TOML or JSON file as the table that it holds."""
    return read_request(Path(choice), option) if choice.lower().endswith((".toml", ".json")) else choice


def read_request(path: Path, option: str) -> dict[str, Any]:
    """The JSON object or TOML table in a file; a refusal that names the option and says what else is there."""
    try:
        # A pipe without a writer would be waited for, for ever.
        if path.exists() and not path.is_file():
            raise _refusal(option, path, "is not a regular file")
        with path.open("rb") as file:
            data = file.read(_MOST + 1)
    except OSError as error:
        raise _refusal(option, path, f"cannot be read ({error.strerror})") from None
    if len(data) > _MOST:
        raise _refusal(option, path, f"has more than {_MOST} bytes")
    kind = "TOML" if path.suffix.lower() == ".toml" else "JSON"
    try:
        text = data.decode("utf-8-sig")
        if kind == "TOML":
            return tomllib.loads(text)
        document = json.loads(text, parse_constant=_no_number, object_pairs_hook=_unrepeated)
    except UnicodeDecodeError:
        raise _refusal(option, path, "is not text in UTF-8") from None
    except (ValueError, RecursionError) as error:
        raise _refusal(option, path, f"is not {kind} ({error})") from None
    if not isinstance(document, dict):
        raise _refusal(option, path, f"holds a JSON {type(document).__name__}, allowed is an object") from None
    return document


def _refusal(option: str, path: Path, what: str) -> typer.BadParameter:
    return typer.BadParameter(f"{option}: {path} {what}")


def _no_number(text: str) -> NoReturn:
    raise ValueError(f"{text} is not a number")


def _unrepeated(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object; the json module would keep the last of two fields of one name without a word."""
    table = dict(pairs)
    if len(table) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"{next(name for name in names if names.count(name) > 1)!r} is given twice")
    return table
