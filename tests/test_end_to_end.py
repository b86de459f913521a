"""The main job with the real engine: a grid in by REST, biases out of the database, through a kill."""

import dataclasses
import os
import signal
from pathlib import Path

from engine import Analysis, Grid, expand, run
from tests.drills.stored import read_records
from tests.service.service_process import eventually, serving

QUICK = Analysis(source_pixels=(12, 12), max_steps=10, draws=4)
VALUES = {"n": (2.0, 4.0), "magnitude": (20.5, 21.5), "l_eta": (1.0,), "r_eff": (0.39,)}


def test_a_grid_of_the_paper_survives_a_kill_and_its_biases_are_those_of_the_engine(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'real.sqlite'}"
    request = {
        "preset": "h0licow-vi/HE0435",
        **{name: list(values) for name, values in VALUES.items()},
        "analysis": {"source_pixels": [12, 12], "max_steps": 10, "draws": 4},
    }
    with serving(tmp_path, HOSTLENS_TASK="service.worker:execute", HOSTLENS_DATABASE_URL=url) as service:
        grid = service.client.submit(request)
        assert grid.n_runs == 4
        eventually(lambda: service.client.status(grid.id).counts.done >= 1, 300, "the first result")
        killed = eventually(lambda: service.child("service.dispatcher"), what="a dispatcher")
        os.kill(killed.pid, signal.SIGKILL)
        ended = service.client.wait(grid.id, timeout_s=300)
        assert ended.counts.done == 4
        found = read_records(url, grid.id)
        assert (found.states, found.stored) == ({"done": 4}, 4)
        summary = service.client.grid_summary(grid.id)
        runs = list(service.client.runs(grid.id))
        figures = [service.client.run(found.id).result for found in runs]
        assert all(found is not None and found.figure is not None for found in figures)
        assert service.end() == 0
        eventually(lambda: service.processes() == [], what="the end of all processes")
    # What the database says of the first run is what the engine says, to the last bit.
    first = expand(Grid(preset="h0licow-vi/HE0435", analysis=QUICK, **VALUES))[0]
    direct = run(first.realization)
    row = next(row for row in summary.rows if (row.input["n"], row.input["magnitude"]) == (2.0, 20.5))
    for estimate in direct.estimates:
        stored = row.estimates[f"{estimate.estimator}_{estimate.index_prior}"]
        assert stored is not None
        for name in ("magnitude", "r_eff", "n"):
            found, expected = getattr(stored, name), getattr(estimate, name)
            assert (found.mean, found.sd, found.bias) == (expected.mean, expected.sd, expected.bias)
    assert dataclasses.asdict(first.realization)["seed"] == direct.seed
