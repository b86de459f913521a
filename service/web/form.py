"""A form from a JSON schema: its fields, what was typed into them as a document, and errors at their fields."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

Kind = Literal["text", "number", "integer", "boolean", "list", "json"]
_UNBOUNDED = 1e9
_SCALARS: dict[str, Kind] = {"string": "text", "number": "number", "integer": "integer", "boolean": "boolean"}


@dataclass(frozen=True)
class Field:
    """A field: ``name`` is the path in the document, as ``analysis.walkers``."""

    name: str
    label: str
    kind: Kind
    hint: str
    blank: str
    options: tuple[str, ...] = ()
    items: Kind = "text"
    """What a list holds."""
    is_long: bool = False
    """It may hold an object of one's own."""
    value: str = ""
    error: str = ""


def form_fields(schema: Mapping[str, Any], prefix: str = "") -> list[Field]:
    """The fields of an object's schema in its order; those of a field whose schema is ``analysis`` are flattened."""
    definitions = schema.get("$defs", {})
    found: list[Field] = []
    for name, given in schema["properties"].items():
        parts = [part for part in given.get("anyOf", [given]) if part.get("type") != "null"]
        one = parts[0] if parts else given
        target = definitions.get(one.get("$ref", "").rpartition("/")[2])
        if target is not None and all(_is_optional(part) for part in target["properties"].values()):
            found += form_fields({**target, "$defs": definitions}, f"{prefix}{name}.")
        else:
            found.append(_field(f"{prefix}{name}", name, one, given.get("default")))
    return found


def document_of(
    fields: Iterable[Field], typed: Mapping[str, str], read_json: Callable[[str], Any]
) -> tuple[dict[str, Any], dict[str, str]]:
    """What was typed as a document, without what was left blank, and what could not be read, by field.

    Whether a value is allowed is for the schema's own model to say: a number that is none stays text.
    """
    document: dict[str, Any] = {}
    errors: dict[str, str] = {}
    for field in fields:
        text = typed.get(field.name, "").strip()
        if not text:
            continue
        try:
            value = _value(field.kind, field.items, text, read_json)
        except ValueError as error:
            errors[field.name] = str(error)
            continue
        *outer, last = field.name.split(".")
        inside = document
        for step in outer:
            inside = inside.setdefault(step, {})
        inside[last] = value
    return document, errors


def field_of(steps: Sequence[int | str], names: Iterable[str]) -> str:
    """The field that a path into the document lies in; empty where it is none of these."""
    known = set(names)
    texts = [step for step in steps if isinstance(step, str)]
    return next((path for end in (2, 1) if (path := ".".join(texts[:end])) in known), "")


def _is_optional(schema: Mapping[str, Any]) -> bool:
    return "default" in schema and schema["default"] is None and "anyOf" in schema


def _field(path: str, name: str, schema: Mapping[str, Any], default: Any) -> Field:
    kind, items = _kind(schema)
    options = tuple(map(str, schema.get("enum", ()))) or (("true", "false") if kind == "boolean" else ())
    blank = "" if default is None else str(default)
    if options:
        blank = f"default: {default}" if default is not None else "default"
    return Field(
        path,
        name.replace("_", " "),
        kind,
        _hint(kind, schema),
        blank,
        options,
        items,
        kind == "json" or _has_object(schema),
    )


def _has_object(schema: Mapping[str, Any]) -> bool:
    choices = schema.get("items", schema).get("oneOf", ())
    return any("$ref" in choice for choice in choices)


def _kind(schema: Mapping[str, Any]) -> tuple[Kind, Kind]:
    named = str(schema.get("type", ""))
    if named == "array" and "prefixItems" not in schema:
        items = schema.get("items", {})
        return "list", _SCALARS.get(items.get("type", ""), "text")
    if named == "array":
        parts = {str(part.get("type")) for part in schema["prefixItems"]}
        return ("list", _SCALARS[parts.pop()]) if len(parts) == 1 and parts <= _SCALARS.keys() else ("json", "text")
    if named in _SCALARS:
        return _SCALARS[named], "text"
    choices = {part.get("type") for part in schema.get("oneOf", ())}
    return ("text" if "string" in choices else "json"), "text"


def _hint(kind: Kind, schema: Mapping[str, Any]) -> str:
    if kind == "list":
        inner = schema.get("items") or schema["prefixItems"][0]
        told = f"{_range(inner)}".strip() or ", ".join(map(str, inner.get("enum", ())))
        count = f"{schema['maxItems']} values, " if "prefixItems" in schema else ""
        return f"{count}separated by commas" + (f"; {told}" if told else "")
    if kind == "json":
        return "as JSON"
    return _range(schema)


def _range(schema: Mapping[str, Any]) -> str:
    low = schema.get("minimum", schema.get("exclusiveMinimum"))
    high = schema.get("maximum", schema.get("exclusiveMaximum"))
    whole = "whole number" if schema.get("type") == "integer" else ""
    if low is None and high is None:
        return whole
    # What a number may be at all is no bound to tell of.
    ends = [end for end in (low, high) if end is not None and abs(end) < _UNBOUNDED]
    told = " to ".join(f"{end:g}" for end in ends) if len(ends) != 1 else f"from {ends[0]:g}"
    return f"{whole} {told}".strip()


def _value(kind: Kind, items: Kind, text: str, read_json: Callable[[str], Any]) -> Any:
    if kind == "json" or text.startswith(("{", "[")):
        value = read_json(text)
        return [value] if kind == "list" and isinstance(value, dict) else value
    if kind == "list":
        return [_scalar(items, part.strip()) for part in text.split(",") if part.strip()]
    return _scalar(kind, text)


def _scalar(kind: Kind, text: str) -> Any:
    if text.startswith("{"):
        return text
    if kind == "boolean":
        return {"true": True, "false": False}.get(text, text)
    if kind in ("integer", "number"):
        for make in (int, float):
            try:
                return make(text)
            except ValueError:
                continue
    return text
