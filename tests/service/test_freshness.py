"""Who has an answer is not sent it again, who waits is told at once, and lists have a short form."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import case, update

from service.api.app import create_app
from service.domain.identifiers import utc_now
from service.runtime.settings import Settings
from service.store.artefacts import ArtefactStore
from service.store.database import Database
from service.store.leadership import Leadership
from service.store.queue import RunQueue
from service.store.retention import Retention
from service.store.tables import run
from tests.service.plans import body, result_of
from tests.service.tasks import PNG
from tests.service.test_api import UNKNOWN_GRID, assert_problem, work


@pytest.fixture
def settings(url: str, tmp_path: Path) -> Settings:
    return Settings(database_url=url, data_dir=tmp_path, max_streams=2)


@pytest.fixture
def api(settings: Settings) -> Iterator[TestClient]:
    with TestClient(create_app(settings), raise_server_exceptions=False) as client:
        yield client


def tag_of(api: TestClient, address: str) -> str:
    """The tag of an answer that whoever has it is not sent again."""
    answer = api.get(address)
    assert answer.status_code == 200, answer.text
    tag = answer.headers["etag"]
    assert answer.headers["cache-control"] == "private, no-cache"
    again = api.get(address, headers={"If-None-Match": f'"other", {tag}'})
    assert (again.status_code, again.content, again.headers["etag"]) == (304, b"", tag)
    assert api.get(address, headers={"If-None-Match": '"other"'}).status_code == 200
    return str(tag)


def claim_and_store(settings: Settings, runs: int) -> None:
    """Store so many of the runs that are queued."""
    database = Database(settings.database)
    generation = Leadership(database).take("worker", lambda _: True)
    assert generation is not None
    queue = RunQueue(database)
    for lease in queue.claim(generation, runs):
        queue.store(lease, result_of(lease))
    database.close()


def claim(settings: Settings) -> None:
    """Lease what is queued, as a dispatcher would, and do nothing with it."""
    database = Database(settings.database)
    generation = Leadership(database).take("worker", lambda _: True)
    assert generation is not None
    RunQueue(database).claim(generation, 1000)
    database.close()


def test_a_grid_has_another_tag_in_every_state_and_the_same_as_long_as_nothing_happens(
    api: TestClient, settings: Settings
) -> None:
    grid = api.post("/v1/grids", json=body(2)).json()["links"]
    tags = [tag_of(api, grid["self"])]
    for action in ("pause", "resume", "cancel", "retry"):
        api.post(grid[action])
        tags.append(tag_of(api, grid["self"]))
    assert tags[2] == tags[0]  # it waits as it did before the pause
    work(settings)
    tags.append(tag_of(api, grid["self"]))
    assert len(set(tags)) == len(tags) - 2  # as after the retry


def test_a_run_and_a_summary_have_another_tag_once_something_was_stored(api: TestClient, settings: Settings) -> None:
    grid = api.post("/v1/grids", json=body(1)).json()["links"]
    (run,) = (item["links"]["self"] for item in api.get(grid["runs"]).json()["items"])
    before = tag_of(api, run), tag_of(api, grid["summary"])
    claim(settings)
    leased = tag_of(api, run)
    work(settings, ArtefactStore(settings.artefacts).put(PNG, "png"))
    after = tag_of(api, run), tag_of(api, grid["summary"])
    assert len({before[0], leased, after[0]}) == 3
    assert before[1] != after[1]
    assert tag_of(api, grid["summary"] + "?limit=1") != after[1]
    assert tag_of(api, run + "/figure")
    # What is pruned of a run is of its document.
    database = Database(settings.database)
    assert sum(Retention(database, utc_now()).prune("attempts")) == 2
    database.close()
    assert tag_of(api, run) != after[0]


ANSWERS = (
    "/v1/summary?group_by=n",
    "/v1/trends?against=arc_magnitude",
    "/v1/comparison?compare=estimator&left=image&right=paper",
    "/v1/results?limit=1",
)


def test_answers_over_many_runs_have_another_tag_once_a_result_was_stored_that_they_mean(
    api: TestClient, settings: Settings
) -> None:
    def tags() -> list[str]:
        return [tag_of(api, address) for address in ANSWERS]

    elsewhere = [f"{address}&system=none-such" for address in ANSWERS]
    before, apart = tags(), [tag_of(api, address) for address in elsewhere]
    assert len(set(before)) == len(ANSWERS)
    api.post("/v1/grids", json=body(2))
    assert tags() == before  # nothing is stored of it
    work(settings)
    first = tags()
    assert not set(first) & set(before)
    # One more of the same input, by another grid, and one more of an input that is there already.
    grid = api.post("/v1/grids", json=body(2, seed=9)).json()["links"]
    claim_and_store(settings, 1)
    second = tags()
    assert not set(second) & set(first)
    work(settings)
    third = tags()
    assert not set(third) & set(second)
    assert [tag_of(api, address) for address in elsewhere] == apart
    assert tag_of(api, "/v1/results?limit=1&n=2") != third[3]
    assert api.get(grid["self"]).json()["state"] == "done"


def test_a_summary_has_another_tag_once_a_run_has_failed_and_once_it_is_tried_again(
    api: TestClient, settings: Settings
) -> None:
    grid = api.post("/v1/grids", json=body(2)).json()["links"]
    summary, rows = ANSWERS[0], ANSWERS[3]
    before, of_rows = tag_of(api, summary), tag_of(api, rows)
    database = Database(settings.database)
    with database.write() as connection:
        connection.execute(update(run).where(run.c.ordinal == 0).values(state="failed", error_code="x"))
    failed = tag_of(api, summary)
    with database.write() as connection:
        connection.execute(update(run).values(state=case((run.c.ordinal == 0, "queued"), else_="failed")))
    # As many failed as before, but not the same.
    other = tag_of(api, summary)
    database.close()
    assert api.post(grid["retry"]).json()["retried"] == 1
    assert len({before, failed, other}) == 3
    assert tag_of(api, summary) == before
    assert tag_of(api, rows) == of_rows


def test_who_waits_for_a_grid_is_told_of_its_end(api: TestClient, settings: Settings) -> None:
    grid = api.post("/v1/grids", json=body(2)).json()["links"]["self"]
    began = time.monotonic()
    assert api.get(f"{grid}?wait=0.4").json()["state"] == "queued"
    assert time.monotonic() - began >= 0.4
    timer = threading.Timer(0.3, work, (settings,))
    timer.start()
    began = time.monotonic()
    assert api.get(f"{grid}?wait=30").json()["state"] == "done"
    assert api.get(f"{grid}?wait=30").json()["state"] == "done"
    timer.join()
    # Neither waits for as long as it may.
    assert time.monotonic() - began < 25


def test_who_has_a_grid_is_told_of_the_next_change_or_that_there_is_none(api: TestClient) -> None:
    grid = api.post("/v1/grids", json=body(2)).json()["links"]
    known = {"If-None-Match": api.get(grid["self"]).headers["etag"]}
    assert api.get(f"{grid['self']}?wait=0.3", headers=known).status_code == 304
    timer = threading.Timer(0.3, api.post, (grid["pause"],))
    timer.start()
    began = time.monotonic()
    assert api.get(f"{grid['self']}?wait=30", headers=known).json()["state"] == "paused"
    assert time.monotonic() - began < 25
    timer.join()


def test_as_many_wait_for_a_grid_as_may_and_the_others_are_told_when_to_come_again(api: TestClient) -> None:
    grid = api.post("/v1/grids", json=body(1)).json()["links"]
    waiting = [threading.Thread(target=api.get, args=(f"{grid['self']}?wait=20",)) for _ in range(2)]
    for thread in waiting:
        thread.start()
    hub = api.app.state.context.hub  # type: ignore[attr-defined]
    until = time.monotonic() + 30
    while hub._followers < 2:
        assert time.monotonic() < until
        time.sleep(0.01)
    answer = api.get(f"{grid['self']}?wait=1")
    assert_problem(answer, 429)
    assert answer.headers["retry-after"] == "5"
    api.post(grid["cancel"])
    for thread in waiting:
        thread.join(10)
        assert not thread.is_alive()


def test_a_wait_is_refused_politely(api: TestClient) -> None:
    assert_problem(api.get(f"/v1/grids/{UNKNOWN_GRID}?wait=1"), 404)
    grid = api.post("/v1/grids", json=body(1)).json()["links"]["self"]
    for wait in ("31", "-1", "x", "nan"):
        assert_problem(api.get(f"{grid}?wait={wait}"), 422, "wait")


def test_lists_have_a_short_form_with_the_same_pages(api: TestClient, settings: Settings) -> None:
    first = api.post("/v1/grids", json={**body(3), "name": "three"}).json()
    work(settings, ArtefactStore(settings.artefacts).put(PNG, "png"))
    second = api.post("/v1/grids", json=body(2, seed=9)).json()
    page = api.get("/v1/grids?compact=true&limit=1").json()
    rest = api.get(page["next"]).json()
    assert [item["id"] for item in page["items"] + rest["items"]] == [second["id"], first["id"]]
    full = api.get(first["links"]["self"]).json()
    (item,) = rest["items"]
    assert item == {name: full[name] for name in item}
    assert "request" not in item
    runs = api.get(first["links"]["runs"] + "?compact=true&limit=2&state=done").json()
    runs["items"] += api.get(runs["next"]).json()["items"]
    assert [run["ordinal"] for run in runs["items"]] == [0, 1, 2]
    assert all(api.get(run["links"]["figure"]).content == PNG for run in runs["items"])
    waiting = api.get(second["links"]["runs"] + "?compact=true").json()["items"]
    assert [(run["state"], run["links"].keys()) for run in waiting] == [("queued", {"self", "page"})] * 2
    # Each has a page for people, too.
    for item in (second, *page["items"], *runs["items"], api.get(runs["items"][0]["links"]["self"]).json()):
        assert api.get(item["links"]["page"]).headers["content-type"].startswith("text/html"), item
        assert item["id"] in item["links"]["page"]
