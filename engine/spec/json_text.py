"""JSON that somebody else wrote, read strictly: a field given twice is refused, and so is nesting without end."""

from __future__ import annotations

import json
from typing import Any

from engine.errors import SpecError
from engine.spec.validation import field_path

_DEEPEST = 32
_LONGEST_INTEGER = 4000  # digits; Python refuses to read longer ones than 4300


class _Repeating(dict[str, Any]):
    """A table in which ``field`` was given more than once."""

    field = ""


def read_json(text: str) -> Any:
    """What a JSON text says. NaN, Infinity and numbers beyond a double are left to who checks the fields: not finite.

    Raises
    ------
    SpecError
        The text is not JSON, holds what is no text, gives a field twice (the json module would keep the last without a
        word), or has tables and lists more than 32 deep within each other; it names the place.
    """
    try:
        document = json.loads(text, object_pairs_hook=_table, parse_int=_integer)
    except json.JSONDecodeError as error:
        raise SpecError("", text[error.pos : error.pos + 20], f"valid JSON: {error}") from error
    except RecursionError as error:
        raise SpecError("", "deeper nesting", f"{_DEEPEST} tables and lists within each other") from error
    if isinstance(document, dict | list):
        _check(document)
    return document


def _table(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) == len(pairs):
        return table
    repeating = _Repeating(table)
    seen: set[str] = set()
    for name, _ in pairs:
        if name in seen:
            repeating.field = name
            break
        seen.add(name)
    return repeating


def _integer(digits: str) -> int | float:
    return int(digits) if len(digits) <= _LONGEST_INTEGER else float(digits)


def _check(document: Any) -> None:
    waiting: list[tuple[tuple[int | str, ...], Any]] = [((), document)]
    while waiting:
        steps, value = waiting.pop()
        if isinstance(value, _Repeating):
            raise SpecError(field_path((*steps, value.field)), "two values", "one")
        if len(steps) >= _DEEPEST:
            raise SpecError(field_path(steps), "deeper nesting", f"{_DEEPEST} tables and lists within each other")
        for step, part in value.items() if isinstance(value, dict) else enumerate(value):
            if isinstance(part, dict | list):
                waiting.append(((*steps, step), part))
            for text in (step, part):
                if isinstance(text, str) and not _is_unicode(text):
                    raise SpecError(field_path((*steps, step)), text, "text that UTF-8 can carry")


def _is_unicode(text: str) -> bool:
    """Whether a text is without lone surrogates, which JSON can escape and nothing can store."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True
