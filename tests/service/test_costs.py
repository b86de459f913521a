"""What runs should take, by those that were stored; nothing is said where nothing is known."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from service.api.app import create_app
from service.cli.formatting import dry_run_lines, duration
from service.domain.requests import GridRequest, plan
from service.domain.views import DryRun
from service.runtime.settings import Settings
from service.store.costs import CostStore
from service.store.database import Database
from service.store.leadership import Leadership
from service.store.queue import RunQueue
from tests.service.plans import body, result_of


@pytest.fixture
def settings(url: str, tmp_path: Path) -> Settings:
    return Settings(database_url=url, data_dir=tmp_path)


@pytest.fixture
def api(settings: Settings) -> Iterator[TestClient]:
    with TestClient(create_app(settings), raise_server_exceptions=False) as client:
        yield client


def work(database: Database, workers: int, *cpu_s: float) -> None:
    """Store a run of each time, its wall twice that, and leave so many workers."""
    leadership = Leadership(database)
    generation = leadership.take("worker", lambda _: True)
    assert generation is not None
    queue = RunQueue(database)
    for lease, taken in zip(queue.claim(generation, len(cpu_s)), cpu_s, strict=True):
        payload = result_of(lease)
        stage = payload.stages[0].model_copy(update={"cpu_s": taken, "wall_s": 2 * taken})
        queue.store(lease, payload.model_copy(update={"stages": [stage]}))
    leadership.beat(generation, {"e" * 64: workers})


def test_a_dry_run_tells_what_runs_of_its_kind_took(api: TestClient, database: Database) -> None:
    nothing = api.post("/v1/grids?dry_run=true", json=body(10)).json()["cost"]
    kind = {"camera": "WFC3-IR_F160W", "configuration": "quad", "profile": "standard"}
    assert nothing == {"cpu_s": None, "wall_s": None, "workers": 0, "stored_runs": 0, "unknown": [kind]}
    api.post("/v1/grids", json=body(4))
    work(database, 4, 10.0, 12.0, 10.0, 12.0)
    # Four say little of how much runs differ.
    few = api.post("/v1/grids?dry_run=true", json=body(10, seed=50)).json()["cost"]
    assert (few["cpu_s"], few["stored_runs"], few["unknown"]) == (None, 4, [kind])
    api.post("/v1/grids", json=body(4, seed=100))
    work(database, 4, 10.0, 12.0, 10.0, 12.0)
    cost = api.post("/v1/grids?dry_run=true", json=body(10, seed=50)).json()["cost"]
    assert (cost["workers"], cost["stored_runs"], cost["unknown"]) == (4, 8, [])
    assert cost["cpu_s"]["expected"] == pytest.approx(110.0)
    # Twice the root of 10 runs' variance and that of a mean of 8: 8/7 s^2 (10 + 100/8).
    assert cost["cpu_s"]["high"] - 110.0 == pytest.approx(2 * (8 / 7 * 22.5) ** 0.5)
    assert 110.0 - cost["cpu_s"]["low"] == pytest.approx(cost["cpu_s"]["high"] - 110.0)
    assert cost["wall_s"]["expected"] == pytest.approx(220.0 / 4)
    # Two runs keep two of the four workers busy.
    assert api.post("/v1/grids?dry_run=true", json=body(2)).json()["cost"]["wall_s"]["expected"] == pytest.approx(22.0)
    # Of another camera, configuration or profile nothing is known.
    for other in ({"analysis": {"profile": "draft"}}, {"preset": None, "systems": ["SDSS1206"], "r_eff": [0.3]}):
        cost = api.post("/v1/grids?dry_run=true", json={**body(1), **other}).json()["cost"]
        assert (cost["cpu_s"], len(cost["unknown"])) == (None, 1), other


def test_a_dry_run_tells_its_cost_by_page_and_by_command_and_says_where_nothing_is_known(
    api: TestClient, database: Database
) -> None:
    filled = {"preset": "h0licow-vi/HE0435", "n": "2", "magnitude": "20.5", "l_eta": "1.0", "r_eff": "0.39"}

    def shown() -> tuple[str, list[str]]:
        page = api.post("/submit", data={**filled, "replicates": "10", "do": "check"})
        assert page.status_code == 200, page.text
        answer = api.post("/v1/grids?dry_run=true", json=body(10, seed=50))
        return " ".join(page.text.split()), dry_run_lines(DryRun.model_validate(answer.json()))

    page, lines = shown()
    assert "not known: there are fewer than five stored runs of WFC3-IR_F160W, quad, standard." in page
    assert lines[-1] == "cost not known: fewer than five stored runs of WFC3-IR_F160W, quad, standard"
    api.post("/v1/grids", json=body(8))
    work(database, 0, *[90.0] * 8)
    page, lines = shown()
    assert "It should take 15 min 0 s of CPU time (15 min 0 s to 15 min 0 s), and there is no worker now" in page
    assert lines[-2:] == [
        "CPU time 15 min 00 s (15 min 00 s to 15 min 00 s), by 8 stored runs of its kind",
        "no worker now",
    ]
    api.post("/v1/grids", json=body(2, seed=100))
    work(database, 3, 88.0, 92.0)
    cost = api.post("/v1/grids?dry_run=true", json=body(10, seed=50)).json()["cost"]
    page, lines = shown()
    assert "10 stored runs" in page
    assert "on the 3 workers that there are now" in page
    for found, line in zip((cost["cpu_s"], cost["wall_s"]), lines[-2:], strict=True):
        told = f"{duration(found['expected'])} ({duration(found['low'])} to {duration(found['high'])})"
        assert told in line
        assert found["low"] < found["expected"] < found["high"]


def test_the_interval_covers_what_comes_as_often_as_it_says(api: TestClient, database: Database) -> None:
    """Two standard deviations of a normal sum: 95 %. Of 200 sums of 20 runs, between 89 and 99 % (three deviations)."""
    request = GridRequest.model_validate(body(20))
    kinds = plan(request, 100).kinds()
    dice = random.Random(1)
    api.post("/v1/grids", json=body(60))
    work(database, 1, *(dice.uniform(5.0, 15.0) for _ in range(60)))
    found = CostStore(database).cost(kinds).cpu_s
    assert found is not None
    covered = sum(found.low <= sum(dice.uniform(5.0, 15.0) for _ in range(20)) <= found.high for _ in range(200))
    assert 178 <= covered <= 199


def test_a_plan_says_how_many_runs_there_are_of_each_kind() -> None:
    for request in (
        {"preset": "h0licow-vi", "replicates": 2},
        {"preset": "h0licow-vi", "n": [4], "magnitude": [20.5]},  # cuts that leave less of one slope than of others
        {"systems": ["HE0435", "SDSS1206"], "n": [1, 2], "r_eff": [0.3], "magnitude": [20, 21, 22], "l_eta": [1.0]},
    ):
        runs = plan(GridRequest.model_validate(request), 10_000)
        counted: dict[tuple[str, str], int] = {}
        for run in runs:
            key = run.inputs["camera"], run.inputs["configuration"]
            counted[key] = counted.get(key, 0) + 1
        assert {kind[:2]: number for kind, number in runs.kinds().items()} == counted


def test_time_left_is_told_before_the_first_run_has_ended(api: TestClient, database: Database) -> None:
    api.post("/v1/grids", json=body(5))
    work(database, 2, *[10.0] * 5)
    grid = api.post("/v1/grids", json=body(6, seed=50)).json()
    assert (grid["rate_per_s"], grid["eta_seconds"]) == (None, pytest.approx(6 * 20.0 / 2))
    (listed, _) = api.get("/v1/grids").json()["items"]
    assert listed["eta_seconds"] == pytest.approx(60.0)
    # Paused, nobody knows.
    assert api.post(grid["links"]["pause"]).json()["eta_seconds"] is None
    other = api.post("/v1/grids", json={**body(1), "analysis": {"profile": "draft"}}).json()
    assert other["eta_seconds"] is None
