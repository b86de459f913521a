"""A real run as files: its arrays, its maps as FITS, its chain for ArviZ, and a record that is computed again."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from fastapi.testclient import TestClient
from sqlalchemy import create_engine, text
from typer.testing import CliRunner

from service.api.app import create_app
from service.cli.app import app
from service.cli.replay import differences, read_record
from service.domain.payload import ESTIMATES, ResultPayload, read_payload
from service.domain.requests import GridRequest, plan
from service.domain.views import RunRecord
from service.exports.record import found_by
from service.runtime.settings import Settings
from service.store.artefacts import ArtefactStore
from service.store.database import Database
from service.store.grids import GridStore
from service.store.leadership import Leadership
from service.store.migrate import upgrade
from service.store.queue import RunQueue
from service.worker.tasks import execute

SMALL = {"source_pixels": [12, 12], "subrays": 1, "walkers": 4, "max_steps": 20, "draws": 2}
GRID = {
    "preset": "h0licow-vi/HE0435", "n": [2], "magnitude": [20.5], "l_eta": [1.0], "r_eff": [0.39], "analysis": SMALL,
}  # fmt: skip


@dataclass(frozen=True)
class Ran:
    """One run of the engine, stored, behind an API."""

    client: TestClient
    run_id: str
    payload: ResultPayload
    spec: dict[str, Any]
    store: ArtefactStore
    url: str

    def get(self, rest: str) -> Any:
        answer = self.client.get(f"/v1/runs/{self.run_id}/{rest}")
        assert answer.status_code == 200, answer.text
        return answer


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ran]:
    folder = tmp_path_factory.mktemp("run")
    url = f"sqlite:///{folder / 'run.sqlite'}"
    upgrade(url)
    database = Database(url)
    request = GridRequest.model_validate(GRID)
    GridStore(database).create(request.canonical(), lambda: plan(request, 10))
    generation = Leadership(database).take("test", lambda _: True)
    assert generation is not None
    settings = Settings(database_url=url, data_dir=folder)
    (lease,) = RunQueue(database).claim(generation, 10)
    payload = read_payload(execute(lease.spec, settings.artefacts))
    RunQueue(database).store(lease, payload)
    with TestClient(create_app(settings)) as client:
        yield Ran(client, lease.run_id, payload, lease.spec, ArtefactStore(settings.artefacts), url)
    database.close()


def test_products_are_the_arrays_that_the_worker_wrote(ran: Ran) -> None:
    answer = ran.get("products")
    assert ran.payload.products is not None
    assert answer.content == ran.store.read(ran.payload.products.key)
    assert answer.headers["content-disposition"] == f'attachment; filename="hostlens-{ran.run_id}.npz"'
    again = ran.client.get(f"/v1/runs/{ran.run_id}/products", headers={"If-None-Match": answer.headers["etag"]})
    assert again.status_code == 304
    with np.load(io.BytesIO(answer.content)) as arrays:
        assert {"image", "model", "source", "chain"} <= set(arrays.files)


def test_the_fits_of_a_run_has_its_maps_its_chain_and_its_origin(ran: Ran) -> None:
    with np.load(io.BytesIO(ran.get("products").content)) as file:
        arrays = dict(file)
    with fits.open(io.BytesIO(ran.get("fits").content), checksum=True) as units:
        units.verify("exception")
        for extension, name in {
            "IMAGE": "image", "NOISE": "noise", "MODEL": "model", "ARC": "arc_model", "RESIDUAL": "residual",
            "SOURCE": "source", "SOURCE_SD": "source_sd", "SOURCE_TRUTH": "source_truth",
        }.items():  # fmt: skip
            assert np.array_equal(units[extension].data, arrays[name]), name
        assert np.array_equal(units["MASK"].data.astype(bool), arrays["mask"])
        assert np.array_equal(units["SOURCE_X"].data["EDGE"], arrays["source_x_edges"])
        for place, name in enumerate(arrays["parameter_names"]):
            assert np.array_equal(units["CHAIN"].data[str(name)], arrays["chain"][:, place])
        header = units[0].header
        assert json.loads(header["SPEC"]) == ran.spec
        assert (header["RUN"], header["PAYLOAD"]) == (ran.run_id, ran.payload.digest)
        assert header["ENGINE"] == ran.payload.engine_digest
        ny, nx = arrays["image"].shape
        centre = WCS(units["IMAGE"].header).pixel_to_world_values((nx - 1) / 2, (ny - 1) / 2)
        assert np.allclose(centre, 0.0, atol=1e-12)  # in double precision


def test_the_chain_is_read_by_arviz(ran: Ran, tmp_path: Path) -> None:
    (tmp_path / "chain.nc").write_bytes(ran.get("chain.nc").content)
    import arviz  # takes longer to load than all else here, and each process of the tests would

    found = arviz.from_netcdf(tmp_path / "chain.nc")
    with np.load(io.BytesIO(ran.get("products").content)) as arrays:
        samples, names = arrays["chain"], [str(name) for name in arrays["parameter_names"]]
    assert ran.payload.chain is not None
    walkers = ran.payload.chain.walkers
    assert dict(found.posterior.sizes) == {"chain": walkers, "draw": len(samples) // walkers}
    assert set(found.posterior.data_vars) == set(names)
    for place, name in enumerate(names):
        assert np.array_equal(found.posterior[name].values.T.ravel(), samples[:, place])
        assert float(found.posterior[name].mean()) == pytest.approx(ran.payload.lens[name].mean, rel=1e-12)
    assert found.posterior["theta_E"].attrs["units"] == "arcsec"
    assert float(found.constant_data["theta_E_truth"]) == ran.payload.lens["theta_E"].truth
    assert found.posterior.attrs["run"] == ran.run_id
    assert "mean" in arviz.summary(found).columns


def test_a_run_names_the_addresses_of_its_files(ran: Ran) -> None:
    links = ran.client.get(f"/v1/runs/{ran.run_id}").json()["links"]
    for name in ("figure", "products", "fits", "chain", "record"):
        assert ran.client.head(links[name]).status_code == 200


def test_a_record_has_all_that_was_found(ran: Ran) -> None:
    found = ran.get("record").json()
    RunRecord.model_validate(found)
    assert found["found"] == found_by(ran.payload)
    assert (found["spec"], found["versions"]) == (ran.spec, ran.payload.versions)
    assert (found["payload_digest"], found["engine_digest"]) == (ran.payload.digest, ran.payload.engine_digest)
    assert found["versions"]["platform"]


@pytest.fixture(scope="module")
def files(ran: Ran, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The run in each file that can be replayed."""
    folder = tmp_path_factory.mktemp("files")
    (folder / "run.json").write_bytes(ran.get("record").content)
    for suffix in ("ecsv", "parquet"):
        export = ran.client.get(f"/v1/results.{suffix}?specs=true")
        (folder / f"run.{suffix}").write_bytes(export.content)
        (folder / f"bare.{suffix}").write_bytes(ran.client.get(f"/v1/results.{suffix}").content)
    return {file.name: file for file in folder.iterdir()}


