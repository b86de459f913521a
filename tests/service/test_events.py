"""Events of a grid: in order, by pages, waited for, and as a stream that ends with the grid."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.api.app import create_app
from service.runtime.settings import Settings
from tests.service.plans import body
from tests.service.test_api import UNKNOWN_GRID, assert_problem, work


@pytest.fixture
def settings(url: str, tmp_path: Path) -> Settings:
    return Settings(database_url=url, data_dir=tmp_path)


@pytest.fixture
def api(settings: Settings) -> Iterator[TestClient]:
    with TestClient(create_app(settings), raise_server_exceptions=False) as client:
        yield client


STREAM = {"Accept": "text/event-stream"}


def parsed(stream: str) -> list[dict[str, Any]]:
    events = []
    for block in stream.strip().split("\n\n"):
        fields = dict(line.split(": ", 1) for line in block.split("\n") if not line.startswith(":"))
        if fields:
            events.append({**fields, "data": json.loads(fields["data"])})
    return events


def test_events_come_in_order_and_by_pages(api: TestClient, settings: Settings) -> None:
    grid = api.post("/v1/grids", json=body(5)).json()
    other = api.post("/v1/grids", json=body(1, seed=50)).json()
    work(settings)
    address, kinds, numbers = grid["links"]["events"] + "?limit=3", [], []
    while address:
        page = api.get(address).json()
        kinds += [item["kind"] for item in page["items"]]
        numbers += [item["id"] for item in page["items"]]
        assert {item["grid_id"] for item in page["items"]} == {grid["id"]}
        address = page["next"]
    assert kinds == ["grid_submitted", *["run_started"] * 5, *["run_done"] * 5, "grid_finished"]
    assert numbers == sorted(set(numbers))
    assert (page["cursor"], page["ended"]) == (numbers[-1], True)
    rest = api.get(f"{grid['links']['events']}?cursor={numbers[2]}").json()
    assert [item["id"] for item in rest["items"]] == numbers[3:]
    assert len(api.get(other["links"]["events"]).json()["items"]) == 4


def test_a_long_poll_answers_as_soon_as_there_is_an_event_and_not_at_all_late(
    api: TestClient, settings: Settings
) -> None:
    grid = api.post("/v1/grids", json=body(1)).json()
    seen = api.get(grid["links"]["events"]).json()["cursor"]
    began = time.monotonic()
    nothing = api.get(f"{grid['links']['events']}?cursor={seen}&wait=0.3").json()
    assert (nothing["items"], nothing["cursor"], nothing["ended"]) == ([], seen, False)
    assert time.monotonic() - began >= 0.3
    timer = threading.Timer(0.3, work, (settings,))
    timer.start()
    began = time.monotonic()
    found = api.get(f"{grid['links']['events']}?cursor={seen}&wait=30").json()
    timer.join()
    kinds = [item["kind"] for item in found["items"]]
    while kinds[-1] != "grid_finished":
        found = api.get(f"{grid['links']['events']}?cursor={found['cursor']}&wait=30").json()
        kinds += [item["kind"] for item in found["items"]]
    assert kinds == ["run_started", "run_done", "grid_finished"]
    assert api.get(f"{grid['links']['events']}?cursor={found['cursor']}&wait=30").json()["ended"]
    # Neither waits for as long as it may.
    assert time.monotonic() - began < 25


def test_a_stream_begins_with_the_state_tells_every_event_and_ends_with_the_grid(
    api: TestClient, settings: Settings
) -> None:
    grid = api.post("/v1/grids", json=body(2)).json()
    timer = threading.Timer(0.3, work, (settings,))
    timer.start()
    answer = api.get(grid["links"]["events"], headers=STREAM)
    timer.join()
    assert answer.headers["content-type"].startswith("text/event-stream")
    events = parsed(answer.text)
    assert [event["event"] for event in events] == [
        "grid", "run_started", "run_started", "run_done", "run_done", "grid_finished",
    ]  # fmt: skip
    assert events[0]["data"]["counts"]["queued"] == 2
    resumed = api.get(grid["links"]["events"], headers={**STREAM, "Last-Event-ID": events[1]["id"]})
    assert [event["id"] for event in parsed(resumed.text)] == [event["id"] for event in events[2:]]
    over = api.get(grid["links"]["events"], headers={**STREAM, "Last-Event-ID": events[-1]["id"]})
    assert over.status_code == 204


def test_events_are_refused_politely(api: TestClient) -> None:
    assert_problem(api.get(f"/v1/grids/{UNKNOWN_GRID}/events"), 404)
    assert_problem(api.get(f"/v1/grids/{UNKNOWN_GRID}/events", headers=STREAM), 404)
    assert_problem(api.get(f"/v1/grids/{UNKNOWN_GRID}/events?wait=31"), 422, "wait")
    assert_problem(api.get(f"/v1/grids/{UNKNOWN_GRID}/events", headers={"Last-Event-ID": "x"}), 422, "last-event-id")
