"""Whatever the documentation names is there: commands and options, settings, files, modules, addresses, links."""

from __future__ import annotations

import importlib
import json
import re
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import typer.main

from service.cli.app import app
from service.runtime.settings import DEPLOYMENT, OTHERS, Settings
from tests.docs.pages import PAGES, ROOT, STANDING, anchors, blocks, commands, inline_code, links

_IMPORT = re.compile(r"^from ((?:engine|service)[\w.]*) import ([\w, ]+)$", re.MULTILINE)
by_page = pytest.mark.parametrize("page", STANDING, ids=lambda page: str(page.relative_to(ROOT)))


def _command(words: list[str]) -> tuple[Any, list[str]]:
    """The command of the command line that the words name, and the words after it."""
    command: Any = typer.main.get_command(app)
    while words and words[0] in getattr(command, "commands", {}):
        command, words = command.commands[words[0]], words[1:]
    return command, words


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_no_merge_has_left_its_marks(page: Path) -> None:
    assert not re.search(r"^(<{7}|={7}$|>{7})", page.read_text(), re.MULTILINE)


@by_page
def test_every_command_exists_with_its_options(page: Path) -> None:
    for words in commands(page):
        program = Path(words[0]).name
        # What it prints begins with its name too; and COMMAND stands for any.
        if program != "hostlens" or len(words) == 1 or words[1].isupper() or words[1] == "serves":
            continue
        command, rest = _command(words[1:])
        assert not getattr(command, "commands", None) or rest[:1] in (["--help"], ["--version"]), f"no command {words}"
        known = {name for found in command.params for name in (*found.opts, *found.secondary_opts)} | {"--help"}
        given = {word.partition("=")[0] for word in rest if word.startswith("--")}
        assert given <= known, f"{' '.join(words)}: no option {sorted(given - known)}"


@by_page
def test_every_module_that_is_run_exists(page: Path) -> None:
    for words in commands(page):
        if re.fullmatch(r"python[0-9.]*", Path(words[0]).name) and words[1:2] == ["-m"] and len(words) > 2:
            assert find_spec(words[2]) is not None, " ".join(words)


@by_page
def test_every_target_of_make_exists(page: Path) -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    text = "\n".join((*inline_code(page), *(block.text for block in blocks(page) if block.language == "sh")))
    assert set(re.findall(r"^(?:\$ )?make ([a-z-]+)", text, re.MULTILINE)) <= targets


@by_page
def test_every_setting_exists(page: Path) -> None:
    known = {f"HOSTLENS_{name.upper()}" for name in Settings.model_fields} | OTHERS | DEPLOYMENT
    named = set(re.findall(r"\bHOSTLENS_[A-Z_]*[A-Z]\b(?!\*)", page.read_text()))
    # `HOSTLENS_TLS_*` names several.
    several = {name for name in named if f"{name}_*" in page.read_text()}
    assert all(any(setting.startswith(name) for setting in known) for name in several)
    assert named - several <= known, sorted(named - several - known)


@by_page
def test_every_file_exists(page: Path) -> None:
    for name in inline_code(page):
        if re.fullmatch(r"(engine|service|tests|benchmarks|docs|deploy|migrations)/[\w./*-]+", name):
            assert list(ROOT.glob(name.rstrip("/"))), f"{name} is not there"


@by_page
def test_every_object_exists(page: Path) -> None:
    for name in inline_code(page):
        if not re.fullmatch(r"(engine|service|tests|benchmarks)(\.\w+)+", name):
            continue
        _named(name)


def _named(name: str) -> Any:
    """A module or what is in one; the longest part of the name that is a module counts as one."""
    parts = name.split(".")
    for k in range(len(parts), 0, -1):
        try:
            found: Any = importlib.import_module(".".join(parts[:k]))
        except ModuleNotFoundError:
            continue
        for part in parts[k:]:
            found = getattr(found, part)
        return found
    raise ModuleNotFoundError(name)


@by_page
def test_every_address_exists(page: Path) -> None:
    paths = json.loads((ROOT / "docs" / "reference" / "openapi.json").read_text())["paths"]
    patterns = [re.compile(re.sub(r"\{\w+\}", "[^/]+", path)) for path in (*paths, "/openapi.json")]
    text = "\n".join((*inline_code(page), *(block.text for block in blocks(page))))
    for address in re.findall(r"(?<![\w}])/(?:v1/[\w{}/$.]+|healthz|readyz|metrics|openapi\.json)", text):
        plain = address.rstrip("/.")
        assert any(pattern.fullmatch(plain) for pattern in patterns), f"{address} is no address of the API"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_leads_somewhere(page: Path) -> None:
    for link in links(page):
        if re.match(r"[a-z]+:", link):
            continue
        file, _, anchor = link.partition("#")
        target = page if not file else (page.parent / file)
        assert target.exists(), f"{link}: no such file"
        if anchor:
            assert anchor in anchors(target), f"{link}: no such heading"


@by_page
def test_every_imported_name_exists(page: Path) -> None:
    for block in blocks(page):
        for module, names in re.findall(
            r"^from ((?:engine|service)[\w.]*) import ([\w, ]+)$", block.text, re.MULTILINE
        ):
            for name in names.split(","):
                assert hasattr(importlib.import_module(module), name.strip()), f"{block}: {module} has no {name}"


@by_page
def test_every_metric_exists(page: Path) -> None:
    sources = "\n".join(path.read_text() for path in ROOT.glob("service/**/*.py"))
    for name in re.findall(r"\bhostlens_[a-z_]+[a-z]\b", "\n".join(inline_code(page))):
        stem = re.sub(r"_(total|count|bucket|sum)$", "", name)
        assert stem in sources or f'"{stem.removeprefix("hostlens_")}"' in sources, f"{name} is counted nowhere"
