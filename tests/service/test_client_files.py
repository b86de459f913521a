"""What the client fetches as files: figures of a grid, arrays and the record of a run, of one real run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from engine import Analysis, Host, Realization, run
from service.cli.app import app
from service.client import ApiError
from tests.service.service_process import serving

BODY = {
    "systems": ["HE0435"], "n": [2], "r_eff": [0.39], "magnitude": [20.5], "l_eta": [1.0],
    "analysis": {"estimators": ["image"]},
}  # fmt: skip


@pytest.mark.timeout(1800)
def test_files_of_a_grid_and_a_run_are_fetched_whole(tmp_path: Path) -> None:
    with serving(tmp_path, HOSTLENS_TASK="service.worker:execute") as service:
        client = service.client
        grid = client.submit(BODY)
        with pytest.raises(ApiError):
            client.figure(grid.id)  # no result yet
        assert client.wait(grid.id, timeout_s=1200).counts.done == 1
        (found,) = client.runs(grid.id)
        assert b"<svg" in client.figure(grid.id, "bias")[:2000]
        assert client.figure(None, "bias", system="HE0435") == client.figure(None, "bias", system=["HE0435"])
        address = {"HOSTLENS_URL": client.url}
        saved = CliRunner().invoke(
            app, ["figures", grid.id, "-o", str(tmp_path / "new"), "--format", "png"], env=address
        )
        assert saved.exit_code == 0, saved.output
        names = {"bias_HE0435", "sample", "coverage", "pull", "trends", "montage"}
        assert {path.stem for path in (tmp_path / "new").glob("*.png")} == names
        assert client.figure(grid.id, "sample", "png").startswith(b"\x89PNG")
        with pytest.raises(ApiError):
            client.figure(grid.id, "../runs")
        arrays = client.products(found.id)
        record = client.record(found.id)
    realization = Realization(
        system="HE0435", l_eta=1.0, host=Host(n=2, r_eff=0.39, magnitude=20.5), analysis=Analysis(estimators=("image",))
    )
    direct = run(realization)
    assert record["realization_digest"] == realization.digest
    expected = direct.products.arrays()
    assert arrays.keys() >= {"image", "model", "residual"}
    assert all((arrays[name] == expected[name]).all() for name in ("image", "model", "mask"))
    file = tmp_path / "record.json"
    file.write_text(json.dumps(record))
    replayed = CliRunner().invoke(app, ["replay", str(file)])
    assert replayed.exit_code == 0, replayed.output
