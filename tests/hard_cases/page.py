"""The page of the hard cases, made of the docstrings of their tests: ``python -m tests.hard_cases.page``.

A docstring has a paragraph that says what the case is, and one of two sentences or more that begin with "Could go
wrong:" and "Holds:". Nothing is imported: the page is made of the source text.
"""

from __future__ import annotations

import ast
import sys
from dataclasses import dataclass
from pathlib import Path

from tests.sources import parsed

HERE = Path(__file__).parent
PAGE = HERE.parents[1] / "docs" / "reference" / "hard-cases.md"
ORDER = (
    "lenses", "light", "inversions", "components", "optics", "coincidences", "precision", "chains", "hosts", "size",
    "no_sentinels",
)  # fmt: skip
RISK, PROMISE = "Could go wrong:", "Holds:"
HEAD = """# Hard cases, test by test

<!-- Made by `python -m tests.hard_cases.page` of the docstrings in tests/hard_cases: change those, not this. -->

Where a simulation or an inversion of a lensed host is most likely to be wrong without saying so. Each row is a test in
`tests/hard_cases/`, and its last column is what the test asserts: a number, or an error of a certain type.
"""


@dataclass(frozen=True)
class HardCase:
    """A case: the sentence that its test's name is, what it is, what could go wrong, what holds, and a known fault."""

    sentence: str
    what: str
    risk: str
    promise: str
    fault: str | None


def _fault(test: ast.FunctionDef) -> str | None:
    """The reason of a test that is expected to fail."""
    for mark in test.decorator_list:
        if isinstance(mark, ast.Call) and ast.unparse(mark.func) == "pytest.mark.xfail":
            return str(next(ast.literal_eval(word.value) for word in mark.keywords if word.arg == "reason"))
    return None


def read_case(test: ast.FunctionDef) -> HardCase:
    """The case of a test; ValueError where its docstring lacks a part."""
    text = " ".join((ast.get_docstring(test) or "").split())
    if not 0 < text.find(RISK) < text.find(PROMISE):
        raise ValueError(f"{test.name}: its docstring says what it is, '{RISK} ...', '{PROMISE} ...'")
    what, rest = text.split(RISK, 1)
    risk, promise = rest.split(PROMISE, 1)
    sentence = test.name.removeprefix("test_").replace("_", " ")
    return HardCase(sentence, what.strip(), risk.strip(), promise.strip(), _fault(test))


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _row(case: HardCase) -> str:
    promise = _capital(case.promise)
    if case.fault is not None:
        promise = f"**Does not hold yet:** {case.fault}. Should: {case.promise}"
    cells = (f"**{_capital(case.sentence)}.** {case.what}", _capital(case.risk), promise)
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def make_page() -> str:
    """The whole page."""
    parts = [HEAD]
    for name in ORDER:
        tree = parsed(HERE / f"test_{name}.py")
        about = (ast.get_docstring(tree) or "").splitlines()[0]
        tests = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")]
        rows = [_row(read_case(test)) for test in tests]
        parts.append(
            "\n".join(
                [
                    f"## {about.rstrip('.')}",
                    "",
                    "| case | what could go wrong | what holds |",
                    "|---|---|---|",
                    *rows,
                    "",
                ]
            )
        )
    return "\n".join(parts)


if __name__ == "__main__":
    PAGE.write_text(make_page(), encoding="utf-8")
    sys.stdout.write(f"{PAGE}\n")
