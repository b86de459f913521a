"""Behind PgBouncer in transaction mode, where the next transaction is another session's."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

import httpx
import psycopg
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import func, select, text

from service.api.app import create_app
from service.client import ApiError
from service.domain.views import GridView
from service.runtime.settings import Settings
from service.store.database import Database
from service.store.faults import AccessRefusedError, DatabaseAwayError
from service.store.grids import GridStore
from service.store.leadership import Leadership
from service.store.migrate import current, differences, revisions, upgrade
from service.store.queue import RunQueue, Stored
from service.store.tables import result
from tests.service.conftest import empty, new_database
from tests.service.plans import body, result_of, submit
from tests.service.pooler import Pooler, pooler
from tests.service.service_process import eventually, serving

T = TypeVar("T")
pytestmark = pytest.mark.postgres


@pytest.fixture(scope="module")
def bouncer(postgres_server: str) -> Iterator[Pooler]:
    with pooler(postgres_server) as found:
        yield found


@pytest.fixture
def url(bouncer: Pooler, migrated_postgres: str) -> str:
    empty(migrated_postgres)
    return bouncer.url("store")


def test_a_database_is_migrated_by_way_of_a_pooler_by_several_at_once(bouncer: Pooler, postgres_server: str) -> None:
    new_database(postgres_server, "pooled_migration")
    url = bouncer.url("pooled_migration")
    with ThreadPoolExecutor(4) as threads:
        list(threads.map(upgrade, [url] * 4))
    assert current(url) == revisions()[-1]
    assert differences(url) is None


def test_threads_that_share_few_sessions_take_and_store_each_run_once(url: str) -> None:
    database = Database(url)
    generation = Leadership(database).take("pooled")
    assert generation is not None
    runs = 60
    grid_id = submit(GridStore(database), runs)

    def work(_: int) -> int:
        mine, stored = Database(url), 0
        queue, grids = RunQueue(mine), GridStore(mine)
        # Each statement is repeated more often than a driver needs to have it prepared by the server.
        while leases := queue.claim(generation, 1):
            assert Leadership(mine).beat(generation, {"e": 1})
            stored += queue.store(leases[0], result_of(leases[0])) is Stored.STORED
            assert sum(grids.grid(grid_id).counts.model_dump().values()) == runs
            assert len(grids.runs(grid_id, 1000).items) == runs
        mine.close()
        return stored

    with ThreadPoolExecutor(8) as threads:
        assert sum(threads.map(work, range(8))) == runs
    with database.read() as connection:
        assert connection.scalar(select(func.count()).select_from(result)) == runs
    database.close()


def test_nothing_of_a_transaction_stays_in_the_session(url: str, migrated_postgres: str) -> None:
    database = Database(url)
    for _ in range(10):
        with database.read() as connection:
            shown = [connection.scalar(text(f"SHOW transaction_{name}")) for name in ("isolation", "read_only")]
            assert connection.scalar(text("SHOW transaction_isolation")) == "repeatable read"
        with database.write() as connection:
            assert connection.scalar(text("SHOW default_transaction_isolation")) == "read committed"
            assert connection.scalar(text("SHOW default_transaction_read_only")) == "off"
            assert connection.scalar(text("SELECT count(*) FROM pg_prepared_statements")) == 0
            assert connection.scalar(text("SELECT count(*) FROM pg_locks WHERE locktype = 'advisory'")) == 0
    assert shown[1:] == ["on"]
    database.close()


def test_a_service_computes_a_grid_while_sessions_and_pooler_are_killed(postgres_server: str, tmp_path: Path) -> None:
    direct = new_database(postgres_server, f"pooled_{os.getpid()}")
    with pooler(postgres_server, server_idle_timeout="1", default_pool_size="3") as own:
        settings = {"HOSTLENS_DATABASE_URL": own.url(f"pooled_{os.getpid()}"), "HOSTLENS_DRILL_SLEEP": "0.2"}
        with serving(tmp_path, **settings) as service:
            grid = service.client.submit(body(30))
            leader = service.child("service.dispatcher")

            def status() -> GridView:
                return service.client.status(grid.id)

            def done(least: int) -> None:
                eventually(lambda: _or_none(lambda: status().counts.done >= least), what="progress")

            done(5)
            with psycopg.connect(direct.replace("+psycopg", ""), autocommit=True) as other:
                other.execute(
                    "SELECT pg_terminate_backend(pid) FROM pg_stat_activity "
                    "WHERE datname = current_database() AND pid <> pg_backend_pid()"
                )
            done(12)
            own.kill()
            eventually(lambda: service.readiness() is None, what="an answer without a database")
            own.start()
            done(30)
            assert status().state == "done"
            now = service.child("service.dispatcher")
            assert leader is not None
            assert now is not None
            # It went through all of this: nothing that a pooler does ends a dispatcher.
            assert now.pid == leader.pid
            found = Database(direct)
            with found.read() as connection:
                assert connection.scalar(select(func.count()).select_from(result)) == 30
            found.close()


def _or_none(ask: Callable[[], T]) -> T | None:
    """The answer, None where there is no database or nobody to ask."""
    try:
        return ask()
    except (ApiError, httpx.TransportError, DatabaseAwayError):
        return None


def test_options_of_libpq_are_taken_by_way_of_a_pooler(postgres_server: str, migrated_postgres: str) -> None:
    with pooler(postgres_server, ignore_startup_parameters="options") as own:
        options = "?connect_timeout=10&keepalives_idle=30&application_name=mine&options=-c%20statement_timeout%3D60000"
        for more in ("", "&target_session_attrs=read-write", "&sslmode=prefer"):
            database = Database(own.url("store", options + more))
            with database.read() as connection:
                assert connection.scalar(text("SELECT 1")) == 1
            database.close()


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"max_client_conn": "2"}, "no more connections"),
        ({"query_wait_timeout": "1", "default_pool_size": "1"}, "query_wait_timeout"),
    ],
)
def test_what_a_pooler_refuses_for_now_is_a_database_that_is_away(
    postgres_server: str, migrated_postgres: str, settings: dict[str, str], said: str
) -> None:
    def ask_at_once(one: Database, other: Database) -> None:
        with one.read() as first, other.read() as second:
            first.execute(text("SELECT 1"))
            second.execute(text("SELECT 1"))

    with pooler(postgres_server, **settings) as own:
        database, others = Database(own.url("store")), [Database(own.url("store")) for _ in range(2)]
        with others[0].write() as first:
            first.execute(text("SELECT 1"))
            with pytest.raises(DatabaseAwayError, match=said):
                ask_at_once(others[1], database)
        for other in others:
            other.close()
        eventually(lambda: _or_none(database.revision), what="an answer once there is room")
        database.close()


def test_a_parameter_that_the_pooler_does_not_take_is_told_in_one_line(bouncer: Pooler, migrated_postgres: str) -> None:
    database = Database(bouncer.url("store", "?options=-c%20statement_timeout%3D60000"))
    with pytest.raises(DatabaseAwayError, match="unsupported startup parameter") as told:
        database.revision()
    assert "\n" not in str(told.value)
    database.close()


def test_the_api_behind_a_pooler_answers_many_at_once(url: str, tmp_path: Path) -> None:
    with TestClient(create_app(Settings(database_url=url, data_dir=tmp_path)), raise_server_exceptions=False) as api:

        def ask(number: int) -> set[int]:
            made = api.post("/v1/grids", json=body(1, seed=number))
            return {made.status_code, *(api.get(path).status_code for path in ("/v1/grids", "/readyz", "/metrics"))}

        with ThreadPoolExecutor(12) as threads:
            assert set().union(*threads.map(ask, range(40))) == {200, 202}


def test_a_database_that_the_pooler_does_not_have_is_told_as_that(bouncer: Pooler) -> None:
    database = Database(bouncer.url("none_such"))
    with pytest.raises(AccessRefusedError, match="none_such"):
        database.revision()
    database.close()
