"""Trying again only some of the runs that ended without a result: on both databases, and by HTTP."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from service.api.app import create_app
from service.domain.states import RunState
from service.runtime.settings import Settings
from service.store import grids as grids_module
from service.store.database import Database
from service.store.grids import GridStore
from service.store.leadership import Leadership
from service.store.leases import Outcome
from service.store.queue import Failure, RunQueue
from service.store.result_filter import ResultFilter
from service.store.run_filter import RunFilter
from service.store.runs import NotFoundError

BODY = {"preset": "h0licow-vi", "n": [2, 4], "r_eff": [0.39], "l_eta": [1.0]}


@pytest.fixture
def api(database: Database, url: str, tmp_path: Path) -> Iterator[TestClient]:
    with TestClient(create_app(Settings(database_url=url, data_dir=tmp_path))) as client:
        yield client


@pytest.fixture
def broken(api: TestClient, database: Database) -> str:
    """A grid that has ended without a result: three in a row deadline, invalid_result, cancelled."""
    grid_id = str(api.post("/v1/grids", json=BODY).json()["id"])
    queue = RunQueue(database)
    leases = queue.claim(Leadership(database).take("me") or 0, 1000)
    for number, lease in enumerate(sorted(leases, key=lambda lease: lease.run_id)):
        code = ("deadline", "invalid_result", None)[number % 3]
        if code is None:
            queue.hand_back([lease])
        else:
            queue.fail(lease, Failure(Outcome.ERROR, code, "broken", retries=0))
    GridStore(database).cancel(grid_id)
    return grid_id


def runs(api: TestClient, grid_id: str) -> list[dict[str, object]]:
    return list(api.get(f"/v1/grids/{grid_id}/runs?limit=1000").json()["items"])


@pytest.mark.parametrize("piece", [2, 2000])
def test_only_what_is_wanted_is_queued_again(
    api: TestClient, broken: str, piece: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(grids_module, "PIECE", piece)
    before = runs(api, broken)
    assert api.get(f"/v1/grids/{broken}").json()["finished_at"] is not None
    wanted = {"error_code": ["deadline"], "n": ["3.5.."]}
    answer = api.post(f"/v1/grids/{broken}/retry", json=wanted)
    assert answer.status_code == 200, answer.text
    expected = {
        run["id"]
        for run in before
        if run["error"] and run["error"]["code"] == "deadline" and run["inputs"]["n"] == 4  # type: ignore[index]
    }
    assert len(expected) >= 2
    after = {run["id"]: run["state"] for run in runs(api, broken)}
    assert {run for run, state in after.items() if state == "queued"} == expected
    assert {run: state for run, state in after.items() if run not in expected} == {
        run["id"]: run["state"] for run in before if run["id"] not in expected
    }
    assert answer.json()["retried"] == len(expected)
    assert answer.json()["finished_at"] is None
    # They are queued, so that there is nothing of the kind left.
    again = api.post(f"/v1/grids/{broken}/retry", json=wanted)
    assert again.json()["retried"] == 0


def test_what_was_cancelled_is_left_alone_where_what_failed_is_wanted(api: TestClient, broken: str) -> None:
    counts = api.get(f"/v1/grids/{broken}").json()["counts"]
    after = api.post(f"/v1/grids/{broken}/retry", json={"state": ["failed", "quarantined"]}).json()
    assert (after["counts"]["queued"], after["counts"]["failed"]) == (counts["failed"], 0)
    assert after["counts"]["cancelled"] == counts["cancelled"] > 0
    everything = api.post(f"/v1/grids/{broken}/retry")
    assert everything.json()["counts"]["cancelled"] == 0
    assert everything.json()["retried"] == counts["cancelled"]


def test_a_run_that_is_tried_again_in_a_paused_grid_waits(api: TestClient, broken: str) -> None:
    api.post(f"/v1/grids/{broken}/retry", json={"error_code": ["deadline"]})
    api.post(f"/v1/grids/{broken}/pause")
    after = api.post(f"/v1/grids/{broken}/retry", json={"error_code": ["invalid_result"]}).json()
    assert after["retried"] > 0
    assert after["counts"]["queued"] == after["counts"]["failed"] == 0


def test_what_nothing_agrees_with_changes_nothing(api: TestClient, broken: str, database: Database) -> None:
    before = api.get(f"/v1/grids/{broken}").json()
    answer = api.post(f"/v1/grids/{broken}/retry", json={"system": ["Q9999"]}).json()
    assert answer.pop("retried") == 0
    assert answer == before
    wanted = RunFilter((RunState.FAILED,), (), ResultFilter.read({"profile": ["reference"]}))
    assert GridStore(database).revive(broken, wanted) == 0
    with pytest.raises(NotFoundError):
        GridStore(database).revive("g_" + "0" * 26, wanted)


@pytest.mark.parametrize(
    ("body", "pointer"),
    [
        ({"state": ["done"]}, "/state"),
        ({"state": ["nonsense"]}, "/state/0"),
        ({"state": "failed"}, "/state"),
        ({"n": ["two"]}, "/n"),
        ({"grid": ["g"]}, "/grid"),
        ({"error_code": [""]}, "/error_code/0"),
        ({"system": ["a\x00"]}, "/system/0"),
    ],
)
def test_a_filter_that_cannot_be_is_refused_by_its_name(
    api: TestClient, broken: str, body: dict[str, object], pointer: str
) -> None:
    before = api.get(f"/v1/grids/{broken}").json()
    answer = api.post(f"/v1/grids/{broken}/retry", json=body)
    assert answer.status_code == 422
    assert [place["pointer"] for place in answer.json()["errors"]] == [pointer]
    assert api.get(f"/v1/grids/{broken}").json() == before
