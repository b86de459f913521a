"""``hostlens study``: one command, one grid, one file, by a service of its own or by one that is named."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from typer.testing import CliRunner, Result

from engine import read_study
from service.cli.app import app
from tests.service.service_process import ROOT, Serving, eventually, serving

PRESET = "h0licow-vi/HE0435"
TASK = {"HOSTLENS_TASK": "service.worker.synthetic:brief", "HOSTLENS_API_PROCESSES": "1"}


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Serving]:
    with serving(tmp_path_factory.mktemp("study"), **TASK, HOSTLENS_DRILL_SLEEP="0") as running:
        yield running


def called(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["study", *arguments])


def test_the_papers_runs_are_computed_once_and_written_as_they_are_stored(service: Serving, tmp_path: Path) -> None:
    url = ("--url", service.client.url)
    done = called(PRESET, *url, "--seeds", "2", "--profile", "draft", "-o", str(tmp_path))
    assert done.exit_code == 0, done.output
    assert {f"{stem}_{who}.svg" for stem in ("bias_HE0435", "sample") for who in ("paper", "image")} < {
        path.name for path in tmp_path.iterdir()
    }
    found = read_study(tmp_path / "study.parquet")
    (grid_id,) = found.provenance["grids"]
    assert (found.provenance["profiles"], found.provenance["seeds"]) == (["draft"], [0, 1])
    assert (found.provenance["runs"], found.provenance["runs_asked"]) == (96, 96)
    assert found.table.num_rows == 96 * 12
    rows = {row["run_id"]: row for row in service.client.results(grid_id, estimator="paper", index_prior="free")}
    points = found.points("paper", "free")
    assert len(points) == len(rows) == 96
    for point in points:
        row = rows[point.run_id]
        for quantity in ("magnitude", "r_eff", "n"):
            # Single precision.
            assert point.bias(quantity) == pytest.approx(row[f"{quantity}_bias"], rel=1e-6, abs=1e-6)  # type: ignore[arg-type]
            assert point.sd(quantity) == pytest.approx(row[f"{quantity}_sd"], rel=1e-6)  # type: ignore[arg-type]
        assert (point.n, point.r_eff, point.magnitude, point.seed) == tuple(
            row[name] for name in ("n", "r_eff", "magnitude", "seed")
        )

    again = called(PRESET, *url, "--profile", "draft", "-o", str(tmp_path / "again"), "--seeds", "2")
    assert f"grid {grid_id}: 96 runs, 96 stored" in again.stdout
    assert read_study(tmp_path / "again" / "study.parquet").table.equals(found.table)
    figure = "bias_HE0435_image.svg"
    assert (tmp_path / "again" / figure).read_bytes() == (tmp_path / figure).read_bytes()


def test_a_study_that_lacks_runs_names_them_and_says_so(service: Serving, tmp_path: Path) -> None:
    client = service.client
    client.submit({"preset": PRESET, "n": [2], "replicates": 30, "seed": 50})
    waiting = client.submit({"preset": PRESET, "n": [4], "l_eta": [1.0], "seed": 90})
    client.cancel(waiting.id)
    stored = client.submit({"preset": PRESET, "n": [4], "l_eta": [0.8], "magnitude": [20.5]})
    client.wait(stored.id)
    grids = ("--grid", waiting.id, "--grid", stored.id)
    done = called(PRESET, "--url", client.url, *grids, "-o", str(tmp_path))
    lacking = client.status(waiting.id).counts.cancelled
    assert lacking
    assert done.exit_code == 1
    assert f"runs without a result: {lacking}" in done.stderr
    said = read_study(tmp_path / "study.parquet").provenance["without_result"]
    assert [run["state"] for run in said] == ["cancelled"] * lacking
    assert called(PRESET, "--url", client.url, "--grid", waiting.id, "-o", str(tmp_path / "none")).exit_code == 1


def test_what_is_interrupted_goes_on_and_leaves_nobody(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "service", "study", PRESET, "--seeds", "8", "--local"]
    command += ["--data-dir", str(tmp_path / "data"), "-o", str(tmp_path / "out")]
    log, environment = tmp_path / "log", {**os.environ, **TASK, "HOSTLENS_URL": "http://127.0.0.1:1"}

    def started() -> subprocess.Popen[bytes]:
        with log.open("wb") as told:
            return subprocess.Popen(command, cwd=ROOT, env=environment, stdout=told, stderr=told)

    def stored() -> int:
        lines = [line for line in log.read_text().splitlines() if "/384 stored" in line]
        return int(lines[-1].partition("/384")[0].rpartition(" ")[2]) if lines else 0

    before = 0
    for _ in range(2):
        process = started()
        eventually(lambda: process.poll() is not None or stored() > before, what="a further run")  # noqa: B023 - of now
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60) == 128 + signal.SIGINT, log.read_text()
        eventually(lambda: not _at(tmp_path / "data"), what="the end of all")
        assert stored() > before
        before = stored()
    assert not (tmp_path / "out" / "study.parquet").exists()


def _at(folder: Path) -> list[int]:
    found = []
    for process in psutil.process_iter():
        try:
            if process.environ().get("HOSTLENS_DATA_DIR", "").startswith(str(folder)):
                found.append(process.pid)
        except psutil.Error:
            continue
    return found


def test_a_file_that_is_no_study_is_refused_before_anything_is_done(tmp_path: Path) -> None:
    other = tmp_path / "other.parquet"
    other.write_bytes(b"PAR1")
    for wrong, told in (
        (("--from", str(other)), "is no Parquet file"),
        (("--from", str(tmp_path / "missing")), "cannot be read"),
        (("--from", "shipped", "--grid", "g_06h05zns0sxqesvz1qxk4a1s56"), "allowed is one of them"),
    ):
        done = called(PRESET, *wrong, "-o", str(tmp_path / "out"))
        assert (done.exit_code, done.stdout) == (2, "")
        assert told in done.stderr
