"""Hosts without an index and deflectors with more by HTTP: asked for, stored, grouped, filtered, exported, drawn."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from fastapi.testclient import TestClient
from pyarrow import parquet
from typer.testing import CliRunner

from engine import realization_from_dict
from engine.host_files import host_image
from service.api.app import create_app
from service.cli.app import app
from service.figures.question import FIGURE_KINDS
from service.runtime.settings import Settings
from service.store.database import Database
from service.store.leadership import Leadership
from service.store.queue import RunQueue
from tests.service.plans import result_of

Y, X = np.mgrid[:24, :20]
IMAGE = asdict(host_image(np.exp(-((X - 9.0) ** 2 + (Y - 12.0) ** 2) / 18.0), (9.0, 12.0)))
IMAGE["shape"], IMAGE["nucleus"] = list(IMAGE["shape"]), list(IMAGE["nucleus"])
BODY: dict[str, Any] = {
    "systems": ["HE0435"],
    "n": [2],
    "hosts": [{"made": {"kind": "spiral", "seed": 3}}, {"image": IMAGE, "name": "mine"}],
    "r_eff": [0.39],
    "magnitude": [21],
    "l_eta": [1],
    "deflectors": [{}, {"satellites": [{"theta_E": 0.1, "position": [1.9, -0.8]}]}],
    "replicates": 2,
}


@pytest.fixture
def settings(url: str, tmp_path: Path) -> Settings:
    return Settings(database_url=url, data_dir=tmp_path)


@pytest.fixture
def api(settings: Settings) -> Iterator[TestClient]:
    with TestClient(create_app(settings), raise_server_exceptions=False) as client:
        yield client


def stored(api: TestClient, settings: Settings) -> str:
    """The grid with all its results."""
    answer = api.post("/v1/grids", json=BODY)
    assert answer.status_code == 202, answer.text
    database = Database(settings.database)
    generation = Leadership(database).take("worker", lambda _: True)
    assert generation is not None
    queue = RunQueue(database)
    queue.store_all([(lease, result_of(lease)) for lease in queue.claim(generation, 100)])
    database.close()
    return str(answer.json()["id"])


def test_hosts_and_deflectors_are_stored_grouped_and_filtered_by(api: TestClient, settings: Settings) -> None:
    grid = stored(api, settings)
    runs = api.get(f"/v1/grids/{grid}/runs").json()["items"]
    assert len(runs) == 12
    image = next(run for run in runs if run["inputs"]["host_label"] == "mine")
    assert (image["inputs"]["host_kind"], image["inputs"]["n"]) == ("image", None)
    # What a worker gets has the pixels in it.
    detail = api.get(f"/v1/runs/{image['id']}").json()
    host = realization_from_dict(detail["spec"]).host
    assert host.image is not None
    assert asdict(host.image) | {"shape": [24, 20], "nucleus": [9.0, 12.0]} == IMAGE
    found = detail["result"]["estimates"]["image_wide"]
    assert found["n"]["bias"] is None
    assert found["magnitude"]["bias"] is not None

    def rows(**asked: Any) -> list[dict[str, Any]]:
        answer = api.get("/v1/summary", params=asked)
        assert answer.status_code == 200, answer.text
        return list(answer.json()["rows"])

    by_kind = rows(group_by="host_kind,deflector")
    assert [(row["group"]["host_kind"], row["group"]["deflector"], row["stored"]) for row in by_kind] == [
        (kind, deflector, 2) for kind in ("image", "sersic", "spiral") for deflector in ("plain", "satellite1")
    ]
    # Of the index only what has one has biases, and the answer to a question about it is not refused.
    of_n = {row["group"]["host_kind"]: row["bias"] for row in rows(group_by="host_kind", quantity="n")}
    assert (of_n["image"], of_n["spiral"], of_n["sersic"]["runs"]) == (None, None, 4)
    by_n = rows(group_by="n")
    assert [row["group"]["n"] for row in by_n] == [2.0, None]
    # The link to a group's results has the group's runs.
    assert len(api.get(by_n[1]["links"]["results"]).json()["items"]) == by_n[1]["stored"] == 8
    assert sum(row["stored"] for row in rows(n="none", deflector="satellite1")) == 4
    assert sum(row["stored"] for row in rows(n="1..3")) == 4
    assert sum(row["stored"] for row in rows(host_label=["mine", "spiral-3"])) == 8
    # And the summary of the grid has the mean that was recovered, without an input.
    summary = api.get(f"/v1/grids/{grid}/summary").json()
    mine = [row for row in summary["rows"] if row["input"]["n"] is None]
    assert len(mine) == 4
    for row in mine:
        n = row["estimates"]["image_wide"]["n"]
        assert (n["input"], n["bias"]) == (None, None)
        assert n["mean"] == pytest.approx(2.0, abs=1.5)
        assert row["estimates"]["image_wide"]["magnitude"]["input"] == 21.0
    assert summary["overall"]["image_wide"]["n"]["bias"] is not None


@pytest.mark.parametrize("url", ["sqlite"], indirect=True)
def test_exports_and_figures_tell_what_there_is(api: TestClient, settings: Settings) -> None:
    stored(api, settings)
    text = api.get("/v1/results.csv").text.splitlines()
    rows = list(csv.DictReader(line for line in text if not line.startswith("#")))
    assert {(row["host_kind"], row["n"], row["n_bias"] == "") for row in rows} == {
        ("sersic", "2.0", False), ("spiral", "", True), ("image", "", True),
    }  # fmt: skip
    table = parquet.read_table(io.BytesIO(api.get("/v1/results.parquet").content))
    assert table.column("n").null_count == table.column("n_bias").null_count == 8
    for suffix, form in (("vot", "votable"), ("ecsv", "ascii.ecsv")):
        read = Table.read(io.BytesIO(api.get(f"/v1/results.{suffix}").content), format=form)
        assert set(read["host_label"]) == {"sersic", "spiral-3", "mine"}
        assert np.ma.count_masked(np.ma.asarray(read["n"])) == 8
    with fits.open(io.BytesIO(api.get("/v1/results.fits").content)) as file:
        assert np.isnan(np.asarray(file[1].data["n"])).sum() == 8
    for query in ({}, {"host_kind": "spiral"}):
        for kind in set(FIGURE_KINDS) - {"montage"}:
            answer = api.get(f"/v1/figures/{kind}.svg", params=query)
            assert answer.status_code == 200, (kind, query, answer.text)
    of_n = api.get("/v1/figures/coverage.svg", params={"quantity": "n"})
    assert of_n.status_code == 200, of_n.text
    # A figure of an index that nothing has: said, not drawn.
    assert api.get("/v1/figures/coverage.svg", params={"quantity": "n", "host_kind": "spiral"}).status_code == 404


@pytest.mark.parametrize("url", ["sqlite"], indirect=True)
@pytest.mark.parametrize(
    ("change", "pointer"),
    [
        ({"hosts": [{"made": {"kind": "sprial"}}]}, "/hosts/0/made/kind"),
        ({"hosts": [{"n": 2}, {"image": {**IMAGE, "pixels": "AAAA"}}]}, "/hosts/1/image/pixels"),
        ({"hosts": [{}]}, "/hosts/0/n"),
        ({"hosts": [{"n": 3}, {"n": 4}]}, "/hosts"),
        ({"n": None, "hosts": None}, "/n"),
        ({"replicates": None, "until": {"quantity": "n", "error": 0.1}}, "/hosts"),
        ({"deflectors": [{"multipoles": [{"m": 2, "amplitude": 0.1}]}]}, "/deflectors/0/multipoles/0/m"),
        ({"deflectors": [{}, {"satellites": [{"theta_E": 0.1, "position": [1.5, 0.6]}]}]}, "/deflectors/1"),
    ],
)
def test_what_cannot_be_run_is_refused_where_it_stands(api: TestClient, change: dict[str, Any], pointer: str) -> None:
    body = {name: value for name, value in {**BODY, **change}.items() if value is not None}
    answer = api.post("/v1/grids", json=body)
    assert answer.status_code == 422, answer.text
    assert [error["pointer"] for error in answer.json()["errors"]] == [pointer]


def test_the_command_line_makes_hosts_and_deflectors_of_its_options(tmp_path: Path) -> None:
    path = tmp_path / "my galaxy.fits"
    fits.HDUList([fits.PrimaryHDU(np.exp(-((X - 9.0) ** 2 + (Y - 12.0) ** 2) / 18.0))]).writeto(path)
    lens = tmp_path / "lens.json"
    lens.write_text('{"multipoles": [{"m": 4, "amplitude": 0.01}]}')
    out = ["--out", str(tmp_path / "out")]
    told = CliRunner().invoke(app, ["simulate", "HE0435", "--host-image", str(path), "--deflector", str(lens), *out])
    assert told.exit_code == 0, told.output
    assert "HE0435_my-galaxy_r0.39_m21_l1_" in told.output
    for options, complaint in (
        (["--host", "spiral:x"], "spiral:x"),
        (["--host", "sprial"], "host.made.kind"),
        (["--host", "spiral:1", "--n", "2"], "one host"),
        (["--host-image", f"{path}[SCI]"], "extension"),
        (["--host-image", str(tmp_path / "absent.fits")], "absent.fits"),
        (["--deflector", "satellite"], "--deflector"),
        (["--all", "--host", "spiral:1"], "--all"),
    ):
        refused = CliRunner().invoke(app, ["simulate", "HE0435", *options, *out])
        assert refused.exit_code == 2, options
        assert complaint in " ".join(refused.output.split()), options
