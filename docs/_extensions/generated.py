"""What a page takes from the code when the site is built.

A comment ``<!-- generated: api -->`` becomes the operations and objects of the OpenAPI document, ``<!-- generated: cli
-->`` the commands and their options, ``<!-- generated: engine -->`` and ``<!-- generated: client -->`` what is exported
there. Links to Markdown outside ``docs`` lead to copies of those files in the site.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parent.parent
ROOT = DOCS.parent
OUTSIDE = "_outside"
"""Folder of the copies, beside the pages; made anew at each build."""
COPIED = ("CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md", "benchmarks/LEDGER.md", "deploy/**/*.md")
FIRST = (
    "engine.experiment",
    "engine.measure",
    "engine.reconstruction",
    "engine.comparison",
    "engine.result",
    "engine.grid",
)
"""What most look for."""
_MARK = re.compile(r"^<!-- generated: (\w+) -->$", re.MULTILINE)
_LINK = re.compile(r"(?<=\]\()([^)#\s:]+)(#[^)\s]*)?(?=\))")


def cli_markdown() -> str:
    """Every command with its arguments and options."""
    import typer.main  # noqa: PLC0415 - the tests use the other halves of this module alone

    from service.cli.app import app  # noqa: PLC0415 - as above

    return "\n".join(_commands("hostlens", typer.main.get_command(app)))


def _commands(name: str, command: Any) -> Iterator[str]:
    for below, found in getattr(command, "commands", {}).items():
        if getattr(found, "commands", None):
            yield from _commands(f"{name} {below}", found)
        else:
            yield f"## {name} {below}\n\n{found.help}\n"
            yield from _parameters(found)


def _parameters(command: Any) -> Iterator[str]:
    shown = [found for found in command.params if not getattr(found, "hidden", False) and found.name != "help"]
    if shown:
        yield "| | | |\n|---|---|---|"
    for found in shown:
        names = ", ".join(f"`{name}`" for name in (*found.opts, *found.secondary_opts))
        if not found.opts[0].startswith("-"):
            names = f"`{found.name.upper()}`"
        remarks = ["required"] if found.required else []
        remarks += ["may be repeated"] if found.multiple and found.opts[0].startswith("-") else []
        if found.default not in (None, False, ()) and not getattr(found, "is_flag", False):
            remarks.append(f"default `{found.default}`")
        remarks += [f"or `{found.envvar}`"] if found.envvar else []
        yield f"| {names} | {(getattr(found, 'help', None) or '').replace('``', '`')} | {', '.join(remarks)} |"
    yield ""


def api_markdown(document: dict[str, Any]) -> str:
    """Every operation of an OpenAPI document, and every object that it takes or gives."""
    out = ["## Operations\n"]
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            out.append(f"### {method.upper()} {path}\n\n{operation.get('description', '')}\n")
            out += _operation(operation)
    out.append("## Objects\n")
    for name, schema in sorted(document["components"]["schemas"].items()):
        out.append(f"### {name}\n\n{_said(schema)}\n")
        out += _fields(schema)
    return "\n".join(out)


def _operation(operation: dict[str, Any]) -> Iterator[str]:
    rows = [
        (f"`{found['name']}`", found["in"], _type(found["schema"]), found.get("description") or _said(found["schema"]))
        for found in operation.get("parameters", [])
    ]
    for media, body in operation.get("requestBody", {}).get("content", {}).items():
        rows.append(("body", f"`{media}`", _type(body["schema"]), ""))
    if rows:
        yield "| parameter | in | | |\n|---|---|---|---|"
        yield from (f"| {' | '.join(map(_cell, row))} |" for row in rows)
        yield ""
    yield "| answer | | |\n|---|---|---|"
    for status, answer in operation["responses"].items():
        kinds = ", ".join(_type(body.get("schema", {})) for body in answer.get("content", {}).values())
        yield f"| {status} | {_cell(kinds)} | {_cell(answer['description'])} |"
    yield ""


def _fields(schema: dict[str, Any]) -> Iterator[str]:
    if "enum" in schema:
        yield _type(schema) + "\n"
    if not schema.get("properties"):
        return
    required = schema.get("required", [])
    yield "| field | | |\n|---|---|---|"
    for name, field in schema["properties"].items():
        must = "" if name in required or "default" not in field else f"default `{json.dumps(field['default'])}`. "
        yield f"| `{name}` | {_cell(_type(field))} | {_cell(must + _said(field))} |"
    yield ""


def _said(schema: dict[str, Any]) -> str:
    return str(schema.get("description", "")).replace("``", "`")


def _cell(text: str) -> str:
    return text.replace("\n", " ").replace("|", "\\|")


def _type(schema: dict[str, Any]) -> str:
    """A schema in a few words."""
    if "$ref" in schema:
        name = schema["$ref"].rsplit("/", 1)[1]
        return f"[{name}](#{name.lower()})"
    if "enum" in schema or "const" in schema:
        return ", ".join(f"`{value}`" for value in schema.get("enum", [schema.get("const")]))
    choices = schema.get("anyOf") or schema.get("oneOf") or schema.get("allOf")
    if choices:
        return " or ".join(map(_type, choices))
    return _plain_type(schema)


def _plain_type(schema: dict[str, Any]) -> str:
    kind, others = schema.get("type", "anything"), schema.get("additionalProperties")
    if "prefixItems" in schema:
        return f"[{', '.join(map(_type, schema['prefixItems']))}]"
    if kind == "array":
        return f"list of {_type(schema.get('items', {}))}"
    if kind == "object" and isinstance(others, dict):
        return f"table of {_type(others)}"
    return f"{kind}{_bounds(schema)}"


def _bounds(schema: dict[str, Any]) -> str:
    signs = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}
    found = [f"{sign} {schema[name]:g}" for name, sign in signs.items() if name in schema]
    found += [schema["format"]] if "format" in schema else []
    return f" ({', '.join(found)})" if found else ""


def engine_markdown() -> str:
    """Everything that ``engine`` and ``engine.figures`` export, by package; the types of single fields are left out."""
    rooms: dict[str, list[tuple[str, str]]] = {}
    for module in ("engine", "engine.figures"):
        exported = importlib.import_module(module)
        for name in exported.__all__:
            found = getattr(exported, name)
            if inspect.isclass(found) or inspect.isfunction(found):
                room = ".".join(found.__module__.split(".")[:2])
                rooms.setdefault(room, []).append((module, name))
    first = [room for room in FIRST if room in rooms]
    out = []
    for room in (*first, *sorted(rooms.keys() - set(first))):
        out.append(f"## {room}\n\n{_first_paragraph(importlib.import_module(room))}\n")
        # Functions before classes: these are what functions take and give.
        for module, name in sorted(rooms[room], key=lambda item: (item[1][0].isupper(), item[1])):
            out.append(_documented(module, name, "###"))
    return "\n".join(out)


def client_markdown() -> str:
    """The client and its errors."""
    return "\n".join(_documented("service.client", name) for name in ("Client", "ClientError", "ApiError"))


def _first_paragraph(found: Any) -> str:
    return re.sub(r":\w+:`~?\.*([^`<]*?)`", r"`\1`", inspect.getdoc(found).split("\n\n")[0]).replace("``", "`")


def _documented(module: str, name: str, level: str = "##") -> str:
    found = getattr(importlib.import_module(module), name)
    kind = "function" if inspect.isfunction(found) else "exception" if issubclass(found, Exception) else "class"
    out = f"{level} {name}\n\n```{{eval-rst}}\n.. auto{kind}:: {module}.{name}\n```\n"
    if dataclasses.is_dataclass(found):
        out += "\n| field | type | default |\n|---|---|---|\n"
        hints = inspect.get_annotations(found)
        for field in dataclasses.fields(found):
            # Pydantic keeps what it is told of a field in the place of its default.
            factory = getattr(field.default, "default_factory", field.default_factory)
            default = "" if field.default is dataclasses.MISSING else f"`{field.default!r}`"
            if callable(factory):
                default = f"`{factory.__name__}()`"
            out += f"| `{field.name}` | {_cell(str(hints.get(field.name, '')))} | {_cell(default)} |\n"
    return out


def _api() -> str:
    return api_markdown(json.loads((DOCS / "reference" / "openapi.json").read_text()))


GENERATED: dict[str, Callable[[], str]] = {
    "api": _api,
    "cli": cli_markdown,
    "client": client_markdown,
    "engine": engine_markdown,
}


def outside_pages() -> list[Path]:
    """Markdown outside ``docs`` that the site has too, from the root."""
    return sorted(path.relative_to(ROOT) for pattern in COPIED for path in ROOT.glob(pattern))


def relinked(text: str, page: Path) -> str:
    """Links of a page (its place from the root) as the site has them: from the top, files outside at their copies."""
    outside = set(outside_pages())

    def link(matched: re.Match[str]) -> str:
        target = Path(os.path.normpath(page.parent / matched[1]))
        if target in outside:
            return f"/{OUTSIDE}/{target.as_posix()}{matched[2] or ''}"
        if target.is_relative_to("docs") and page.parts[0] != "docs":
            return f"/{target.relative_to('docs').as_posix()}{matched[2] or ''}"
        if not target.is_relative_to("docs"):
            return f"{os.path.relpath(ROOT / target, DOCS / OUTSIDE / page.parent)}{matched[2] or ''}"
        return matched[0]

    return _LINK.sub(link, text)


def _copy(_: Any) -> None:
    shutil.rmtree(DOCS / OUTSIDE, ignore_errors=True)
    for page in outside_pages():
        copy = DOCS / OUTSIDE / page
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_text(relinked((ROOT / page).read_text(), page))


def _read(_: Any, name: str, source: list[str]) -> None:
    if not name.startswith(OUTSIDE):
        source[0] = relinked(source[0], Path("docs") / f"{name}.md")
    source[0] = _MARK.sub(lambda matched: GENERATED[matched[1]](), source[0])


def _outdated(_: Any, env: Any, *__: Any) -> list[str]:
    """Pages whose text is the code's: no change of their own file tells that they are old."""
    return [name for name in env.found_docs if _MARK.search(Path(env.doc2path(name)).read_text())]


def _signature(_: Any, kind: str, __: str, found: Any, ___: Any, signature: str, returns: str) -> Any:
    """Fields of a dataclass are told by a table, whose types are those of the source."""
    return ("", None) if kind == "class" and dataclasses.is_dataclass(found) else (signature, returns)


def setup(app: Any) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("builder-inited", _copy)
    app.connect("source-read", _read)
    app.connect("env-get-outdated", _outdated)
    app.connect("autodoc-process-signature", _signature)
    return {"parallel_read_safe": True}
