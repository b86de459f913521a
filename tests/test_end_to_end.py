"""The main job with the real engine: a grid in by REST, biases and files out, through a kill."""

import dataclasses
import os
import signal
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from engine import Analysis, Grid, expand, run
from service.cli.app import app
from service.client import ApiError
from service.domain.payload import result_payload
from tests.drills.stored import read_records
from tests.service.service_process import eventually, serving

ASKED = {"source_pixels": (12, 12), "subrays": 1, "psf_radius": 8, "max_steps": 10, "draws": 4}
VALUES = {"n": (2.0, 4.0), "magnitude": (20.5,), "l_eta": (1.0,), "r_eff": (0.39,)}


@pytest.mark.timeout(1800)
def test_a_grid_of_the_paper_survives_a_kill_and_all_that_is_found_is_the_engines(tmp_path: Path) -> None:
    """To the last bit, in another process than ours: numbers, arrays and record; figures come whole."""
    url = f"sqlite:///{tmp_path / 'real.sqlite'}"
    request = {"preset": "h0licow-vi/HE0435", **{name: list(values) for name, values in VALUES.items()}}
    task = "service.worker:execute"
    # With one worker the second run is begun or waits when the dispatcher is killed.
    with serving(tmp_path, HOSTLENS_TASK=task, HOSTLENS_DATABASE_URL=url, HOSTLENS_WORKERS="1") as service:
        client = service.client
        grid = client.submit({**request, "analysis": ASKED})
        assert grid.n_runs == 2
        with pytest.raises(ApiError):
            client.figure(grid.id)  # no result yet
        eventually(lambda: client.status(grid.id).counts.done >= 1, 300, "the first result")
        killed = eventually(lambda: service.child("service.dispatcher"), what="a dispatcher")
        os.kill(killed.pid, signal.SIGKILL)
        ended = client.wait(grid.id, timeout_s=300)
        assert ended.counts.done == 2
        found = read_records(url, grid.id)
        assert (found.states, found.stored) == ({"done": 2}, 2)
        summary = client.grid_summary(grid.id)
        results = {found.inputs["n"]: (found.id, client.run(found.id).result) for found in client.runs(grid.id)}
        assert all(result is not None and result.figure is not None for _, result in results.values())
        first, _ = results[2.0]
        arrays, record = client.products(first), client.record(first)
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
        assert service.end() == 0
        eventually(lambda: service.processes() == [], what="the end of all processes")
    # What the database says of a run is what the engine says, to the last bit.
    planned = expand(Grid(preset="h0licow-vi/HE0435", analysis=Analysis(**ASKED), **VALUES))
    (realization,) = (one.realization for one in planned if one.realization.host.n == 2.0)
    direct = run(realization)
    row = next(row for row in summary.rows if row.input["n"] == 2.0)
    for estimate in direct.estimates:
        stored = row.estimates[f"{estimate.estimator}_{estimate.index_prior}"]
        assert stored is not None
        for name in ("magnitude", "r_eff", "n"):
            found, expected = getattr(stored, name), getattr(estimate, name)
            assert (found.mean, found.sd, found.bias) == (expected.mean, expected.sd, expected.bias)
    assert dataclasses.asdict(realization)["seed"] == direct.seed
    assert record["realization_digest"] == realization.digest
    assert record["payload_digest"] == result_payload(direct).digest
    assert direct.products is not None
    expected = direct.products.arrays()
    assert {"image", "residual", "source", "source_truth", "chain"} <= expected.keys() == arrays.keys()
    for name, values in expected.items():
        assert np.array_equal(arrays[name], values), name
