"""What a failed validation says: the path of the field, the value it had and what is allowed.

pydantic finds the errors; here they become a :class:`~engine.errors.SpecError` in the words of this project.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from pydantic import ValidationError

from engine.errors import SpecError

NAME_TAG = "<name>"
OBJECT_TAG = "<object>"
_SIMPLE_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_LONGEST_VALUE = 80

# What is allowed, by pydantic's error type; the values in braces are those of its context.
_ALLOWED = {
    "missing": "a value: the field is required",
    "extra_forbidden": "no field of this name",
    "unexpected_keyword_argument": "no field of this name",
    "float_type": "a finite number",
    "float_parsing": "a finite number",
    "finite_number": "a finite number",
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "string_type": "text",
    "string_too_short": "text of at least {min_length} characters",
    "string_too_long": "text of at most {max_length} characters",
    "string_pattern_mismatch": "a name of letters, digits and + . _ / -",
    "greater_than": "a number above {gt}",
    "greater_than_equal": "a number of at least {ge}",
    "less_than": "a number below {lt}",
    "less_than_equal": "a number of at most {le}",
    "literal_error": "{expected}",
    "dataclass_type": "a table of its fields",
    "dict_type": "a table",
    "tuple_type": "a list",
    "list_type": "a list",
    "too_short": "at least {min_length} entries",
    "too_long": "at most {max_length} entries",
}


def name_or_object(value: object) -> str:
    """Which half of a union is meant by a value: the name of a catalogue entry, or an object of one's own."""
    return NAME_TAG if isinstance(value, str) else OBJECT_TAG


def field_steps(location: Sequence[int | str]) -> tuple[int | str, ...]:
    """A pydantic location without the tags of the unions that it went through."""
    return tuple(step for step in location if step not in {NAME_TAG, OBJECT_TAG})


def field_path(location: Sequence[int | str]) -> str:
    """A location as people write it: ``agn[1].magnitude``, ``mass_models.recommended["1.0"].q``."""
    path = ""
    for step in field_steps(location):
        if isinstance(step, int):
            path += f"[{step}]"
        elif _SIMPLE_NAME.fullmatch(step):
            path += f".{step}" if path else step
        else:
            path += f'["{step}"]'
    return path


def _shown(value: object) -> object:
    """The value, or what it is where it is too long to be repeated."""
    if len(repr(value)) <= _LONGEST_VALUE:
        return value
    if isinstance(value, dict):
        return f"a table of {len(value)} fields"
    if isinstance(value, list | tuple):
        return f"a list of {len(value)} entries"
    return f"{str(value)[:_LONGEST_VALUE]}..."


def spec_error(error: ValidationError, prefix: str = "") -> SpecError:
    """The first complaint of a pydantic validation as a SpecError with field, value and what is allowed."""
    first: Any = error.errors()[0]
    field, kind, context = field_path(first["loc"]), first["type"], first.get("ctx", {})
    cause = context.get("error")
    if isinstance(cause, SpecError):  # a check across several fields
        inner = cause.field if cause.field.startswith("[") or not field else f".{cause.field}"
        field, value, allowed = field + inner, cause.value, cause.allowed
    else:
        value = None if kind == "missing" else first.get("input")
        allowed = _ALLOWED[kind].format(**context) if kind in _ALLOWED else first["msg"]
    parts = [part for part in (prefix, field) if part]
    return SpecError(".".join(parts) or "specification", _shown(value), allowed)
