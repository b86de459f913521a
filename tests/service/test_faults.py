"""What goes wrong with a database is told as what it is, in one line, without values, to whom it concerns."""

from __future__ import annotations

import logging
import os
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Event
from typing import Any

import psycopg
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import insert, text
from sqlalchemy.exc import DataError, DBAPIError, IntegrityError

from service.api.app import create_app
from service.dispatcher.dispatch import wait_to_lead
from service.runtime.settings import Settings
from service.store import faults
from service.store.database import AWAY, Database
from service.store.faults import (
    AccessRefusedError,
    DatabaseAwayError,
    SchemaMismatchError,
    StatementRefusedError,
    StatementTooLongError,
)
from service.store.migrate import revisions
from service.store.tables import REVISION, idempotency
from tests.service.conftest import new_database
from tests.service.plans import body
from tests.service.service_process import ROOT, eventually, free_port

OURS = "a-value-of-ours"


def judged(sqlstate: str) -> type[Exception] | None:
    error = psycopg.errors.lookup(sqlstate)()
    operational = isinstance(error, (psycopg.OperationalError, psycopg.InterfaceError, psycopg.InternalError))
    return faults._judge(error, operational=operational)


@pytest.mark.parametrize(
    ("sqlstate", "kind"),
    [
        *[(code, DatabaseAwayError) for code in (
            "08000", "08003", "08006", "08P01", "25006", "25P02", "25P03", "26000", "34000", "40001", "40P01", "42P05",
            "53000", "53100", "53200", "53300", "55P03", "57P01", "57P02", "57P03", "57P05", "58030", "XX000",
        )],
        ("57014", StatementTooLongError),
        *[(code, SchemaMismatchError) for code in ("42P01", "42703", "3F000")],
        *[(code, AccessRefusedError) for code in ("28000", "28P01", "3D000", "42501")],
        *[(code, None) for code in ("22001", "22003", "22021", "22P02", "23502", "23505", "23514", "42601", "54000")],
    ],
)  # fmt: skip
def test_sqlstates_are_judged_by_what_they_mean_and_not_by_what_the_driver_calls_them(
    sqlstate: str, kind: type[Exception] | None
) -> None:
    assert judged(sqlstate) is kind


@pytest.fixture
def fault(database: Database) -> Callable[[str], DBAPIError]:
    """What a statement of SQL ends with."""

    def of(statement: str) -> DBAPIError:
        with pytest.raises(DBAPIError) as told, database.write() as connection:
            connection.exec_driver_sql(statement)
        assert "\n" not in str(told.value).partition("\n[SQL")[0]
        return told.value

    return of


def test_a_table_or_column_that_is_missing_is_a_schema_that_is_not_ours(fault: Callable[[str], DBAPIError]) -> None:
    for statement in ("SELECT * FROM none_such", "SELECT none_such FROM run", "INSERT INTO run (none_such) VALUES (1)"):
        found = fault(statement)
        assert isinstance(found, SchemaMismatchError), statement
        assert "none_such" in str(found)


def test_what_is_refused_for_what_it_is_is_not_away(fault: Callable[[str], DBAPIError], database: Database) -> None:
    refused = ["SELEKT 1", "INSERT INTO leader (id) VALUES (7)"]
    if database.is_sqlite:
        refused.append("SELECT " + "+".join(["1"] * 2000))  # an expression that is too deep
    else:
        # A row of an index that is too long, which PostgreSQL's driver calls operational.
        wide = "array_to_string(ARRAY(SELECT md5(i::text) FROM generate_series(1, 1000) i), '')"
        refused += [
            f"CREATE TABLE wide AS SELECT {wide} AS long; CREATE INDEX too_wide ON wide (long)",
            "SELECT 'x'::int",
            "SELECT 1/0",
        ]
    for statement in refused:
        assert not isinstance(fault(statement), AWAY), statement


