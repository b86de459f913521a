"""Metrics: Prometheus can read them, and they say what has happened."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from prometheus_client.parser import text_string_to_metric_families
from sqlalchemy import event, text

from service.api.app import create_app
from service.dispatcher.telemetry import DispatcherMetrics, MeasuredQueue
from service.runtime.settings import Settings
from service.runtime.start import ConfigurationError
from service.store.database import Database
from service.store.depth import QueueDepth
from service.store.grids import GridStore
from service.store.leadership import Leadership
from service.store.leases import Outcome
from service.store.queue import Failure
from tests.service.conftest import Clock
from tests.service.plans import body, result_of, submit

UNKNOWN_GRID = "g_" + "0" * 26


class Samples:
    """A scrape, asked by name and labels."""

    def __init__(self, text: str) -> None:
        families = list(text_string_to_metric_families(text))
        self.documented = all(family.documentation for family in families)
        self._values = {
            (sample.name, frozenset(sample.labels.items())): sample.value
            for family in families
            for sample in family.samples
        }

    def __call__(self, name: str, **labels: str) -> float:
        return self._values[name, frozenset(labels.items())]

    def names(self) -> set[str]:
        return {name for name, _ in self._values}

    def routes(self) -> set[str]:
        return {dict(labels).get("route", "") for _, labels in self._values} - {""}


@pytest.fixture
def api(url: str, tmp_path: Path) -> Iterator[TestClient]:
    with TestClient(create_app(Settings(database_url=url, data_dir=tmp_path)), raise_server_exceptions=False) as client:
        yield client


def scrape(api: TestClient) -> Samples:
    answer = api.get("/metrics")
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("text/plain; version=")
    return Samples(answer.text)


def test_requests_are_counted_by_documented_address_and_never_by_what_was_sent(api: TestClient) -> None:
    for address in (f"/v1/grids/{UNKNOWN_GRID}", "/v1/grids/none", "/v1/no/such/place", "/v1/other"):
        api.get(address)
    api.post("/v1/grids", json=body(2))
    api.post("/v1/grids", content=b'{"name": "' + b"x" * 1_000_000 + b'"}')
    api.request("PURGE", "/v1/grids")
    samples = scrape(api)
    count = "hostlens_http_requests_total"
    assert samples.documented
    assert samples(count, method="GET", route="/v1/grids/{grid_id}", status="404") == 1
    assert samples(count, method="GET", route="/v1/grids/{grid_id}", status="422") == 1
    assert samples(count, method="POST", route="/v1/grids", status="202") == 1
    assert samples(count, method="GET", route="none", status="404") == 2
    assert samples(count, method="POST", route="none", status="413") == 1
    assert samples("hostlens_http_request_duration_seconds_count", method="POST", route="/v1/grids") == 1
    assert not [route for route in samples.routes() if "no/such" in route or UNKNOWN_GRID in route]
    assert not [route for route in samples.routes() if route != "none" and not route.startswith("/")]


def test_the_queue_and_its_leader_are_read_at_each_scrape(api: TestClient, url: str) -> None:
    empty = scrape(api)
    assert (empty("hostlens_database_up"), empty("hostlens_leader_alive")) == (1, 0)
    assert empty("hostlens_runs", state="queued") == 0
    database = Database(url)
    submit(GridStore(database), 5)
    leadership = Leadership(database)
    generation = leadership.take("here")
    assert generation == 1
    leadership.beat(generation, {"0" * 64: 2})
    queue = MeasuredQueue(DispatcherMetrics(), database, retry_delay_s=600.0)
    first, second, _ = queue.claim(generation, 3)
    queue.store(first, result_of(first))
    queue.fail(second, Failure(Outcome.ERROR, "error", "again", 2))
    samples = scrape(api)
    found = {state: samples("hostlens_runs", state=state) for state in ("queued", "delayed", "leased")}
    assert found == {"queued": 2, "delayed": 1, "leased": 1}
    assert samples("hostlens_grids", state="queued") == 1
    assert samples("hostlens_leader_alive") == 1
    assert samples("hostlens_leader_generation") == 1
    assert samples("hostlens_leader_workers") == 2
    assert 0 <= samples("hostlens_leader_heartbeat_age_seconds") < 60
    assert 0 < samples("hostlens_queue_waiting_seconds") < 60
    database.close()


@pytest.mark.parametrize("url", ["sqlite:////nowhere/at/all.sqlite", "postgresql://nobody@127.0.0.1:1/none"])
def test_without_a_database_a_scrape_says_so_and_still_counts_requests(url: str, tmp_path: Path) -> None:
    with TestClient(create_app(Settings(database_url=url, data_dir=tmp_path)), raise_server_exceptions=False) as api:
        api.get("/readyz")
        samples = scrape(api)
        assert samples("hostlens_database_up") == 0
        assert samples("hostlens_http_requests_total", method="GET", route="/readyz", status="503") == 1
        assert "hostlens_runs" not in samples.names()


def test_the_depth_is_read_from_the_partial_indices_alone(database: Database) -> None:
    statements: list[str] = []

    def note(_connection: object, _cursor: object, statement: str, *_: object) -> None:
        statements.append(statement)

    event.listen(database.reader, "before_cursor_execute", note)
    QueueDepth(database, Clock()).look()
    event.remove(database.reader, "before_cursor_execute", note)
    about_runs = [statement for statement in statements if "FROM run" in statement]
    assert len(about_runs) == 2
    plans = []
    with database.read() as connection:
        if not database.is_sqlite:
            # Nobody scans an empty table by an index unless told to.
            connection.execute(text("SET LOCAL enable_seqscan = off"))
        explain = "EXPLAIN QUERY PLAN " if database.is_sqlite else "EXPLAIN "
        for statement in about_runs:
            plain = statement.replace("?", "'2026-01-01'").replace(
                "%(not_before_1)s::TIMESTAMP WITH TIME ZONE", "now()"
            )
            plain = plain.replace("%(param_1)s::INTEGER", "0").replace("%(param_2)s::INTEGER", "1")
            plans.append(str(connection.exec_driver_sql(explain + plain).all()))
    assert ["ix_run_queue" in plans[0] or "ix_run_suspect" in plans[0], "ix_run_leased" in plans[1]] == [True, True]


def test_what_becomes_of_runs_is_counted_after_it_was_committed(database: Database) -> None:
    clock, metrics = Clock(), DispatcherMetrics()
    grids = GridStore(database, clock)
    generation = Leadership(database, clock=clock).take("here")
    assert generation == 1
    queue = MeasuredQueue(metrics, database, clock, retry_delay_s=1.0)
    submit(grids, 7)
    clock.advance(1)
    unwanted = submit(grids, 1, seed=10)
    stored, failed, again, dead, lost, suspect, other, cancelled = queue.claim(generation, 8)
    grids.cancel(unwanted)
    queue.store(stored, result_of(stored))
    queue.store(stored, result_of(stored))
    queue.fail(failed, Failure(Outcome.ERROR, "error", "bad", 0))
    queue.fail(again, Failure(Outcome.DEADLINE, "deadline", "late", 1))
    queue.fail(dead, Failure(Outcome.WORKER_LOST, "worker_lost", "died", 0, suspect=True))
    queue.cancel_leased(cancelled)
    queue.requeue_lost(lost, Outcome.FORGOTTEN, "gone")
    queue.suspect([suspect], "perhaps")
    queue.refuse_engine(other, "1" * 64)
    queue.fail(lost, Failure(Outcome.ERROR, "error", "its lease has gone", 0))

    def value(name: str, **labels: str) -> float | None:
        return metrics.registry.get_sample_value(f"hostlens_{name}", labels)

    assert value("runs_claimed_total") == 8
    ended = {state: value("runs_ended_total", state=state) for state in ("done", "failed", "quarantined", "cancelled")}
    assert ended == {"done": 1, "failed": 1, "quarantined": 1, "cancelled": 1}
    reasons = ("deadline", "forgotten", "suspected", "other_engine", "error", "handed_back")
    requeued = {reason: value("runs_requeued_total", reason=reason) for reason in reasons}
    assert requeued == {
        "deadline": 1, "forgotten": 1, "suspected": 1, "other_engine": 1, "error": 0, "handed_back": 0,
    }  # fmt: skip
    assert (value("results_stale_total", digest="same"), value("results_stale_total", digest="other")) == (1, 0)
    assert value("queue_transaction_duration_seconds_count", what="store") == 2
    assert value("run_duration_seconds_count") == 1


def test_a_metrics_port_that_is_taken_is_said_and_not_passed_over() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        settings = Settings(metrics_port=taken.getsockname()[1])
        with pytest.raises(ConfigurationError, match="in use"), DispatcherMetrics().serving(settings):
            pass
