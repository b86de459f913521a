"""What a failed validation says: the path of the field, the value it had and what is allowed.

pydantic finds the errors; here they become a :class:`~engine.errors.SpecError` in the words of this project.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from typing import Any

from pydantic import ValidationError

from engine.errors import SpecError, shown

NAME_TAG = "<name>"
OBJECT_TAG = "<object>"
LIST_TAG = "<list>"
IDENTIFIER = r"^[A-Za-z0-9][A-Za-z0-9+._/-]*$"
DECIMAL = r"^[0-9]{1,2}(\.[0-9]{1,20})?$"
PRINTABLE = (
    r"^[^\p{C}\p{Z}\p{Default_Ignorable_Code_Point}]"
    r"([^\p{C}\p{Zl}\p{Zp}\p{Default_Ignorable_Code_Point}]*[^\p{C}\p{Z}\p{Default_Ignorable_Code_Point}])?$"
)
"""Text that is seen as it is: no control characters, nothing that turns the direction of writing or has no width,
nothing unassigned, no space at either end."""
_PATTERNS = {
    IDENTIFIER: "a name of letters, digits and + . _ / -",
    DECIMAL: "a decimal number, as 0.9",
    PRINTABLE: "text of characters that can be seen, without space at its ends",
}
_SIMPLE_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
# A step of a path as field_path writes it: [index], ["any key"] in JSON's quotes, or a name.
_STEP = re.compile(r'\[(\d+)\]|\[("(?:[^"\\]|\\.)*")\]|\.?([A-Za-z_][A-Za-z0-9_]*)')
_CHOICES = frozenset({"system", "camera", "dither", "optics"})

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
    "string_unicode": "text that UTF-8 can carry",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "enum": "{expected}",
    "model_attributes_type": "a JSON object",
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


def one_or_list(value: object) -> str:
    """Which half of a union is meant by a value: a list of objects, or one of them."""
    return LIST_TAG if isinstance(value, list | tuple) else OBJECT_TAG


def field_path(steps: Sequence[int | str]) -> str:
    """Steps as people write them: ``agn[1].magnitude``, ``mass_models.recommended["1.0"].q``."""
    path = ""
    for step in steps:
        if isinstance(step, int):
            path += f"[{step}]"
        elif _SIMPLE_NAME.fullmatch(step):
            path += f".{step}" if path else step
        else:
            path += f"[{json.dumps(step)}]"
    return path


def path_steps(path: str) -> tuple[int | str, ...]:
    """The steps of a path as :func:`field_path` writes it."""
    return tuple(int(index) if index else json.loads(key) if key else name for index, key, name in _STEP.findall(path))


def _field_steps(error: Any) -> tuple[int | str, ...]:
    """A pydantic location without what pydantic adds: the tags of unions, and the mark of an error of a key itself."""
    steps: list[int | str] = []
    location = error["loc"]
    for before, step in zip((None, *location), location, strict=False):
        tag = step in {NAME_TAG, OBJECT_TAG, LIST_TAG} and (isinstance(before, int) or before in _CHOICES)
        if not tag:
            steps.append(step)
    if steps and steps[-1] == "[key]" and error["type"] not in {"extra_forbidden", "unexpected_keyword_argument"}:
        steps.pop()
    return tuple(steps)


def complaint(error: Any) -> tuple[tuple[int | str, ...], object, str]:
    """One entry of ``ValidationError.errors()``: the steps to its field, the value (shortened), what is allowed."""
    steps, kind, context = _field_steps(error), error["type"], error.get("ctx", {})
    cause = context.get("error")
    if isinstance(cause, SpecError):  # a check across several fields
        return (*steps, *path_steps(cause.field)), shown(cause.value), cause.allowed
    value = None if kind == "missing" else error.get("input")
    if kind == "string_pattern_mismatch":
        pattern = context["pattern"]
        return steps, shown(value), _PATTERNS.get(pattern, f"text that matches {pattern}")
    return steps, shown(value), _ALLOWED[kind].format(**context) if kind in _ALLOWED else error["msg"]


def spec_error(error: ValidationError, prefix: str = "") -> SpecError:
    """The first complaint of a pydantic validation as a SpecError with field, value and what is allowed."""
    steps, value, allowed = complaint(error.errors()[0])
    parts = [part for part in (prefix, field_path(steps)) if part]
    return SpecError(".".join(parts) or "specification", value, allowed)
