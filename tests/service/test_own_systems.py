"""Systems and cameras of a user's own over HTTP, and the commands that simulate without a service."""

from __future__ import annotations

import copy
import json
import re
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from typer.testing import CliRunner

from engine import read_observation, realization_from_dict, system_from_mapping
from service.api.app import create_app
from service.cli.app import app
from service.cli.request_file import named_or_read
from service.runtime.settings import Settings

EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples"
OWN: dict[str, Any] = tomllib.loads((EXAMPLES / "my_system.toml").read_text(encoding="utf-8"))
BODY: dict[str, Any] = {"systems": [OWN], "n": [2], "r_eff": [0.35], "magnitude": [21], "l_eta": [0.9, 1.0]}
QUICK = ["--r-eff", "0.35", "--magnitude", "21"]


@pytest.fixture
def api(sqlite_url: str, tmp_path: Path) -> Iterator[TestClient]:
    settings = Settings(database_url=sqlite_url, data_dir=tmp_path, max_grid_runs=500)
    with TestClient(create_app(settings), raise_server_exceptions=False) as client:
        yield client


def own(**changes: Any) -> dict[str, Any]:
    return {**copy.deepcopy(OWN), **changes}


def test_a_grid_of_an_own_system_with_its_own_camera_is_accepted_and_kept_whole(api: TestClient) -> None:
    answer = api.post("/v1/grids", json={**BODY, "systems": ["HE0435", OWN], "l_eta": [1.0]})
    assert answer.status_code == 202, answer.text
    runs = api.get(answer.json()["links"]["self"] + "/runs").json()["items"]
    assert [run["label"] for run in runs] == ["HE0435/n2_r0.35_m21_l1", "my-quad/n2_r0.35_m21_l1"]
    assert (runs[1]["inputs"]["system"], runs[1]["inputs"]["camera"]) == ("my-quad", "my-camera")
    # What a worker gets is the system itself.
    spec = api.get(f"/v1/runs/{runs[1]['id']}").json()["spec"]
    assert realization_from_dict(spec).system == system_from_mapping(OWN)
    # And what was asked for can be asked again.
    again = api.post("/v1/grids", json=answer.json()["request"])
    assert again.status_code == 202, again.text


def test_an_own_camera_takes_the_place_of_the_systems(api: TestClient) -> None:
    answer = api.post("/v1/grids", json={**BODY, "systems": ["HE0435"], "l_eta": [1.0], "camera": OWN["camera"]})
    assert answer.status_code == 202, answer.text
    run = api.get(answer.json()["links"]["self"] + "/runs").json()["items"][0]
    assert run["inputs"]["camera"] == "my-camera"


