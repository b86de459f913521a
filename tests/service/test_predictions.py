"""Predictions by HTTP and by command: answered by the runs that are meant, and refused by the place that is wrong."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from typer.testing import CliRunner

from engine import Predictor
from service.api.app import create_app
from service.cli.app import app
from service.client import ApiError, Client
from service.domain.requests import GridRequest, plan
from service.predictions.shipped import shipped_runs
from service.runtime.settings import Settings
from service.store.database import Database
from service.store.grids import GridStore
from service.store.leadership import Leadership
from service.store.migrate import upgrade
from service.store.queue import RunQueue
from tests.service.conftest import empty
from tests.service.plans import result_of

HOST = {"n": 2.0, "r_eff": 0.39, "magnitude": 21.0}
ASKED: dict[str, Any] = {"system": "HE0435", "host": HOST, "estimators": ["image_wide"]}
GRID = {"n": [2, 4], "r_eff": [0.39], "magnitude": [20.5], "l_eta": [1.0], "replicates": 2}
SYSTEMS = ["HE0435", "HE1104", "WFI2033", "HE0047", "RXJ1131"]


@pytest.fixture(scope="module", params=["sqlite", pytest.param("postgresql", marks=pytest.mark.postgres)])
def served(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Client, str]]:
    """A client of a service that has a grid of five systems, and the grid's id."""
    folder = tmp_path_factory.mktemp("predictions")
    if request.param == "sqlite":
        url = f"sqlite:///{folder / 'predictions.sqlite'}"
        upgrade(url)
    else:
        url = request.getfixturevalue("migrated_postgres")
        empty(url)
    database = Database(url)
    asked = GridRequest.model_validate({**GRID, "systems": SYSTEMS})
    grid = GridStore(database).create(asked.canonical(), lambda: plan(asked, 1000)).grid.id
    queue = RunQueue(database)
    generation = Leadership(database).take("test", lambda _: True)
    assert generation is not None
    for lease in queue.claim(generation, 1000):
        queue.store(lease, result_of(lease))
    with TestClient(create_app(Settings(database_url=url, data_dir=folder))) as connection:
        yield Client("http://testserver", transport=connection._transport), grid
    database.close()


def test_the_runs_that_come_with_it_predict_what_the_engine_says_of_them(served: tuple[Client, str]) -> None:
    found = served[0].predict(ASKED)
    (one,) = found.predictions
    answer = one.estimates["image_wide"]
    mine = [run for run in shipped_runs() if "image_wide" in run.found]
    assert (answer.runs, answer.lenses) == (len(mine), len({run.lens for run in mine}))
    assert (answer.extrapolating, answer.nearest.lens) == (False, "HE0435")
    nearest = next(run for run in mine if run.run_id == answer.run_ids[0])
    told = Predictor(shipped_runs()).predict(nearest.traits, "image_wide").quantities["magnitude"]
    assert told is not None
    assert answer.magnitude is not None
    # The nearest run has this host within the grid's steps.
    assert answer.magnitude.scatter.expected == pytest.approx(told.scatter.expected, rel=0.5)
    assert answer.magnitude.bias.high - answer.magnitude.bias.low < (
        answer.magnitude.measurement.high - answer.magnitude.measurement.low
    )


def test_the_grid_that_would_settle_it_can_be_submitted(served: tuple[Client, str]) -> None:
    own = json.loads(Path("docs/examples/my_double.json").read_text())
    slope = float(next(iter(own["mass_models"]["recommended"])))
    for system, l_eta in (("HE0435", 1.0), (own, slope)):
        found = served[0].predict(ASKED, system=system, l_eta=l_eta, exposures=[0.5, 1, 2])
        as_it_is, deeper = found.to_know
        assert (as_it_is.n_runs, deeper.n_runs) == (10, 30)
        for offer in (as_it_is, deeper):
            assert served[0].dry_run(offer.request).n_runs == offer.n_runs
        assert [one["exposures"]["n_long"] for one in deeper.request["systems"]] == (
            [1, 2, 4] if system == "HE0435" else [own["exposures"]["n_long"]] * 3
        )


def test_exposures_lower_the_scatter_and_leave_the_lens(served: tuple[Client, str]) -> None:
    found = served[0].predict(ASKED, exposures=[1, 2, 4])
    scatters = [one.estimates["image_wide"].magnitude.scatter.expected for one in found.predictions]  # type: ignore[union-attr]
    assert scatters == sorted(scatters, reverse=True)
    assert found.predictions[2].arc_snr == pytest.approx(2.0 * found.predictions[0].arc_snr, rel=1e-5)


