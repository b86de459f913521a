"""Predicted errors are kept as they came, and the frontier is what plain counting over stored runs says."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import pytest
from fastapi.testclient import TestClient
from typer.testing import CliRunner

import engine.result
from service.api.app import create_app
from service.cli import frontier as command
from service.cli.app import app
from service.client import Client
from service.domain import payload as domain
from service.domain.payload import InvalidResultError, ResultPayload, read_payload
from service.domain.requests import GridRequest, plan
from service.runtime.settings import Settings
from service.store.database import Database
from service.store.grids import GridStore
from service.store.leadership import Leadership
from service.store.leases import Lease, Outcome
from service.store.migrate import upgrade
from service.store.queue import Failure, RunQueue
from tests.service.conftest import empty
from tests.service.plans import result_of

RUNS = 40
POINT = {"preset": "h0licow-vi/HE0435", "n": [2], "l_eta": [1.0], "r_eff": [0.39], "magnitude": [20.5]}
ERRORS = {"draft": lambda k: 0.03 if k % 4 == 0 else 0.01, "standard": lambda k: 0.05 if k == 0 else 0.008}
"""Of the k-th run of a profile: `draft` is below 0.02 in 30 of 40, `standard` in 39."""
CPU = {"draft": 5.0, "standard": 12.0}


@dataclass(frozen=True)
class Stored:
    client: TestClient
    database: Database
    runs: dict[str, list[str]]
    payloads: dict[str, ResultPayload]

    def ask(self, status: int = 200, **query: Any) -> Any:
        answer = self.client.get("/v1/frontier", params=query)
        assert answer.status_code == status, answer.text
        return answer.json()


@pytest.fixture(scope="module", params=["sqlite", pytest.param("postgresql", marks=pytest.mark.postgres)])
def stored(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stored]:
    folder = tmp_path_factory.mktemp("frontier")
    if request.param == "sqlite":
        url = f"sqlite:///{folder / 'frontier.sqlite'}"
        upgrade(url)
    else:
        url = request.getfixturevalue("migrated_postgres")
        empty(url)
    database = Database(url)
    for profile in ERRORS:
        asked = GridRequest.model_validate({**POINT, "replicates": RUNS + 1, "analysis": {"profile": profile}})
        GridStore(database).create(asked.canonical(), lambda asked=asked: plan(asked, 1000))
    queue = RunQueue(database)
    generation = Leadership(database).take("test", lambda _: True)
    assert generation is not None
    runs: dict[str, list[str]] = {profile: [] for profile in ERRORS}
    payloads = {}
    for lease in queue.claim(generation, 1000):
        profile = lease.spec["analysis"]["profile"]
        payloads[lease.run_id] = _payload(lease, profile, len(runs[profile]))
        queue.store(lease, payloads[lease.run_id])
        runs[profile].append(lease.run_id)
    with TestClient(create_app(Settings(database_url=url, data_dir=folder))) as client:
        yield Stored(client, database, runs, payloads)
    database.close()


def _payload(lease: Lease, profile: str, place: int) -> ResultPayload:
    """A result whose `image` errs in its magnitude as ERRORS says; the last one is from before there were budgets."""
    document = result_of(lease).model_dump()
    image = document["estimates"]["image_wide"]
    image["budget"]["magnitude"] = {
        "rendering": 0.6 * ERRORS[profile](place), "psf": 0.8 * ERRORS[profile](place),
        "grid": 0.0, "sampling": 0.0, "draws": 0.0,
    }  # fmt: skip
    if place == RUNS:
        for estimate in document["estimates"].values():
            estimate["budget"] = None
    stages = [{"stage": "all", "wall_s": 9.0, "cpu_s": CPU[profile]}]
    return read_payload({**document, "profile": profile, "stages": stages})


def test_engine_and_service_name_the_same_stages() -> None:
    assert (domain.BUDGETED, domain.ERROR_STAGES) == (engine.result.BUDGETED, engine.result.ERROR_STAGES)


def test_a_run_answers_the_budget_that_was_stored_and_none_where_it_is_older(stored: Stored) -> None:
    first, *_, older = stored.runs["draft"]
    answered = stored.client.get(f"/v1/runs/{first}").json()["result"]["estimates"]
    for name, estimate in stored.payloads[first].estimates.items():
        assert estimate is not None
        assert estimate.budget is not None
        for quantity, parts in answered[name]["budget"].items():
            given = getattr(estimate.budget, quantity)
            assert parts == {**given.model_dump(), "total": pytest.approx(given.total, rel=1e-15)}
    assert answered["image_wide"]["budget"]["magnitude"]["total"] == pytest.approx(0.03, rel=1e-12)
    assert all(
        one["budget"] is None for one in stored.client.get(f"/v1/runs/{older}").json()["result"]["estimates"].values()
    )


def test_an_export_has_every_stage_and_nothing_where_it_is_older(stored: Stored) -> None:
    answer = stored.client.get("/v1/results", params={"profile": "draft", "limit": 1000}).json()
    rows = {row["run_id"]: row for row in answer["items"]}
    first, *_, older = stored.runs["draft"]
    assert rows[first]["magnitude_error"] == pytest.approx(0.03, rel=1e-12)
    assert rows[first]["magnitude_error_psf"] == 0.8 * 0.03
    assert answer["columns"]["r_eff_error_grid"]["unit"] == "arcsec"
    assert {name: rows[older][name] for name in domain.ERRORS} == dict.fromkeys(domain.ERRORS)


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -1e-3])
def test_an_error_that_is_no_size_is_refused(stored: Stored, wrong: float) -> None:
    document = stored.payloads[stored.runs["draft"][0]].model_dump()
    document["estimates"]["paper_wide"]["budget"]["n"]["grid"] = wrong
    with pytest.raises(InvalidResultError, match=r"estimates\.paper_wide\.budget\.n\.grid"):
        read_payload(document)


@pytest.mark.parametrize(("asked", "cheapest"), [(0.035, "draft"), (0.02, "standard"), (0.005, None)])
def test_the_cheapest_profile_that_keeps_an_error_is_found_by_counting(
    stored: Stored, asked: float, cheapest: str | None
) -> None:
    found = stored.ask(max_error=asked, system="HE0435")
    assert found["cheapest"] == cheapest
    assert [row["profile"] for row in found["profiles"]] == ["draft", "standard"]
    for row in found["profiles"]:
        errors = sorted(ERRORS[row["profile"]](k) for k in range(RUNS))
        kept = sum(error <= asked for error in errors) / RUNS
        assert (row["stored"], row["with_error"], row["cpu_s"]) == (RUNS + 1, RUNS, CPU[row["profile"]])
        assert row["keeps"]["fraction"] == pytest.approx(kept)
        assert row["keeps"]["low"] <= kept <= row["keeps"]["high"]
        assert row["keeps"]["low"] < row["keeps"]["high"]
        assert row["kept"] == (kept >= 0.95)
        assert row["median_error"] == pytest.approx(0.5 * (errors[RUNS // 2 - 1] + errors[RUNS // 2]), rel=1e-5)
        told_of = stored.runs[row["profile"]][:-1]
        assert row["run_ids"] == sorted(told_of, reverse=True)[:10]
        behind = stored.client.get(row["links"]["results"]).json()["items"]
        assert {one["run_id"] for one in behind} == set(stored.runs[row["profile"]])
    # Of `reference` nothing is known; the grid that would tell is one that can be submitted.
    assert [body["analysis"]["profile"] for body in found["to_know"]] == ["reference"]
    (body,) = found["to_know"]
    assert stored.client.post("/v1/grids?dry_run=true", json=body).json()["n_runs"] > 30


def test_where_no_stored_run_tells_that_is_said(stored: Stored) -> None:
    found = stored.ask(max_error=0.02, system="RXJ1131")
    assert (found["cheapest"], found["profiles"]) == (None, [])
    assert found["told"].startswith("no stored run has a predicted error of magnitude by image, n wide")
    assert [body["systems"] for body in found["to_know"]] == [["RXJ1131"]] * 3


@pytest.mark.parametrize("query", [{}, {"max_error": 0}, {"max_error": "nan"}, {"max_error": 0.1, "quantity": "q"}])
def test_what_cannot_be_asked_is_refused(stored: Stored, query: dict[str, Any]) -> None:
    assert stored.ask(422, **query)["errors"]


def test_the_answer_is_not_sent_twice(stored: Stored) -> None:
    first = stored.client.get("/v1/frontier?max_error=0.02")
    again = stored.client.get("/v1/frontier?max_error=0.02", headers={"If-None-Match": first.headers["ETag"]})
    assert (again.status_code, again.content) == (304, b"")


@pytest.mark.parametrize(("asked", "code"), [("0.02", 0), ("0.005", 1)])
def test_client_and_command_tell_the_same(
    stored: Stored, monkeypatch: pytest.MonkeyPatch, asked: str, code: int
) -> None:
    client = Client("http://testserver", stored.client._transport)
    assert client.frontier(float(asked), system="HE0435").model_dump(mode="json") == stored.ask(
        max_error=asked, system="HE0435"
    )
    connected: Callable[..., Client] = lambda *_: client  # noqa: E731
    monkeypatch.setattr(command, "connected", connected)
    result = CliRunner().invoke(app, ["frontier", asked, "--where", "system=HE0435"])
    assert result.exit_code == code, result.output
    told = stored.ask(max_error=asked, system="HE0435")["told"]
    assert result.output.startswith(told)
    assert ("39 of 40" in result.output) == (code == 0)
    assert "Numerical error of magnitude (mag) by image, n wide" in result.output


def test_an_error_may_be_asked_of_a_run_and_is_refused_by_name(stored: Stored) -> None:
    asked = {**POINT, "analysis": {"profile": "draft", "max_error": 0.02}}
    dry = stored.client.post("/v1/grids?dry_run=true", json=asked).json()
    # What such a run takes is not what runs of `draft` take.
    assert [kind["profile"] for kind in dry["cost"]["unknown"]] == [None]
    asked["analysis"]["max_error"] = 0
    refused = stored.client.post("/v1/grids", json=asked)
    assert refused.status_code == 422
    assert [place["pointer"] for place in refused.json()["errors"]] == ["/analysis/max_error"]


def test_a_failed_run_that_was_to_choose_its_settings_is_of_no_profile(stored: Stored) -> None:
    asked = GridRequest.model_validate({**POINT, "analysis": {"profile": "draft", "max_error": 0.02}})
    GridStore(stored.database).create(asked.canonical(), lambda: plan(asked, 10))
    queue = RunQueue(stored.database)
    generation = Leadership(stored.database).take("another", lambda _: True)
    assert generation is not None
    (lease,) = queue.claim(generation, 10)
    queue.fail(lease, Failure(Outcome.ERROR, "error", "on purpose", 0))
    for profile, failed in (("none", 1), ("draft", 0)):
        found = stored.client.get("/v1/summary", params={"profile": profile, "group_by": "profile"}).json()
        assert found["failed_elsewhere"] + sum(row["failed"] for row in found["rows"]) == failed
