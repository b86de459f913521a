"""Images by HTTP: taken as they come, looked at at the door, parsed by workers alone, and measured as any run is."""

from __future__ import annotations

import io
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from fastapi.testclient import TestClient

from engine import Host, Realization, simulate_realization, write_observation
from service.api.app import create_app
from service.dispatcher.outcomes import judge_answer
from service.dispatcher.pool import MEASURE
from service.domain.identifiers import utc_now
from service.domain.payload import MeasurementPayload
from service.runtime.settings import Settings
from service.store.database import Database
from service.store.leadership import Leadership
from service.store.leases import Lease
from service.store.queue import Failure, RunQueue, Stored
from service.store.retention import Retention, referred_artefacts
from service.worker.answers import read_answer
from service.worker.tasks import answer_run
from tests.service.service_process import serving
from tests.service.test_api import UNKNOWN_GRID, assert_problem, work

ADDRESS = "/v1/measurements"
KNOWN = {
    "zeropoint": "25.9463", "pixel_scale": "0.08", "theta_e": "1.2", "agn_images": "4", "shear": "false",
    "inversion": "false",
}  # fmt: skip


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """One simulated image as our own FITS file, and in the parts that other people hand over."""
    folder = tmp_path_factory.mktemp("images")
    host = Host(n=2.0, r_eff=0.39, magnitude=20.5)
    seen = simulate_realization(Realization(system="HE0435", l_eta=1.0, host=host)).observation
    write_observation(folder / "own.fits", seen)

    def written(values: Any) -> bytes:
        data = io.BytesIO()
        fits.writeto(data, values)
        return data.getvalue()

    return {
        "own": (folder / "own.fits").read_bytes(),
        "image": written(seen.image),
        "noise": written(seen.noise),
        "psf": written(3.0 * np.pad(seen.psf, ((0, 4), (0, 6)))),
    }


@pytest.fixture
def settings(url: str, tmp_path: Path) -> Settings:
    return Settings(database_url=url, data_dir=tmp_path, max_upload_bytes=30_000_000)


@pytest.fixture
def api(settings: Settings) -> Iterator[TestClient]:
    with TestClient(create_app(settings), raise_server_exceptions=False) as client:
        yield client


def parts(files: dict[str, bytes], *names: str) -> dict[str, tuple[str, bytes]]:
    return {name: (f"{name}.fits", files[name]) for name in names}


def claimed(settings: Settings) -> tuple[Database, Lease]:
    """Lease the one run that is queued, as a dispatcher would."""
    database = Database(settings.database)
    generation = Leadership(database).take("worker", lambda _: True)
    assert generation is not None
    (lease,) = RunQueue(database).claim(generation, 10)
    return database, lease


def measured(lease: Lease, settings: Settings) -> MeasurementPayload | Failure:
    """What a worker answers for a lease."""
    ending = judge_answer(lease, read_answer(answer_run(MEASURE, lease.spec, settings.artefacts)).answer)
    assert isinstance(ending, MeasurementPayload | Failure)
    return ending


