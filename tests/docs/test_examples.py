"""What the documentation shows is run: blocks marked ``run`` against a real service, answers compared.

A person who has never seen it gets from the README to a figure of the biases of a lens of their own: by the command
line, by curl and in Python, each as it is written there, with the real engine.
"""

from __future__ import annotations

import doctest
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from astropy import units
from astropy.table import QTable

from engine import Analysis, Grid, expand, read_system, run
from tests.docs.pages import PAGES, ROOT, Block, blocks
from tests.service.service_process import Serving, serving

SHORTER = {
    '"profile": "draft"': '"source_pixels": [12, 12], "max_steps": 10, "draws": 4',
    'Analysis(profile="draft")': "Analysis(source_pixels=(12, 12), max_steps=10, draws=4)",
    "--profile draft": "--no-inversion --agn-images 4 --no-shear",
    '"magnitude": [20.5, 21.5]': '"magnitude": [20.5]',
    '"n_runs":4': '"n_runs":2',
}
"""Chains that are too short for any number, and half of the runs: as good for whether the commands work.

What an image that is measured blindly tells is asserted in tests/engine/test_measurement.py.
"""
MADE = {
    "docs/tutorial/first-grid.md": ["grid.json", "summary.json", "run.png", "biases.png"],
    "docs/howto/ask-for-biases.md": ["by_n.json", "trend.json", "comparison.json", "results.json", "results.ecsv"],
    "docs/howto/predict.md": ["more.json", "cost.txt", "prediction.json"],
    "docs/howto/ask-for-an-error.md": ["frontier.json", "grid.txt", "known.json"],
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
    with serving(folder, HOSTLENS_TASK="service.worker:execute", HOSTLENS_WORKERS="1") as found:
        yield found


@pytest.mark.timeout(2 * _TIMEOUT_S)
def test_the_pages_that_need_a_service_do_what_they_show(service: Serving, tmp_path: Path) -> None:
    # In one test: what one page shows of the newest grid is of the grid that the page before has made.
    url = f"http://127.0.0.1:{service.port}"
    # A page that submits a grid of one estimator comes last: others show two.
    order = {"first-grid": 0, "ask-for-an-error": 2}
    for page in sorted(pages_that_run("service"), key=lambda page: order.get(page.stem, 1)):
        run_page(page, tmp_path, {"localhost:8421": url.removeprefix("http://")}, url)


@pytest.mark.parametrize("page", pages_that_run("engine"), ids=lambda page: page.stem)
def test_the_pages_that_need_the_engine_do_what_they_show(page: Path, tmp_path: Path) -> None:
    run_page(page, tmp_path, {})


README, OWN_LENS = ROOT / "README.md", ROOT / "docs" / "howto" / "own-lens.md"
FIELD = "field_pixels = 90", "field_pixels = 64"


def shown(page: Path, language: str, part: str) -> str:
    """The one block of a page that has a text in it, with one host instead of two."""
    (found,) = [block.text for block in blocks(page) if block.language == language and part in block.text]
    return found.replace("--n 2 --n 4", "--n 2").replace("[2, 4]", "[2]")


def follow(service: Serving, folder: Path, text: str, language: str = "sh") -> str:
    """What somebody sees who types it, in a checkout with hostlens on the path."""
    own = f"127.0.0.1:{service.port}"
    interpreter = ["/bin/bash", "-euo", "pipefail", "-c"] if language == "sh" else [sys.executable, "-c"]
    environment = os.environ | {
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        "MPLBACKEND": "agg",
        "HOSTLENS_URL": f"http://{own}",
        "COLUMNS": "80",
    }
    text = text.replace("localhost:8421", own)
    done = subprocess.run(
        [*interpreter, text],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=_TIMEOUT_S,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.timeout(4 * _TIMEOUT_S)
def test_three_ways_from_a_file_to_the_biases_of_a_lens_give_the_same(service: Serving, tmp_path: Path) -> None:
    toml = tmp_path / "docs" / "examples" / "my_system.toml"
    toml.parent.mkdir(parents=True)
    written = (ROOT / "docs" / "examples" / "my_system.toml").read_text()
    assert FIELD[0] in written
    toml.write_text(written.replace(*FIELD))
    told = follow(service, tmp_path, shown(README, "sh", "--system docs/examples/my_system.toml"))
    follow(service, tmp_path, shown(OWN_LENS, "sh", "curl"))
    follow(service, tmp_path, shown(OWN_LENS, "python", "savefig"), "python")
    ours, by_curl, by_command = service.client.grids().items[:3]
    by_command_rows = service.client.summary(by_command.id, group_by="n").rows
    assert by_command.name == "my own lens"
    assert "<svg" in (tmp_path / "my_biases.svg").read_text()[:2000]
    assert (tmp_path / "my_biases.png").read_bytes().startswith(b"\x89PNG")
    # What the engine says of the same host, to the last digit that is told.
    values = {"n": (2.0,), "r_eff": (0.35,), "magnitude": (21.0,), "l_eta": (1.0,)}
    (one,) = expand(Grid(systems=(read_system(str(toml)),), **values, analysis=Analysis(estimators=("image",))))
    expected = run(one.realization).estimate("image", "wide").magnitude
    assert expected.bias is not None
    table = QTable.read(tmp_path / "my_biases.ecsv")
    assert table["magnitude_bias"].unit == units.mag
    assert list(table["magnitude_mean"].value) == [expected.mean]
    assert list(table["magnitude_bias"].value) == [expected.bias]
    six = [float(f"{expected.bias:.6g}")]
    answer = json.loads((tmp_path / "by_curl.json").read_text())
    assert answer["question"]["filter"] == {"grid": [by_curl.id]}
    assert [row["bias"]["mean"] for row in answer["rows"]] == six
    assert [row.bias.mean for row in by_command_rows if row.bias is not None] == six
    assert f"{six[0]:+.3f}" in told
    assert ours.n_runs == by_curl.n_runs == by_command.n_runs == 1