@pytest.mark.postgres
@pytest.mark.parametrize(
    ("statement", "kind"),
    [
        ("SET LOCAL statement_timeout = '50ms'; SELECT pg_sleep(10)", StatementTooLongError),
        ("SELECT pg_terminate_backend(pg_backend_pid())", DatabaseAwayError),
        ("EXECUTE none_such", DatabaseAwayError),
        ("SET LOCAL idle_in_transaction_session_timeout = 1; SELECT 1", None),
        ("SET TRANSACTION READ ONLY; DELETE FROM event", DatabaseAwayError),
        ("SET LOCAL ROLE nobody_much; DELETE FROM event", AccessRefusedError),
    ],
)
def test_a_server_that_ends_a_statement_or_session_is_told_as_that_and_the_next_goes_on(
    migrated_postgres: str, statement: str, kind: type[Exception] | None
) -> None:
    database = Database(migrated_postgres, asked_first=False)
    with database.write() as connection:
        connection.exec_driver_sql(
            "DO $$ BEGIN CREATE ROLE nobody_much; EXCEPTION WHEN duplicate_object THEN NULL; END $$"
        )

    def act() -> None:
        with database.write() as connection:
            connection.exec_driver_sql(statement)
            if kind is None:
                for _ in range(400):  # until the server has come to end the session
                    Event().wait(0.3)
                    connection.exec_driver_sql("SELECT 2")

    with pytest.raises(kind or DatabaseAwayError) as told:
        act()
    assert isinstance(told.value, AWAY)
    assert "\n" not in str(told.value)
    with database.write() as connection:
        assert connection.scalar(text("SELECT 1")) == 1
    database.close()


@pytest.mark.postgres
def test_after_one_failure_all_connections_that_were_lost_are_known(migrated_postgres: str) -> None:
    """Each further failure would have the dispatcher wait for longer, with a server that has long been back."""
    database, admin = Database(migrated_postgres, asked_first=False), Database(migrated_postgres, pooled=False)
    for first, then in ((database.read, database.write), (database.write, database.read)):
        for transaction in (database.read, database.write):
            with transaction() as connection:
                connection.execute(text("SELECT 1"))
        with admin.write() as connection:
            others = "SELECT pg_terminate_backend(pid, 5000) FROM pg_stat_activity WHERE datname = current_database()"
            connection.exec_driver_sql(f"{others} AND pid <> pg_backend_pid()")
        with pytest.raises(DatabaseAwayError), first() as connection:
            connection.execute(text("SELECT 1"))
        with then() as connection:
            assert connection.scalar(text("SELECT 1")) == 1
    database.close()
    admin.close()


@pytest.fixture
def out_of_date(url: str) -> Iterator[str]:
    """A database at a revision before the code's."""
    _set_revision(url, "0001")
    yield url
    _set_revision(url, REVISION)


def _set_revision(url: str, revision: str) -> None:
    database = Database(url, pooled=False)
    with database.write() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = :revision"), {"revision": revision})
    database.close()


def test_the_tables_say_which_revision_they_are() -> None:
    assert revisions()[-1] == REVISION


def test_a_schema_that_is_too_old_is_told_by_readiness_with_what_to_do(out_of_date: str, tmp_path: Path) -> None:
    settings = Settings(database_url=out_of_date, data_dir=tmp_path)
    with TestClient(create_app(settings), raise_server_exceptions=False) as api:
        answer = api.get("/readyz")
        wanted = f"the database's schema is revision 0001, this code needs {REVISION}: run hostlens db upgrade"
        assert (answer.status_code, answer.json()["detail"]) == (503, wanted)
        _set_revision(out_of_date, "9999")
        assert "install the newer hostlens" in api.get("/readyz").json()["detail"]
        _set_revision(out_of_date, REVISION)
        assert api.get("/readyz").status_code == 200