@pytest.mark.parametrize(
    ("changes", "pointer", "told"),
    [
        ({"systems": [own(agn=[{**OWN["agn"][0], "magnitude": "bright"}])]}, "/systems/0/agn/0/magnitude", "number"),
        ({"systems": ["HE0435", own(host_q=7)]}, "/systems/1/host_q", "got 7, allowed is a number of at most 1"),
        ({"systems": [own(colour="red")]}, "/systems/0/colour", "no field of this name"),
        ({"systems": [own(mass_models={})]}, "/systems/0/mass_models", "at least 1 entries"),
        ({"systems": [own(agn=OWN["agn"][:1] * 2)]}, "/systems/0/agn", "images of different names"),
        ({"systems": [own(name="a"), own(agn=OWN["agn"][:3])]}, "/systems/1/agn", "4 images, as many as mass_models."),
        ({"systems": [7]}, "/systems/0", "a table of its fields"),
        ({"systems": [OWN, OWN]}, "/systems", "without repeated values"),
        ({"systems": [own(camera="none")]}, "/systems/0/camera", "WFC3-IR_F160W"),
        ({"systems": [own(exposures={**OWN["exposures"], "dither": "none"})]}, "/systems/0/exposures/dither", "one of"),
        ({"systems": [own(name="HE0435")]}, "/systems/0/name", "a name that the catalogue does not have"),
        (
            {"systems": [own(camera={**OWN["camera"], "name": "WFC3-IR_F160W"})]},
            "/systems/0/camera/name",
            "a name that the catalogue does not have",
        ),
        ({"camera": {**OWN["camera"], "name": "ACS-WFC_F814W"}}, "/camera/name", "a name that the catalogue"),
        (
            {"systems": [own(camera={**OWN["camera"], "oversampling": 1})]},
            "/systems/0/camera/oversampling",
            "lambda / 2D",
        ),
        ({"camera": {**OWN["camera"], "oversampling": 1}}, "/camera/oversampling", "lambda / 2D"),
        ({"camera": {**OWN["camera"], "pixel_scale": 2e-4}}, "/camera/pixel_scale", "sub-pixels along"),
        ({"systems": [own(priors={"theta_E": {"low": 9.0}})]}, "/systems/0/priors/theta_E", "something between"),
        ({"analysis": {"priors": {"slope": {"high": 1.0}}}}, "/analysis/priors/slope", "something between"),
        ({"systems": [own(mass_models={"a/b": {"1.0": {}}})]}, "/systems/0/mass_models/a~1b/1.0/theta_E", "required"),
        ({"systems": [own(mass_models={"v1.2": {}})]}, "/systems/0/mass_models/v1.2", "one l_eta at least"),
        ({"camera": {**OWN["camera"], "gain": 0}}, "/camera/gain", "a number above 0"),
        ({"camera": "none"}, "/camera", "WFC3-IR_F160W"),
        ({"l_eta": [1.1]}, "/l_eta", "one of [0.9, 1.0]"),
    ],
)
def test_a_wrong_own_system_is_refused_with_a_pointer_to_the_field(
    api: TestClient, changes: dict[str, Any], pointer: str, told: str
) -> None:
    answer = api.post("/v1/grids", json={**BODY, **changes})
    assert answer.status_code == 422, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    places = {place["pointer"]: place["message"] for place in answer.json()["errors"]}
    assert pointer in places, places
    assert told in places[pointer]


def test_priors_are_taken_and_those_of_what_the_lens_has_not_are_refused(api: TestClient) -> None:
    def post(analysis: dict[str, Any]) -> Any:
        return api.post("/v1/grids", json={"preset": "h0licow-vi/HE0435", "l_eta": [1.0], "analysis": analysis})

    asked = {"priors": {"slope": {"mean": 2.0, "sd": 0.1}}, "agn_position_sd": 0.003, "background_sd": 0.001}
    taken = post(asked)
    assert taken.status_code == 202, taken.text
    run = api.get(taken.json()["links"]["self"] + "/runs").json()["items"][0]
    spec = api.get(f"/v1/runs/{run['id']}").json()["spec"]["analysis"]
    assert spec["priors"]["slope"]["mean"] == 2.0
    assert (spec["agn_position_sd"], spec["background_sd"]) == (0.003, 0.001)
    for wrong, field in (
        ({"priors": {"gamma2": {"high": 0.1}}}, "/analysis/priors"),
        ({"priors": {"slope": {"low": 2.1, "high": 1.9}}}, "/analysis/priors/slope"),
        ({"agn_position_sd": 0}, "/analysis/agn_position_sd"),
    ):
        refused = post(wrong)
        assert refused.status_code == 422
        assert refused.json()["errors"][0]["pointer"] == field


def command(*arguments: str) -> Any:
    return CliRunner().invoke(app, list(arguments))


def plain(text: str) -> str:
    """Terminal output without boxes, colours and line ends."""
    return re.sub(r"\s+", " ", re.sub(r"\x1b\[[0-9;]*m|[│╭╮╰╯─]", " ", text))


