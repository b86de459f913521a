"""The Markdown of the project as the tests read it: blocks of code, inline code, links."""

from __future__ import annotations

import itertools
import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted(
    path
    for path in (*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("deploy/**/*.md"))
    if "_outside" not in path.parts
)
STANDING = [page for page in PAGES if page.name != "CHANGELOG.md"]
"""Those that tell how things are, and not how they became so."""
_BLOCK = re.compile(
    r"^(?:<!-- (?P<mark>run: \w+|answer) -->\n)?```(?P<language>[\w{}-]+)\n(?P<text>.*?)^```$", re.MULTILINE | re.DOTALL
)


@dataclass(frozen=True)
class Block:
    """A block of code: its page, its line, its language, and its mark: ``run: service``, ``answer`` and the like."""

    page: Path
    line: int
    language: str
    mark: str | None
    text: str

    def __str__(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"


def blocks(page: Path) -> list[Block]:
    """The blocks of code of a page, in its order."""
    text = page.read_text()
    return [
        Block(page, text.count("\n", 0, found.start("text")), found["language"], found["mark"], found["text"])
        for found in _BLOCK.finditer(text)
    ]


def prose(page: Path) -> str:
    """A page without its blocks of code."""
    return _BLOCK.sub("", page.read_text())


def inline_code(page: Path) -> set[str]:
    """What stands between backticks outside of blocks."""
    return {" ".join(found.split()) for found in re.findall(r"(?<!`)`([^`]+)`(?!`)", prose(page))}


def links(page: Path) -> set[str]:
    """Targets of the links and pictures outside of blocks."""
    return set(re.findall(r"\]\(([^)\s]+)\)", prose(page)))


def anchors(page: Path) -> set[str]:
    """Names that a page's headings can be linked by."""
    headings = re.findall(r"^#+ (.*)$", prose(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


def commands(page: Path) -> Iterator[list[str]]:
    """Words of every command of ``hostlens``, and every Python module that is run, in blocks and between backticks."""
    told = "\n".join(block.text for block in blocks(page) if block.language == "sh")
    lines = [line.removeprefix("$ ") for line in told.replace("\\\n", " ").splitlines()]
    for line in (*lines, *inline_code(page)):
        try:
            found = _split(line)
        except ValueError:  # no line of a shell: a quotation mark alone, say
            continue
        for words in found:
            command = list(itertools.dropwhile(lambda word: re.fullmatch(r"\w+=.*", word), words))
            if command:
                yield command


def _split(line: str) -> list[list[str]]:
    """The commands of a shell's line, each as its words."""
    lexer = shlex.shlex(line, posix=True, punctuation_chars="|;&()<>")
    lexer.whitespace_split = True
    out: list[list[str]] = [[]]
    for word in lexer:
        if set(word) <= set("|;&()<>"):
            out.append([])
        else:
            out[-1].append(word)
    return out
