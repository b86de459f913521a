"""What the documentation shows is run: blocks marked ``run`` against a real service, answers compared."""

from __future__ import annotations

import doctest
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.docs.pages import PAGES, ROOT, Block, blocks
from tests.service.service_process import Serving, serving

SHORTER = {
    '"profile": "draft"': '"source_pixels": [12, 12], "max_steps": 10, "draws": 4',
    'Analysis(profile="draft")': "Analysis(source_pixels=(12, 12), max_steps=10, draws=4)",
    "--profile draft": "--no-inversion",
    '"magnitude": [20.5, 21.5]': '"magnitude": [20.5]',
    '"n_runs":4': '"n_runs":2',
}
"""Chains that are too short for any number, and half of the runs: as good for whether the commands work."""
MADE = {
    "docs/tutorial/first-grid.md": ["grid.json", "summary.json", "run.png", "biases.png"],
    "docs/howto/ask-for-biases.md": ["by_n.json", "trend.json", "comparison.json", "results.json", "results.ecsv"],
    "docs/howto/from-python.md": ["bias.svg"],
    "docs/howto/results-to-files.md": ["results.vot", "results.fits", "run.npz", "run.fits", "chain.nc", "run.json"],
    "docs/howto/measure-by-http.md": ["found.json", "found.png"],
    "docs/howto/paper-figure.md": ["figure.pdf"],
    "docs/howto/measure-an-image.md": ["host.json", "host.png"],
}
"""Files that the examples of a page leave behind, beside their answers."""
ANSWERS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
_NUMBER = re.compile(r"(?<![\w.])-?\d+\.\d+(?![\w.])")
_TIMEOUT_S = 1500
"""Twenty times what it takes: a busy machine is slow and not wrong."""
CUT = "---- the next block ----"


def marked(page: Path) -> list[Block]:
    return [block for block in blocks(page) if block.mark is not None]


def pages_that_run(where: str) -> list[Path]:
    """Pages whose examples need a ``service``, or nothing but the ``engine``."""
    needs = {page: {block.mark for block in marked(page)} - {"answer"} for page in PAGES}
    if where == "engine":
        return [page for page, marks in needs.items() if marks == {"run: engine"}]
    return [page for page, marks in needs.items() if f"run: {where}" in marks]


def answers(told: str, output: str) -> bool:
    """Whether an output is what is told: the same words, dots for any, and the same numbers within a tenth or 0.01.

    Numbers are those of a short chain here, and change a little with the engine.
    """
    if not doctest.OutputChecker().check_output(_NUMBER.sub("#", told), _NUMBER.sub("#", output), ANSWERS):
        return False
    if "..." in told:
        return True
    pairs = zip(_NUMBER.findall(told), _NUMBER.findall(output), strict=True)
    return all(float(found) == pytest.approx(float(said), rel=0.1, abs=0.01) for said, found in pairs)


def run_page(page: Path, folder: Path, replaced: dict[str, str], url: str | None = None) -> None:
    """The marked blocks of a page in its order, as one script; each prints what it says it does."""
    (folder / ".venv").mkdir(exist_ok=True)
    if not (folder / ".venv" / "bin").exists():
        (folder / ".venv" / "bin").symlink_to(Path(sys.executable).parent)
        (folder / "docs").symlink_to(ROOT / "docs")
    script, expected = ["set -euo pipefail"], []
    for block in marked(page):
        text = block.text
        for old, new in (*SHORTER.items(), *replaced.items()):
            text = text.replace(old, new)
        if block.mark == "answer":
            expected[-1] = (block, text)
        else:
            script.append(f"python - <<'END_OF_PYTHON'\n{text}END_OF_PYTHON" if block.language == "python" else text)
            script.append(f"echo '{CUT}'")
            expected.append((block, None))
    bin_first = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = os.environ | {"PATH": bin_first, "MPLBACKEND": "agg", "PYTHONPATH": str(ROOT)}
    if url is not None:
        environment["HOSTLENS_URL"] = url
    told = subprocess.run(
        ["/bin/bash", "-c", "\n".join(script)],
        check=False,
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=_TIMEOUT_S,
    )
    outputs = told.stdout.split(f"{CUT}\n")
    assert told.returncode == 0, f"after {expected[len(outputs) - 1][0]}: {told.stderr or told.stdout}"
    for output, (block, answer) in zip(outputs, expected, strict=False):
        if answer is not None:
            assert answers(answer, output), f"{block} says\n{answer}\nand it is\n{output}"
    for name in MADE.get(str(page.relative_to(ROOT)), []):
        assert (folder / name).stat().st_size > 0


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Serving]:
    folder = tmp_path_factory.mktemp("service")
    with serving(folder, HOSTLENS_TASK="service.worker:execute") as found:
        yield found


@pytest.mark.timeout(2 * _TIMEOUT_S)
def test_the_pages_that_need_a_service_do_what_they_show(service: Serving, tmp_path: Path) -> None:
    # In one test: what one page shows of the newest grid is of the grid that the page before has made.
    url = f"http://127.0.0.1:{service.port}"
    for page in sorted(pages_that_run("service"), key=lambda page: page.parent.name != "tutorial"):
        run_page(page, tmp_path, {"localhost:8421": url.removeprefix("http://")}, url)


@pytest.mark.parametrize("page", pages_that_run("engine"), ids=lambda page: page.stem)
def test_the_pages_that_need_the_engine_do_what_they_show(page: Path, tmp_path: Path) -> None:
    run_page(page, tmp_path, {})