def test_a_replay_finds_the_same_to_the_last_bit(ran: Ran, files: dict[str, Path]) -> None:
    told = CliRunner().invoke(app, ["replay", str(files["run.json"]), ran.run_id])
    assert told.exit_code == 0, told.output
    assert "the same to the last bit" in told.output


@pytest.mark.parametrize("name", ["run.ecsv", "run.parquet"])
@pytest.mark.parametrize("chosen", [True, False])
def test_an_export_with_specs_holds_what_a_record_holds(
    ran: Ran, files: dict[str, Path], name: str, chosen: bool
) -> None:
    record, found = read_record(files["run.json"], None), read_record(files[name], ran.run_id if chosen else None)
    for part in ("run_id", "spec", "engine_digest", "payload_digest", "versions"):
        assert getattr(found, part) == getattr(record, part)
    # Of the other estimators there is nothing in it.
    told = {key: value for key, value in record.found.items() if not key.startswith(ESTIMATES) or "image_wide" in key}
    assert {key: found.found[key] for key in told} == told
    assert list(differences(found, ran.payload, found.versions)) == [
        "no number of the export: what differs is a warning or a name"
    ]


def test_a_replay_says_what_differs_the_largest_first(
    ran: Ran, files: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # What is computed is what was found, as seen above.
    monkeypatch.setattr("service.cli.replay._compute", lambda _: (ran.payload, ran.payload.versions))
    found = json.loads(files["run.json"].read_text())
    found["payload_digest"], found["engine_digest"] = "0" * 64, "1" * 64
    found["versions"] |= {"numpy": "1.0", "platform": "Plan9 vax"}
    found["found"]["chi2"] *= 1.5
    found["found"]["arc_magnitude"] *= 1.0 + 1e-9
    (tmp_path / "changed.json").write_text(json.dumps(found))
    told = CliRunner().invoke(app, ["replay", str(tmp_path / "changed.json")])
    assert told.exit_code == 1
    lines = [line.strip() for line in told.output.splitlines()]
    assert lines[1].startswith("engine: 111111111111 on record")
    assert lines[2].startswith("numpy: 1.0 on record")
    assert lines[3].startswith("platform: Plan9 vax on record")
    assert lines[4].startswith("chi2: ")
    assert lines[5].startswith("arc_magnitude: ")
    assert len(lines) == 6


@pytest.mark.parametrize(
    ("name", "run", "told"),
    [
        ("run.json", "r_00000000000000000000000000_0000000", "is the record of"),
        ("run.ecsv", "r_00000000000000000000000000_0000000", "no such run"),
        ("run.parquet", "r_00000000000000000000000000_0000000", "no such run"),
        ("bare.ecsv", None, "specs=true"),
        ("bare.parquet", None, "specs=true"),
        ("missing.json", None, "is not there"),
        ("run.csv", None, ".parquet"),
        ("garbage.parquet", None, "is not what it should be"),
        ("garbage.ecsv", None, "is not what it should be"),
        ("garbage.json", None, "is not JSON"),
        ("other.json", None, "hostlens record 1"),
    ],
)
def test_a_file_that_cannot_be_replayed_is_refused(
    files: dict[str, Path],
    name: str,
    run: str | None,
    told: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = files.get(name, tmp_path / name)
    if name.startswith("garbage"):
        file.write_text("what is this")
    if name == "other.json":
        file.write_text("{}")
    with pytest.raises(SystemExit) as end:
        app(["replay", str(file), *([run] if run else [])])
    assert end.value.code == 2
    assert told in capsys.readouterr().err


def test_without_a_result_there_is_no_file(ran: Ran) -> None:
    missing = "r_00000000000000000000000000_0000000"
    for rest in ("products", "fits", "chain.nc", "record"):
        assert ran.client.get(f"/v1/runs/{missing}/{rest}").status_code == 404


def test_products_that_are_gone_or_damaged_are_problems(ran: Ran) -> None:
    assert ran.payload.products is not None
    path = Path(ran.store.path(ran.payload.products.key))
    whole = path.read_bytes()
    try:
        path.write_bytes(whole[:-1])
        damaged = [ran.client.get(f"/v1/runs/{ran.run_id}/{rest}") for rest in ("products", "fits", "chain.nc")]
        path.unlink()
        gone = [ran.client.get(f"/v1/runs/{ran.run_id}/{rest}") for rest in ("products", "fits", "chain.nc")]
    finally:
        path.write_bytes(whole)
    assert [answer.status_code for answer in damaged] == [500] * 3
    assert [answer.status_code for answer in gone] == [410] * 3
    for answer in (*damaged, *gone):
        assert answer.headers["content-type"] == "application/problem+json"
        assert answer.json()["artefact"] == ran.payload.products.key


def test_a_run_without_a_chain_has_none(ran: Ran) -> None:
    engine = create_engine(ran.url)
    with engine.begin() as connection:
        connection.execute(text("update result set chain_status = null"))
        # What is stored does not change so in a service: without this the document would be the one that is kept.
        connection.execute(text("update run set error_detail = 'another'"))
    try:
        answer = ran.client.get(f"/v1/runs/{ran.run_id}/chain.nc")
        assert (answer.status_code, "no chain" in answer.json()["detail"]) == (404, True)
        assert "chain" not in ran.client.get(f"/v1/runs/{ran.run_id}").json()["links"]
    finally:
        with engine.begin() as connection:
            connection.execute(text("update result set chain_status = 'not_converged'"))
            connection.execute(text("update run set error_detail = null"))
        engine.dispose()
