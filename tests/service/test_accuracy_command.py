"""``hostlens accuracy``: what it prints, and the files that it writes."""

from __future__ import annotations

import json
from pathlib import Path

from typer.testing import CliRunner

from engine import report_from_dict
from service.cli.app import app


def test_accuracy_measures_a_stage_and_writes_table_json_and_figure(tmp_path: Path) -> None:
    table, data, picture = tmp_path / "a.md", tmp_path / "a.json", tmp_path / "a.png"
    options = ["--markdown", str(table), "--json", str(data), "--figure", str(picture)]
    done = CliRunner().invoke(app, ["accuracy", "HE0435", "rendering", *options])
    assert done.exit_code == 0, done.output
    assert "1e-04 (default)" in done.stdout
    assert picture.read_bytes().startswith(b"\x89PNG")
    report = report_from_dict(json.loads(data.read_text()))
    (curve,) = report.curves
    assert curve.default_on_front
    # What docs/explanation/accuracy.md says: without adaptive cells no number of even rays comes near, nor does a peer.
    even = [point for point in curve.points if point.setting.startswith("even rays")]
    peers = [point for point in curve.points if point.peer == "lenstronomy"]
    assert even
    assert peers
    assert min(point.error for point in (*even, *peers)) > 50 * curve.default.error
    # 6e-4 of the noise is the largest of the eight systems.
    assert curve.default.error < 1e-3
    shown = table.read_text()
    assert f"| **{curve.default.setting}** | 1 |" in shown
    assert "The default is on the front." in shown


def test_accuracy_says_where_its_default_is_off_the_front(tmp_path: Path) -> None:
    data = tmp_path / "a.json"
    done = CliRunner().invoke(app, ["accuracy", "HE0435", "drizzle", "--json", str(data)])
    assert done.exit_code == 0, done.output
    for curve in report_from_dict(json.loads(data.read_text())).curves:
        assert curve.default_on_front or curve.knob.why_off_front in " ".join(done.stdout.split())