def test_nobody_leads_on_a_schema_that_is_too_old(
    out_of_date: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    database, looks = Database(out_of_date), []

    class Stop(Event):
        def wait(self, timeout: float | None = None) -> bool:
            looks.append(timeout)
            self.set()
            return True

    assert wait_to_lead(database, Settings(database_url=out_of_date, data_dir=tmp_path), Stop()) is None
    assert looks
    assert "run hostlens db upgrade" in caplog.text
    database.close()


def test_a_database_without_tables_says_what_to_do_wherever_it_is_met(
    tmp_path: Path, request: pytest.FixtureRequest, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "empty.sqlite").touch()
    bare = new_database(request.getfixturevalue("postgres_server"), f"bare_{os.getpid()}")
    for url in (f"sqlite:///{tmp_path / 'empty.sqlite'}", bare):
        settings = Settings(database_url=url, data_dir=tmp_path)
        with TestClient(create_app(settings), raise_server_exceptions=False) as api:
            for answer in (api.get("/readyz"), api.get("/v1/grids"), api.post("/v1/grids", json=body(1))):
                assert answer.status_code == 503
                assert answer.json()["detail"] == "the database has no tables of hostlens: run hostlens db upgrade"


@pytest.mark.postgres
def test_a_statement_that_takes_too_long_is_504_and_says_so(migrated_postgres: str, tmp_path: Path) -> None:
    slow = migrated_postgres + "&options=-c%20statement_timeout%3D2000"
    holder = Database(migrated_postgres)
    with TestClient(create_app(Settings(database_url=slow, data_dir=tmp_path)), raise_server_exceptions=False) as api:
        made = api.post("/v1/grids", json=body(1)).json()["id"]
        with holder.write() as connection:
            connection.execute(text("SELECT 1 FROM grid FOR UPDATE"))
            answer = api.post(f"/v1/grids/{made}/cancel")
        assert answer.status_code == 504
        assert "time that it allows" in answer.json()["detail"]
        assert api.post(f"/v1/grids/{made}/cancel").status_code == 200
    holder.close()


@pytest.fixture
def guarded(postgres_server: str) -> str:
    """A database that one user may not enter, and that another may enter without seeing anything; URL with a name."""
    name = f"guarded_{os.getpid()}"
    plain = postgres_server.replace("+psycopg", "")
    with psycopg.connect(plain % "postgres", autocommit=True) as server:
        if server.execute("SELECT 1 FROM pg_database WHERE datname = %s", (name,)).fetchone() is None:
            server.execute(f"CREATE DATABASE {name}")  # type: ignore[call-overload]
            for user in ("shut_out", "sees_nothing"):
                server.execute(f"CREATE ROLE {user} LOGIN")  # type: ignore[call-overload]
            server.execute(f"REVOKE CONNECT ON DATABASE {name} FROM public")  # type: ignore[call-overload]
            server.execute(f"GRANT CONNECT ON DATABASE {name} TO sees_nothing")  # type: ignore[call-overload]
    return (postgres_server % name).replace("hostlens@", "%s:" + OURS + "@")


@pytest.mark.postgres
@pytest.mark.parametrize(
    ("user", "said"),
    [
        ("no_such_user", 'role "no_such_user" does not exist'),
        ("shut_out", "permission denied for database"),
        ("sees_nothing", "permission denied"),
    ],
)
def test_who_is_not_let_in_is_told_so_at_the_start_and_at_run_time_without_the_password(
    guarded: str,
    tmp_path: Path,
    user: str,
    said: str,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    url = guarded % user
    monkeypatch.setenv("HOSTLENS_DATABASE_URL", url)
    monkeypatch.setenv("HOSTLENS_DATA_DIR", str(tmp_path))
    for command in (["db", "upgrade"], ["serve", "--port", str(free_port())]):
        started = [sys.executable, "-m", "service", *command]
        refused = subprocess.run(started, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
        assert refused.returncode != 0
        assert said in refused.stderr
        assert len(refused.stderr.splitlines()) == 1
        assert OURS not in refused.stderr + refused.stdout
    settings = Settings(database_url=url, data_dir=tmp_path)
    with TestClient(create_app(settings), raise_server_exceptions=False) as api:
        answer = api.get("/v1/grids")
    assert answer.status_code == 503
    if user != "sees_nothing":  # there it has no tables, as far as it can see
        assert "does not let this service in" in answer.json()["detail"]
        assert said in caplog.text
    assert OURS not in caplog.text + answer.text


@pytest.mark.postgres
def test_a_password_that_is_changed_under_a_running_service_is_told_as_that_until_it_is_right(
    migrated_postgres: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    admin = Database(migrated_postgres, pooled=False)
    rules = Path(migrated_postgres.rpartition("host=")[2]) / "data" / "pg_hba.conf"
    rules.write_text(f"local all locked_in scram-sha-256\n{rules.read_text()}")
    with admin.write() as connection:
        connection.exec_driver_sql(f"CREATE ROLE locked_in LOGIN SUPERUSER PASSWORD '{OURS}'")
        connection.exec_driver_sql("SELECT pg_reload_conf()")
    url = migrated_postgres.replace("hostlens@", f"locked_in:{OURS}@")
    with TestClient(create_app(Settings(database_url=url, data_dir=tmp_path)), raise_server_exceptions=False) as api:
        eventually(lambda: api.get("/readyz").status_code == 200, what="the reloaded rules")
        for password, status in (("another", 503), (OURS, 200)):
            with admin.write() as connection:
                connection.exec_driver_sql(f"ALTER ROLE locked_in PASSWORD '{password}'")
                connection.exec_driver_sql(
                    "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE usename = 'locked_in'"
                )
            answer = api.get("/v1/grids")
            assert answer.status_code == status
            if status == 503:
                assert "does not let this service in" in answer.json()["detail"]
                assert 'password authentication failed for user "locked_in"' in caplog.text
    assert OURS not in caplog.text
    admin.close()


def test_a_database_that_does_not_exist_is_told_so(postgres_server: str) -> None:
    database = Database(postgres_server % "none_such")
    with pytest.raises(AccessRefusedError, match='database "none_such" does not exist'):
        database.revision()
    database.close()


def test_no_value_of_ours_gets_into_a_log(database: Database, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)

    def break_off(act: Callable[[Any], object]) -> None:
        try:
            with database.write() as connection:
                act(connection)
        except DBAPIError as error:
            log = logging.getLogger("test")
            log.warning("refused: %s", error, exc_info=error)
            log.warning("refused: %s", error.orig)

    row = {"key": OURS, "request_digest": OURS, "grid_id": OURS, "created_at": None}
    break_off(lambda connection: connection.execute(insert(idempotency), row))
    break_off(lambda connection: connection.execute(insert(idempotency), [row, row]))
    break_off(lambda connection: connection.execute(text("SELECT none_such(:value)"), {"value": OURS}))
    if not database.is_sqlite:
        break_off(lambda connection: connection.execute(text("SELECT CAST(:value AS INTEGER)"), {"value": OURS}))
        broken = f'[{{"id": "{OURS}'
        break_off(lambda connection: connection.execute(text("SELECT CAST(:value AS JSON)"), {"value": broken}))
    assert caplog.text.count("refused: ") >= 6
    assert OURS not in caplog.text


def test_what_is_broken_keeps_its_kind(database: Database) -> None:
    row = {"key": "k", "request_digest": "d", "grid_id": "g", "created_at": None}
    with pytest.raises(IntegrityError), database.write() as connection:
        connection.execute(insert(idempotency), row)
    if not database.is_sqlite:
        with pytest.raises(DataError), database.write() as connection:
            connection.execute(text("SELECT 'x'::int"))


def test_a_driver_that_calls_a_limit_operational_does_not_make_it_away(sqlite_url: str) -> None:
    database = Database(sqlite_url)
    with pytest.raises(StatementRefusedError) as told, database.write() as connection:
        connection.exec_driver_sql("SELECT " + ",".join(["?"] * 40_000), tuple(range(40_000)))
    assert isinstance(told.value.orig, sqlite3.OperationalError)
    database.close()
