"""Every endpoint, asked well and asked badly."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from engine.catalogue import system_names
from service.api.app import create_app
from service.domain.identifiers import new_grid_id, run_id, utc_now
from service.domain.payload import ESTIMATES, ArtefactPayload
from service.runtime.settings import Settings
from service.store.artefacts import ArtefactStore
from service.store.database import Database
from service.store.leadership import Leadership
from service.store.migrate import upgrade
from service.store.queue import RunQueue
from tests.service.plans import BODY, body, result_of
from tests.service.tasks import PNG, synthetic_payload

UNKNOWN_GRID = "g_" + "0" * 26


@pytest.fixture
def settings(url: str, tmp_path: Path) -> Settings:
    return Settings(database_url=url, data_dir=tmp_path, max_grid_runs=500)


@pytest.fixture
def api(settings: Settings) -> Iterator[TestClient]:
    with TestClient(create_app(settings), raise_server_exceptions=False) as client:
        yield client


@pytest.fixture(scope="module")
def refusing(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """One application for all requests that are refused before they reach a database."""
    folder = tmp_path_factory.mktemp("refusing")
    upgrade(f"sqlite:///{folder}/refusing.sqlite")
    settings = Settings(database_url=f"sqlite:///{folder}/refusing.sqlite", data_dir=folder, max_grid_runs=500)
    with TestClient(create_app(settings), raise_server_exceptions=False) as client:
        yield client


def work(settings: Settings, figure: ArtefactPayload | None = None) -> int:
    """Do what is queued, as a dispatcher would."""
    database = Database(settings.database)
    generation = Leadership(database).take("worker", lambda _: True)
    assert generation is not None
    queue = RunQueue(database)
    leases = queue.claim(generation, 1000)
    for lease in leases:
        queue.store(lease, result_of(lease).model_copy(update={"figure": figure}))
    database.close()
    return len(leases)


def assert_problem(answer: Any, status: int, pointer: str | None = None) -> dict[str, Any]:
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    problem = answer.json()
    assert problem["status"] == status
    assert problem["title"]
    assert "Traceback" not in answer.text
    if pointer is not None:
        assert pointer in [place["pointer"] for place in problem["errors"]], problem
    return dict(problem)


def test_a_submitted_grid_is_accepted_with_its_address_and_counts(api: TestClient) -> None:
    answer = api.post("/v1/grids", json={**BODY, "n": [2, 4], "magnitude": [20.5, 21.5], "name": "four"})
    assert answer.status_code == 202
    grid = answer.json()
    assert answer.headers["location"] == f"/v1/grids/{grid['id']}" == grid["links"]["self"]
    assert (grid["state"], grid["uws_phase"], grid["n_runs"]) == ("queued", "QUEUED", 4)
    assert grid["counts"]["queued"] == 4
    assert grid["request"]["n"] == [2.0, 4.0]
    assert grid["created_at"].endswith("Z")
    assert api.get(answer.headers["location"]).json() == grid
    runs = api.get(grid["links"]["runs"]).json()
    assert [run["label"] for run in runs["items"]] == ["HE0435/05", "HE0435/06", "HE0435/29", "HE0435/30"]
    assert runs["items"][0]["inputs"]["system"] == "HE0435"


def test_a_dry_run_stores_nothing(api: TestClient) -> None:
    answer = api.post("/v1/grids?dry_run=true", json=body(3))
    assert answer.status_code == 200
    assert answer.json()["n_runs"] == 3
    assert api.get("/v1/grids").json()["items"] == []


def test_an_idempotency_key_replays_the_same_body_and_refuses_another(api: TestClient) -> None:
    key = {"Idempotency-Key": "once-1"}
    first, again = (api.post("/v1/grids", json=body(2), headers=key) for _ in range(2))
    assert (first.status_code, again.status_code) == (202, 202)
    assert first.json()["id"] == again.json()["id"]
    assert (first.headers["idempotency-replayed"], again.headers["idempotency-replayed"]) == ("false", "true")
    assert_problem(api.post("/v1/grids", json=body(3), headers=key), 422, "idempotency-key")
    assert len(api.get("/v1/grids").json()["items"]) == 1


def test_analysis_overrides_reach_the_specification(api: TestClient) -> None:
    grid = api.post("/v1/grids", json={**BODY, "analysis": {"walkers": 32, "regularisation": "gradient"}}).json()
    (run,) = api.get(grid["links"]["runs"]).json()["items"]
    analysis = api.get(run["links"]["self"]).json()["spec"]["analysis"]
    assert (analysis["walkers"], analysis["regularisation"], analysis["draws"]) == (32, "gradient", 30)


def test_a_free_grid_runs_every_combination(api: TestClient) -> None:
    request = {"systems": ["HE0435"], "n": [1, 2.5], "r_eff": [0.2, 0.7, 1.1], "magnitude": [20], "l_eta": [1]}
    assert api.post("/v1/grids", json=request).json()["n_runs"] == 6


def test_results_summary_and_figure_of_a_finished_grid(api: TestClient, settings: Settings) -> None:
    figure = ArtefactStore(settings.artefacts).put(PNG, "png")
    grid = api.post("/v1/grids", json={**body(3), "magnitude": [20.5, 21.5]}).json()
    assert api.get(grid["links"]["summary"]).json()["overall"] == {}
    assert work(settings, figure) == 6
    grid = api.get(grid["links"]["self"]).json()
    assert (grid["state"], grid["uws_phase"], grid["progress"]) == ("done", "COMPLETED", 1.0)
    runs = [api.get(run["links"]["self"]).json() for run in api.get(grid["links"]["runs"]).json()["items"]]
    assert [attempt["outcome"] for attempt in runs[0]["attempts"]] == ["done"]
    assert runs[0]["result"]["work"] == synthetic_payload(runs[0]["spec"])["work"]
    summary = api.get(grid["links"]["summary"]).json()
    assert (summary["n_runs"], summary["n_stored"], len(summary["rows"])) == (6, 6, 2)
    row = summary["rows"][0]
    assert (row["input"]["magnitude"], row["n_runs"]) == (20.5, 3)
    assert "seed" not in row["input"]
    for name in ESTIMATES:
        means = [
            run["result"]["estimates"][name]["magnitude"]["mean"] for run in runs if run["inputs"]["magnitude"] == 20.5
        ]
        found = row["estimates"][name]["magnitude"]
        mean = sum(means) / 3
        assert found["input"] == 20.5
        assert found["mean"] == pytest.approx(mean)
        assert found["bias"] == pytest.approx(mean - 20.5)
        assert found["scatter"] == pytest.approx((sum((one - mean) ** 2 for one in means) / 2) ** 0.5, rel=1e-6)
        assert found["sd"] == pytest.approx(0.1)
    biases = [run["result"]["estimates"]["paper_free"]["r_eff"]["bias"] for run in runs]
    assert summary["overall"]["paper_free"]["r_eff"]["bias"] == pytest.approx(sum(biases) / 6)
    picture = api.get(runs[0]["links"]["figure"])
    assert (picture.status_code, picture.headers["content-type"], picture.content) == (200, "image/png", PNG)


def test_a_run_without_a_figure_has_none_to_show(api: TestClient) -> None:
    grid = api.post("/v1/grids", json=body(1)).json()
    (run,) = api.get(grid["links"]["runs"]).json()["items"]
    assert_problem(api.get(run["links"]["self"] + "/figure"), 404)


def test_pages_are_linked(api: TestClient) -> None:
    grid = api.post("/v1/grids", json=body(7)).json()
    address, seen = grid["links"]["runs"] + "?limit=3", []
    while address:
        answer = api.get(address)
        seen += [run["ordinal"] for run in answer.json()["items"]]
        address = answer.json()["next"]
        assert ("link" in answer.headers) == (address is not None)
        if address:
            assert answer.headers["link"] == f'<{address}>; rel="next"'
    assert seen == list(range(7))
    for seed in range(3):
        api.post("/v1/grids", json=body(1, seed=seed))
    first = api.get("/v1/grids?limit=2").json()
    rest = api.get(first["next"]).json()
    assert len({item["id"] for item in first["items"] + rest["items"]}) == 4
    assert rest["next"] is None
    assert len(api.get(grid["links"]["runs"] + "?state=done").json()["items"]) == 0


def test_a_grid_is_paused_resumed_and_tried_again(api: TestClient) -> None:
    grid = api.post("/v1/grids", json=body(3)).json()
    assert len(grid["engine_digest"]) == 64
    paused = api.post(grid["links"]["pause"]).json()
    assert (paused["state"], paused["uws_phase"], paused["counts"]["paused"]) == ("paused", "HELD", 3)
    assert api.get(f"{grid['links']['runs']}?state=paused").json()["items"][0]["uws_phase"] == "HELD"
    resumed = api.post(grid["links"]["resume"]).json()
    assert (resumed["state"], resumed["counts"]["queued"], resumed["paused_at"]) == ("queued", 3, None)
    assert api.post(grid["links"]["cancel"]).json()["state"] == "cancelled"
    again = api.post(grid["links"]["retry"]).json()
    assert (again["state"], again["counts"]["queued"], again["finished_at"]) == ("queued", 3, None)
    for action in ("pause", "resume", "retry"):
        assert_problem(api.post(f"/v1/grids/{UNKNOWN_GRID}/{action}"), 404)


def test_cancel_ends_a_grid_and_may_be_repeated(api: TestClient) -> None:
    grid = api.post("/v1/grids", json=body(4)).json()
    for _ in range(2):
        answer = api.post(grid["links"]["cancel"])
        assert (answer.status_code, answer.json()["uws_phase"]) == (200, "ABORTED")
    assert_problem(api.post(f"/v1/grids/{UNKNOWN_GRID}/cancel"), 404)


def test_the_catalogue_is_shown(api: TestClient) -> None:
    systems = api.get("/v1/systems").json()["items"]
    assert [system["name"] for system in systems] == list(system_names())
    found = api.get("/v1/systems/HE0435").json()
    assert 1.0 in found["mass_models"]["recommended"]
    assert "agn" in found["facts"]
    assert_problem(api.get("/v1/systems/Q9999"), 404)
    assert "WFC3-IR_F160W" in [camera["name"] for camera in api.get("/v1/cameras").json()["items"]]


def test_readiness_tells_what_is_missing(api: TestClient, settings: Settings) -> None:
    assert api.get("/healthz").json() == {"status": "ok"}
    assert api.get("/readyz").json() == {
        "status": "degraded", "database": "ok", "dispatcher": "missing", "artefacts": "ok",
        "workers": 0, "engines": {}, "beat_at": None,
    }  # fmt: skip
    database = Database(settings.database)
    leadership = Leadership(database)
    generation = leadership.take("someone")
    assert generation is not None
    answer = api.get("/readyz").json()
    assert (answer["status"], answer["dispatcher"]) == ("degraded", "ok")
    leadership.beat(generation, {"e" * 64: 2})
    answer = api.get("/readyz").json()
    assert (answer["status"], answer["workers"]) == ("ready", 2)
    database.close()


@pytest.mark.parametrize("url", ["sqlite:////nowhere/at/all.sqlite", "postgresql://nobody@127.0.0.1:1/none"])
def test_without_a_database_the_answer_is_503(url: str, tmp_path: Path) -> None:
    app = create_app(Settings(database_url=url, data_dir=tmp_path))
    with TestClient(app, raise_server_exceptions=False) as api:
        assert api.get("/healthz").status_code == 200
        for answer in (api.get("/readyz"), api.get("/v1/grids"), api.post("/v1/grids", json=body(1))):
            assert_problem(answer, 503)
            assert answer.headers["retry-after"]


@pytest.mark.parametrize(
    ("change", "pointer"),
    [
        ({"n": [99]}, "/n/0"),
        ({"n": [3]}, "/n"),
        ({"n": []}, "/n"),
        ({"n": ["2"]}, "/n/0"),
        ({"n": [True]}, "/n/0"),
        ({"magnitude": 20.5}, "/magnitude"),
        ({"preset": "other"}, "/preset"),
        ({"preset": "h0licow-vi/Q9999"}, "/preset"),
        ({"preset": None}, "/systems"),
        ({"systems": ["RXJ1131"]}, "/systems"),
        ({"mass_model": "none-such"}, "/mass_model"),
        ({"noise_level": "loud"}, "/noise_level"),
        ({"seed": -1}, "/seed"),
        ({"seed": 10**30}, "/seed"),
        ({"seed": 1.5}, "/seed"),
        ({"replicates": 501}, "/replicates"),
        ({"replicates": 0}, "/replicates"),
        ({"analysis": {"walkers": 1}}, "/analysis/walkers"),
        ({"analysis": {"sampler": "x"}}, "/analysis/sampler"),
        ({"name": "a\x00b"}, "/name"),
        ({"name": ""}, "/name"),
        ({"name": "x" * 201}, "/name"),
        ({"color": "red"}, "/color"),
    ],
)
def test_a_bad_field_is_named(refusing: TestClient, change: dict[str, Any], pointer: str) -> None:
    assert_problem(refusing.post("/v1/grids", json={**BODY, **change}), 422, pointer)


@pytest.mark.parametrize(
    "content",
    [
        b"", b"{", b"[]", b"null", b'"text"', b"\xff\xfe", b'{"n": [NaN]}', b'{"n": [Infinity]}', b'{"n": [1e999]}',
        b'{"seed": ' + b"9" * 10_000 + b"}", b"[" * 100_000, b'{"a":' * 20_000 + b"1" + b"}" * 20_000,
        b'{"name": "\\ud800"}', b'{"\\ud800": 1}', b'{"name": "\\u0000"}', b'{"preset": "h0licow-vi/\\u0000"}',
        b'{"systems": ["HE0435"], "n": [' + b"1," * 50_000 + b"1]}",
    ],
    ids=lambda content: content[:24],
)  # fmt: skip
def test_a_malformed_body_is_refused_politely(refusing: TestClient, content: bytes) -> None:
    answer = refusing.post("/v1/grids", content=content, headers={"content-type": "application/json"})
    assert 400 <= answer.status_code < 500
    assert_problem(answer, answer.status_code)


def test_a_grid_of_more_runs_than_memory_is_refused_before_it_is_made(refusing: TestClient) -> None:
    many = [round(20 + 0.001 * step, 3) for step in range(1000)]
    request = {"systems": ["HE0435"], "n": [2], "r_eff": [0.3], "magnitude": many, "l_eta": [1], "replicates": 100_000}
    assert_problem(refusing.post("/v1/grids", json=request), 422, "/replicates")
    assert_problem(refusing.post("/v1/grids", json={"preset": "h0licow-vi", "replicates": 100_000}), 422, "/replicates")


def test_a_large_body_is_refused(refusing: TestClient) -> None:
    large = b'{"name": "' + b"x" * 1_000_000 + b'"}'
    assert_problem(refusing.post("/v1/grids", content=large), 413)

    def pieces() -> Iterator[bytes]:
        for _ in range(20):
            yield b" " * 100_000

    assert_problem(refusing.post("/v1/grids", content=pieces()), 413)


@pytest.mark.parametrize(
    ("address", "status", "pointer"),
    [
        ("/v1/grids?limt=3", 422, "limt"),
        ("/v1/grids?limit=0", 422, "limit"),
        ("/v1/grids?limit=1001", 422, "limit"),
        ("/v1/grids?limit=x", 422, "limit"),
        ("/v1/grids?limit=3&limit=4", 422, "limit"),
        ("/v1/grids?cursor=abc", 422, "cursor"),
        ("/v1/grids?cursor=%00", 422, "cursor"),
        ("/healthz?verbose=1", 422, "verbose"),
        ("/v1/grids/none", 422, "grid_id"),
        ("/v1/grids/%00", 422, "grid_id"),
        (f"/v1/grids/{UNKNOWN_GRID}", 404, None),
        (f"/v1/grids/{UNKNOWN_GRID}/runs", 404, None),
        (f"/v1/grids/{UNKNOWN_GRID}/summary", 404, None),
        (f"/v1/grids/{UNKNOWN_GRID}/runs?state=asleep", 422, "state"),
        (f"/v1/grids/{UNKNOWN_GRID}/runs?cursor=99999999999999999999", 422, "cursor"),
        (f"/v1/runs/r_{'0' * 26}_0000000", 404, None),
        ("/v1/runs/r_1/figure", 422, "run_id"),
        ("/v1/systems/%00", 404, None),
        ("/v1/nothing", 404, None),
        ("/v1/grids/", 404, None),
        ("/nowhere", 404, None),
    ],
)
def test_a_bad_address_is_refused_politely(
    refusing: TestClient, address: str, status: int, pointer: str | None
) -> None:
    assert_problem(refusing.get(address), status, pointer)


def test_a_wrong_method_is_told_the_right_one(refusing: TestClient) -> None:
    answer = refusing.delete("/v1/grids")
    assert_problem(answer, 405)
    assert answer.headers["allow"] == "GET, HEAD, OPTIONS, POST"


@pytest.mark.parametrize("key", ["", "x" * 256, "a b", "\xe9"])
def test_a_bad_key_is_refused(refusing: TestClient, key: str) -> None:
    answer = refusing.post("/v1/grids", json=body(1), headers={"Idempotency-Key": key.encode("latin-1")})
    assert_problem(answer, 422, "idempotency-key")


def test_an_unexpected_error_shows_no_traceback(settings: Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.api.catalogue.list_systems", lambda: 1 / 0)
    with TestClient(create_app(settings), raise_server_exceptions=False) as api:
        problem = assert_problem(api.get("/v1/systems"), 500)
    assert "division" not in str(problem)


def test_identifiers_sort_by_time_and_place() -> None:
    first = new_grid_id(utc_now())
    assert len(first) == 28
    assert run_id(first, 2) < run_id(first, 10)


def test_a_map_that_does_not_show_all_runs_says_so(api: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    grid = api.post("/v1/grids", json=body(3)).json()["id"]
    assert "The map shows" not in api.get(f"/grids/{grid}").text
    monkeypatch.setattr("service.api.site.grids._MOST_CELLS", 2)
    shown = api.get(f"/grids/{grid}").text
    assert "The map shows the first 2 of 3 runs; figures and biases are of all." in shown
    assert shown.count('href="/runs/') == 2