# On the other database by the workers of a service, below.
@pytest.mark.parametrize("url", ["sqlite"], indirect=True)
def test_an_uploaded_image_is_measured_as_the_command_measures_it(
    api: TestClient, settings: Settings, files: dict[str, bytes]
) -> None:
    answer = api.post(ADDRESS, files=parts(files, "image", "noise", "psf"), data={**KNOWN, "name": "mine"})
    assert answer.status_code == 202, answer.text
    made = answer.json()
    assert answer.headers["location"] == made["links"]["self"] == f"{ADDRESS}/{made['id']}"
    assert (made["state"], made["name"], made["measurement"]) == ("queued", "mine", None)
    assert_problem(api.get(made["links"]["self"] + "/figure"), 404)
    database, lease = claimed(settings)
    assert (lease.kind, lease.run_id) == ("image", made["run_id"])
    payload = measured(lease, settings)
    assert isinstance(payload, MeasurementPayload), payload
    assert RunQueue(database).store(lease, payload) is Stored.STORED
    # Late, and the same.
    assert RunQueue(database).store(lease, payload) is Stored.STALE_SAME
    found = api.get(made["links"]["self"]).json()
    assert (found["state"], found["uws_phase"], found["error"]) == ("done", "COMPLETED", None)
    host = found["measurement"]["host"]["magnitude"]
    # Without the exposures behind the image its AGN are shifted stamps: the errors that it gives must cover that.
    assert host["mean"] == pytest.approx(20.5, abs=3 * host["sd"])
    assert found["measurement"]["profile"] == "standard"
    picture = api.get(found["links"]["figure"])
    assert picture.content.startswith(b"\x89PNG")
    assert api.get(found["links"]["figure"], headers={"If-None-Match": picture.headers["etag"]}).status_code == 304
    (listed,) = api.get(ADDRESS).json()["items"]
    assert listed == {**found, "measurement": None}
    grid = api.get(found["links"]["grid"]).json()
    assert (grid["state"], grid["n_runs"]) == ("done", 1)
    kinds = [event["kind"] for event in api.get(found["links"]["events"]).json()["items"]]
    assert kinds == ["grid_submitted", "run_started", "run_done", "grid_finished", "stale_result"]
    run = api.get(found["links"]["run"]).json()
    assert (run["state"], run["result"], run["attempts"][0]["outcome"]) == ("done", None, "done")
    # Files and figure are kept as long as what was found, and that is pruned.
    keys = {*found["uploads"].values()}
    assert len(keys) == 3
    assert len(referred_artefacts(database)) == 4
    assert sum(Retention(database, utc_now() - timedelta(days=1)).prune("measurements")) == 0
    assert sum(Retention(database, utc_now() + timedelta(days=1)).prune("measurements")) == 1
    assert referred_artefacts(database) == set()
    assert api.get(found["links"]["self"]).json()["measurement"] is None
    database.close()


def test_what_the_engine_refuses_is_the_failure_of_the_run(
    api: TestClient, settings: Settings, files: dict[str, bytes]
) -> None:
    # A header that promises an image, and no image behind it: nobody but a worker looks.
    made = api.post(ADDRESS, files={**parts(files, "psf"), "image": ("x", files["image"][:2880])}, data=KNOWN).json()
    database, lease = claimed(settings)
    assert referred_artefacts(database) == {*made["uploads"].values()}
    failure = measured(lease, settings)
    assert isinstance(failure, Failure)
    RunQueue(database).fail(lease, failure)
    database.close()
    found = api.get(made["links"]["self"]).json()
    assert (found["state"], found["error"]["code"]) == ("failed", "invalid_observation")


