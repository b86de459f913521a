"""A person who has never seen it gets from the README to a figure of the biases of a lens of their own.

By the command line, by curl and in Python, each as it is written there, with the real engine.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from astropy import units
from astropy.table import QTable

from engine import Analysis, Grid, expand, read_system, run
from tests.docs.pages import ROOT, blocks
from tests.service.service_process import Serving, serving

_TIMEOUT_S = 600
"""Twenty times what a way takes on a machine that has nothing else to do."""
README, OWN_LENS = ROOT / "README.md", ROOT / "docs" / "howto" / "own-lens.md"


def shown(page: Path, language: str, part: str) -> str:
    """The one block of a page that has a text in it."""
    (found,) = [block.text for block in blocks(page) if block.language == language and part in block.text]
    return found


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
def test_three_ways_from_a_file_to_the_biases_of_a_lens_give_the_same(tmp_path: Path) -> None:
    (tmp_path / "docs").symlink_to(ROOT / "docs")
    with serving(tmp_path, HOSTLENS_TASK="service.worker:execute") as service:
        told = follow(service, tmp_path, shown(README, "sh", "--system docs/examples/my_system.toml"))
        follow(service, tmp_path, shown(OWN_LENS, "sh", "curl"))
        follow(service, tmp_path, shown(OWN_LENS, "python", "savefig"), "python")
        ours, by_curl, by_command = service.client.grids().items
        by_command_rows = service.client.summary(by_command.id, group_by="n").rows
    assert by_command.name == "my own lens"
    assert "<svg" in (tmp_path / "my_biases.svg").read_text()[:2000]
    assert (tmp_path / "my_biases.png").read_bytes().startswith(b"\x89PNG")
    # What the engine says of the same hosts, to the last digit that is told.
    system = read_system(str(ROOT / "docs/examples/my_system.toml"))
    values = {"n": (2.0, 4.0), "r_eff": (0.35,), "magnitude": (21.0,), "l_eta": (1.0,)}
    runs = expand(Grid(systems=(system,), **values, analysis=Analysis(estimators=("image",))))
    expected = [run(one.realization).estimate("image", "wide").magnitude for one in runs]
    table = QTable.read(tmp_path / "my_biases.ecsv")
    assert table["magnitude_bias"].unit == units.mag
    assert list(table["magnitude_mean"].value) == [found.mean for found in expected]
    assert list(table["magnitude_bias"].value) == [found.bias for found in expected]
    six = [float(f"{found.bias:.6g}") for found in expected]
    answer = json.loads((tmp_path / "by_curl.json").read_text())
    assert answer["question"]["filter"] == {"grid": [by_curl.id]}
    assert [row["bias"]["mean"] for row in answer["rows"]] == six
    assert [row.bias.mean for row in by_command_rows if row.bias is not None] == six
    for bias in six:
        assert f"{bias:+.3f}" in told
    assert ours.n_runs == by_curl.n_runs == by_command.n_runs == 2
