"""What the client fetches as files: arrays and the record of a real run, which is replayed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from engine import Analysis, Host, Realization, run
from service.cli.app import app
from tests.service.service_process import serving

BODY = {
    "systems": ["HE0435"], "n": [2], "r_eff": [0.39], "magnitude": [20.5], "l_eta": [1.0],
    "analysis": {"estimators": ["image"]},
}  # fmt: skip


@pytest.mark.timeout(1800)
def test_arrays_and_record_of_a_run_are_fetched_whole(tmp_path: Path) -> None:
    with serving(tmp_path, HOSTLENS_TASK="service.worker:execute") as service:
        client = service.client
        grid = client.submit(BODY)
        assert client.wait(grid.id, timeout_s=1200).counts.done == 1
        (found,) = client.runs(grid.id)
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