@pytest.mark.parametrize("url", ["sqlite"], indirect=True)
def test_an_upload_says_what_it_is_and_the_service_cuts_it_out(
    api: TestClient, settings: Settings, files: dict[str, bytes]
) -> None:
    # Noise alone, which a worker refuses at once, once it has read all there is to read.
    header = fits.Header({"BUNIT": "ELECTRONS", "EXPTIME": 100.0, "ABMAG": 25.5, "CRPIX1": 400.0, "CRPIX2": 400.0})
    header.update({"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 150.0, "CRVAL2": -2.0})
    header.update({"CDELT1": -0.08 / 3600, "CDELT2": 0.08 / 3600})
    data = io.BytesIO()
    fits.writeto(data, np.random.default_rng(1).standard_normal((800, 800)).astype(np.float32), header)
    image = {"image": ("i.fits", data.getvalue()), "psf": ("p.fits", files["psf"])}
    for options, said in (
        ({"center": "150.0,-2.0", "size": "5"}, "nothing stands out of its noise"),
        ({}, "800 x 800 pixels"),
        ({"size": "5", "unit": "e-/s"}, "--unit says e-/s"),
        ({"size": "5", "unit": "e-/s", "trust_options": "true", "pixel_scale": "0"}, None),
    ):
        answer = api.post(ADDRESS, files=image, data=options)
        if said is None:
            assert_problem(answer, 422, "/pixel_scale")
            continue
        assert answer.status_code == 202, answer.text
        database, lease = claimed(settings)
        failure = measured(lease, settings)
        assert isinstance(failure, Failure)
        assert said in failure.detail
        RunQueue(database).fail(lease, failure)
        database.close()


def test_the_same_key_and_files_are_one_measurement(api: TestClient, files: dict[str, bytes]) -> None:
    key = {"Idempotency-Key": "once"}
    first, again = (api.post(ADDRESS, files=parts({"image": files["own"]}, "image"), headers=key) for _ in range(2))
    assert (first.status_code, again.status_code) == (202, 202), first.text
    assert first.json()["id"] == again.json()["id"]
    assert again.headers["idempotency-replayed"] == "true"
    other = api.post(ADDRESS, files=parts({"image": files["own"]}, "image"), data={"seed": "1"}, headers=key)
    assert_problem(other, 422, "idempotency-key")
    # A grid is stopped as any other.
    assert api.post(first.json()["links"]["cancel"]).json()["state"] == "cancelled"
    assert api.get(first.json()["links"]["self"]).json()["state"] == "cancelled"


def test_measurements_and_grids_do_not_disturb_each_other(
    api: TestClient, settings: Settings, files: dict[str, bytes]
) -> None:
    own = {"image": ("own.fits", files["own"])}
    made = [api.post(ADDRESS, files=own, data={"seed": str(seed)}).json()["id"] for seed in range(3)]
    page = api.get(f"{ADDRESS}?limit=2").json()
    rest = api.get(page["next"]).json()
    assert [item["id"] for item in page["items"] + rest["items"]] == made[::-1]
    for grid_id in made:
        api.post(f"/v1/grids/{grid_id}/cancel")
    grid = api.post("/v1/grids", json={"preset": "h0licow-vi/HE0435", "n": [2], "magnitude": [20.5]}).json()
    work(settings)
    assert api.get(grid["links"]["self"]).json()["state"] == "done"

    def listed(query: str) -> list[str]:
        page = api.get(f"/v1/grids?limit=2{query}").json()
        rest = api.get(page["next"]).json()["items"] if page["next"] else []
        return [item["id"] for item in page["items"] + rest]

    # Among the grids measurements are where somebody asks for them.
    assert listed("") == listed("&compact=true") == listed("&kind=simulation") == [grid["id"]]
    assert listed("&kind=measurement") == made[::-1]
    assert listed("&kind=all") == [grid["id"], *made[::-1]]
    assert_problem(api.get("/v1/grids?kind=image"), 422, "kind")
    for address, shown in (("/", [grid["id"]]), ("/?kind=measurement", made), ("/?kind=all", [grid["id"], *made])):
        text = api.get(address).text
        assert [one for one in [grid["id"], *made] if f"/grids/{one}" in text] == shown, address
    assert_problem(api.get(f"{ADDRESS}/{grid['id']}"), 404)
    assert_problem(api.get(f"{ADDRESS}/{UNKNOWN_GRID}"), 404)


def test_what_is_no_fits_file_or_does_not_fit_together_is_refused_at_the_door(
    api: TestClient, settings: Settings, files: dict[str, bytes]
) -> None:
    image, psf, own = ((name, files[name]) for name in ("image", "psf", "own"))
    scale = {"zeropoint": "25"}
    cases: list[tuple[dict[str, Any], dict[str, Any], str]] = [
        ({"image": ("x", b"")}, scale, "/image"),
        ({"image": ("x", b"not FITS" * 1000), "psf": psf}, scale, "/image"),
        ({"image": ("x", b"\x1f\x8b" + bytes(5000)), "psf": psf}, scale, "/image"),
        ({"image": ("x", b"SIMPLE  =                    T" + b" " * 5730), "psf": psf}, scale, "/image"),
        ({"image": image, "psf": ("x", files["psf"][:2000])}, scale, "/psf"),
        ({"image": image}, scale, "/psf"),
        ({"image": image, "psf": psf, "noise": image}, {"sky_rms": "0.1"}, "/sky_rms"),
        ({"image": image, "psf": psf}, {"center": "150,2"}, "/size"),
        ({"image": image, "psf": psf}, {"center": "150", "size": "5"}, "/center"),
        ({"image": image, "psf": psf}, {"unit": "furlong"}, "/unit"),
        ({"image": own}, {"gain": "2"}, "/gain"),
        ({"image": own, "noise": image}, {}, "/noise"),
        ({"image": own}, scale, "/zeropoint"),
        ({"psf": psf}, scale, "/image"),
        ({"image": image, "other": psf}, scale, "/other"),
        ({"image": image, "psf": psf}, {"zeropoint": ["25", "26"]}, "/zeropoint"),
        ({"image": image, "psf": psf}, {"zeropoint": "nan"}, "/zeropoint"),
        ({"image": image, "psf": psf}, {**scale, "noise": "text"}, "/noise"),
        ({"image": image, "psf": psf}, {**scale, "colour": "red"}, "/colour"),
        ({"image": image, "psf": psf}, {**scale, "profile": "best"}, "/profile"),
        ({"image": image, "psf": psf}, {**scale, "positions": ["1,2", "3"]}, "/positions/1/1"),
        ({"image": image, "psf": psf}, {**scale, "agn_images": "-1"}, "/agn_images"),
        ({"image": image, "psf": psf}, {**scale, "name": "a\x00b"}, "/name"),
    ]
    for given, options, pointer in cases:
        assert_problem(api.post(ADDRESS, files=given, data=options), 422, pointer)
    assert_problem(api.post(ADDRESS, json={"image": "x"}), 415)
    assert_problem(api.post(ADDRESS, content=b"x", headers={"Content-Type": "multipart/form-data"}), 400)
    broken = {"Content-Type": "multipart/form-data; boundary=x"}
    # A part that does not come to its end is none.
    half = b'--x\r\nContent-Disposition: form-data; name="image"; filename="x"\r\n\r\n' + files["image"]
    assert_problem(api.post(ADDRESS, content=half, headers=broken), 422, "/image")
    assert_problem(api.post(ADDRESS, content=b"nothing", headers=broken), 400)
    assert_problem(api.post(ADDRESS, files={"image": ("x", bytes(31_000_000))}), 413)
    # Nothing of it has been kept.
    assert not (settings.data_dir / "artefacts").exists()
    assert api.get(ADDRESS).json()["items"] == []


@pytest.mark.parametrize("url", [pytest.param("postgresql", marks=pytest.mark.postgres)], indirect=True)
def test_an_image_is_measured_by_the_workers_of_a_service(url: str, tmp_path: Path, files: dict[str, bytes]) -> None:
    """From the upload to the answer, by real processes."""
    import httpx

    with (
        serving(tmp_path, HOSTLENS_DATABASE_URL=url, HOSTLENS_WORKERS="1") as service,
        httpx.Client(base_url=f"http://127.0.0.1:{service.port}", timeout=60) as http,
    ):
        answer = http.post(ADDRESS, files=parts(files, "image", "noise", "psf"), data=KNOWN)
        made = answer.json()
        assert answer.status_code == 202, made
        for _ in range(10):
            grid = http.get(made["links"]["grid"], params={"wait": 30}).json()
            if grid["finished_at"] is not None:
                break
        found = http.get(made["links"]["self"]).json()
        assert found["state"] == "done", found["error"]
        assert found["measurement"]["status"] == "ok"
        assert http.get(found["links"]["figure"]).content.startswith(b"\x89PNG")