def test_own_grids_predict_alone_or_beside_those_that_come_with_it(served: tuple[Client, str]) -> None:
    client, grid = served
    alone = client.predict(ASKED, grids=[grid], study=False).predictions[0].estimates["image_wide"]
    beside = client.predict(ASKED, grids=[grid]).predictions[0].estimates["image_wide"]
    assert (alone.runs, alone.lenses) == (20, 5)
    assert beside.runs == 20 + len([run for run in shipped_runs() if "image_wide" in run.found])
    stored = {run.id for run in client.runs(grid)}
    assert len(alone.run_ids) == 10
    assert set(alone.run_ids) <= stored


def test_a_lens_may_be_told_by_its_traits(served: tuple[Client, str]) -> None:
    lens = served[0].predict(ASKED).lens
    traits = {name: value for name, value in lens.items() if name not in {"arc_snr", "resolution"}}
    told = served[0].predict(traits=traits, estimators=["image_wide"])
    assert told.predictions == served[0].predict(ASKED).predictions
    assert told.to_know == []


def test_optics_that_no_run_had_are_extrapolated_and_told_so(served: tuple[Client, str]) -> None:
    found = served[0].predict(ASKED, optics={"defocus_nm": 20.0})
    assert found.extrapolating
    assert "most in psf" in found.told
    optics = found.to_know[0].request["optics"]
    assert optics.pop("defocus_nm") == 20.0
    assert not any(value for name, value in optics.items() if name != "coarse")


@pytest.mark.parametrize(
    ("change", "status", "pointer"),
    [
        ({"host": {**HOST, "n": 20.0}}, 422, "/host/n"),
        ({"system": "HE9999"}, 422, "/system"),
        ({"l_eta": 0.9}, 422, "/l_eta"),
        ({"level": 1.0}, 422, "/level"),
        ({"exposures": []}, 422, "/exposures"),
        ({"exposures": [0.0]}, 422, "/exposures/0"),
        ({"estimators": ["best"]}, 422, "/estimators/0"),
        ({"study": False}, 422, ""),
        ({"traits": {"camera": "WFC3-IR_F160W"}}, 422, "/traits/depth"),
        ({"colour": "red"}, 422, "/colour"),
        ({"grids": ["g_00000000000000000000000000"]}, 404, None),
    ],
)
def test_what_cannot_be_is_refused_by_its_place(
    served: tuple[Client, str], change: dict[str, Any], status: int, pointer: str | None
) -> None:
    with pytest.raises(ApiError) as refused:
        served[0].predict(ASKED, **change)
    assert refused.value.status == status
    if pointer is not None:
        assert pointer in [place["pointer"] for place in refused.value.problem["errors"]]


def test_the_command_says_the_same_without_a_service(served: tuple[Client, str], tmp_path: Path) -> None:
    words = ["predict", "HE0435", "--n", "2", "--r-eff", "0.39", "--magnitude", "21", "--estimator", "image_wide"]
    told = CliRunner().invoke(app, [*words, "--format", "json"])
    assert told.exit_code == 0, told.output
    assert json.loads(told.stdout)["predictions"] == [
        one.model_dump(mode="json") for one in served[0].predict(ASKED).predictions
    ]
    body = tmp_path / "grid.json"
    shown = CliRunner().invoke(app, [*words, "--depth", "1,2", "--grid-file", str(body)])
    assert shown.exit_code == 0, shown.output
    assert "2 times the exposures" in shown.output
    assert served[0].dry_run(json.loads(body.read_text())).n_runs == 20


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["HE0435", "--n", "2", "--r-eff", "0.4"], "give --magnitude"),
        ([], "give a system, or an --image"),
        (["--image", "x.fits", "--n", "2"], "--n: the --image says what the lens is"),
        (["HE0435", "--n", "2", "--r-eff", "0.4", "--magnitude", "21", "--depth", "deep"], "--depth: got 'deep'"),
        (["HE0435", "--n", "2", "--r-eff", "0.4", "--magnitude", "21", "--level", "2"], "level: got 2.0"),
    ],
)
def test_the_command_refuses_in_a_line(words: list[str], told: str) -> None:
    refused = CliRunner().invoke(app, ["predict", *words])
    assert refused.exit_code == 2
    assert told in refused.output