def test_simulate_writes_fits_and_picture_of_a_system_in_a_file(tmp_path: Path) -> None:
    done = command("simulate", str(EXAMPLES / "my_system.toml"), *QUICK, "--seed", "4", "--out", str(tmp_path))
    assert done.exit_code == 0, done.output
    observation = read_observation(next(tmp_path.glob("my-quad*.fits")))
    assert (observation.provenance["SYSTEM"], observation.provenance["SEED"]) == ("my-quad", 4)
    picture = next(tmp_path.glob("my-quad*.png"))
    assert picture.read_bytes().startswith(b"\x89PNG")
    # The camera has no level of the paper's author, and the command does not hide it.
    assert "'handbook' was used" in done.output
    # The same command again is the same file again.
    before = observation.image.tobytes()
    again = command("simulate", str(EXAMPLES / "my_system.toml"), *QUICK, "--seed", "4", "--out", str(tmp_path))
    assert again.exit_code == 0
    assert len(list(tmp_path.glob("*.fits"))) == 1
    assert read_observation(next(tmp_path.glob("*.fits"))).image.tobytes() == before


def test_simulate_takes_the_papers_host_where_none_is_given(tmp_path: Path) -> None:
    done = command("simulate", "HE0435", "--camera", str(camera_file(tmp_path)), "--out", str(tmp_path / "new"))
    assert done.exit_code == 0, done.output
    record = read_observation(next((tmp_path / "new").glob("HE0435*.fits"))).provenance
    assert (record["HOST_N"], record["HOST_RE"], record["HOST_MAG"], record["L_ETA"]) == (2.0, 0.39, 21.0, 1.0)
    assert record["CAMERA"] == "my-camera"


def test_inversion_pictures_one_inversion(tmp_path: Path) -> None:
    picture = tmp_path / "new" / "one.png"
    done = command("inversion", str(EXAMPLES / "my_system.toml"), *QUICK, "--source-pixels", "8", "--out", str(picture))
    assert done.exit_code == 0, done.output
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert str(picture.name) in done.output


def camera_file(folder: Path) -> Path:
    path = folder / "camera.json"
    path.write_text(json.dumps(OWN["camera"]), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["simulate", "nowhere"], "system: got 'nowhere'"),
        (["inversion", "HE0435", "--profile", "quick"], "analysis.profile: got 'quick'"),
        (["simulate", "absent.toml"], "absent.toml"),
        (["simulate", str(EXAMPLES / "my_system.toml")], "give --r-eff and --magnitude"),
        (["simulate", str(EXAMPLES / "my_system.toml"), *QUICK, "--l-eta", "1.2"], "l_eta: got 1.2"),
        (["simulate", "HE0435", "--n", "77"], "host.n: got 77.0, allowed is a number of at most 10"),
        (["simulate", "HE0435", "--noise-level", "loud"], "noise_level: got 'loud'"),
        (["simulate", "HE0435", "--mass-model", "dark"], "mass_model: got 'dark'"),
        (["simulate", "HE0435", "--camera", "none"], "camera: got 'none'"),
        (["simulate", "HE0435", "--all", "--n", "2"], "leave out --n"),
        (["montage", "nowhere"], "preset: got 'h0licow-vi/nowhere'"),
        (["gallery", "--noise-level", "loud"], "noise_level: got 'loud'"),
    ],
)
def test_a_command_that_cannot_be_carried_out_says_why_in_a_line(arguments: list[str], told: str) -> None:
    done = command(*arguments)
    assert done.exit_code == 2
    assert told in plain(done.output)
    assert "Traceback" not in done.output


def test_help_does_not_load_the_engine() -> None:
    import subprocess

    code = (
        "import sys, service.cli.app; "
        "sys.exit(any(name.split('.')[0] in ('engine', 'matplotlib') for name in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_request_names_systems_and_carries_the_tables_of_those_in_files() -> None:
    assert named_or_read("HE0435", "--system") == "HE0435"
    assert named_or_read(str(EXAMPLES / "my_system.toml"), "--system") == OWN
