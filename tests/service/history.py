"""Rows as they stood in a database of any revision, for the tests of migrations."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any

from sqlalchemy import JSON, Boolean, Connection, DateTime, Float, Integer, MetaData, Table, func, inspect, select
from sqlalchemy.sql.sqltypes import LargeBinary

from service.domain.access import Scope
from service.store.database import Database
from service.store.grids import GridStore
from service.store.leadership import Leadership
from service.store.leases import Outcome
from service.store.queue import Failure, RunQueue
from service.store.tables import metadata
from service.store.tokens import TokenStore
from tests.service.conftest import Clock
from tests.service.plans import body, planned, result_of, submit, until

Rows = dict[str, list[dict[str, Any]]]


def live(database: Database) -> None:
    """Let the service do what it does: a row in every table, a run and a grid in every state."""
    clock = Clock()
    grids = GridStore(database, clock)
    queue = RunQueue(database, clock, retry_delay_s=1.0)
    leadership = Leadership(database, clock=clock)
    generation = leadership.take("here|1|1.00")
    assert generation == 1

    def step() -> list[Any]:
        clock.advance(60)
        return queue.claim(generation, 100)

    TokenStore(database, clock).create("somebody", Scope.SUBMIT)
    # No three replicates are known so well.
    rule = until(1e-6, at_most=3)
    grids.create(body(3, 1), lambda: planned(3, 1), "three of one kind", "key-1", owner="somebody", until=rule)
    for lease in step():
        queue.store(lease, result_of(lease))
    queue.store(lease, result_of(lease))  # too late, and on record as such
    submit(grids, 1, seed=5)
    (alone,) = step()
    queue.fail(alone, Failure(Outcome.DEADLINE, "deadline", "not done within 1 s", 0))
    submit(grids, 3, seed=10)
    failed, killed, later = step()
    queue.fail(failed, Failure(Outcome.ERROR, "error", "ValueError: \u03b8_E", 0))
    queue.fail(killed, Failure(Outcome.WORKER_LOST, "worker_lost", "died", 0, suspect=True))
    queue.fail(later, Failure(Outcome.ERROR, "error", "try again", 2))
    submit(grids, 2, seed=20)
    taken = step()
    grids.cancel(taken[-1].grid_id)
    queue.cancel_leased(taken[-1])
    queue.hand_back(taken[:-1])
    submit(grids, 2, seed=30)
    clock.advance(60)
    queue.claim(generation, 1)
    leadership.beat(generation, {"0" * 64: 2})


def read(connection: Connection) -> Rows:
    """Every row of every table, by the names and in the form that the database itself gives.

    Nothing is made of it: to have SQLAlchemy reflect the tables takes longer than a migration.
    """
    return {
        name: in_order([dict(row._mapping) for row in connection.exec_driver_sql(f'SELECT * FROM "{name}"')])  # noqa: S608 - our own names
        for name in inspect(connection).get_table_names()
        if name != "alembic_version"
    }


def in_order(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows have no order of their own; one that depends on nothing but what is in them."""
    return sorted(rows, key=lambda row: str(sorted(row.items())))


def reflected(connection: Connection) -> list[Table]:
    """The tables as the database has them, referred ones first."""
    found = MetaData()
    found.reflect(connection)
    return [table for table in found.sorted_tables if table.name != "alembic_version"]


def typed(connection: Connection) -> Rows:
    """Every row of a database of the newest revision, with the code's own types."""
    return {
        table.name: [dict(row._mapping) for row in connection.execute(select(table))]
        for table in metadata.sorted_tables
    }


def write(connection: Connection, rows: Rows) -> None:
    """Put ``rows`` of the newest revision into the tables of whatever revision the database is at.

    Columns that have gone since then are made up, and so is a row for a table that has; both by their types. What the
    database numbers by itself it numbers here too, or its next number would be one that is taken.
    """
    for table in reflected(connection):
        for row in rows.get(table.name) or [{}]:
            values = {
                column.name: row[column.name] if column.name in row else _made_up(connection, column)
                for column in table.columns
                if column.autoincrement is not True
                # What is null is left out: a reflected JSON column would make a JSON null of it.
                and (row.get(column.name) is not None or not (column.nullable or column.server_default is not None))
            }
            connection.execute(table.insert(), values)


def _made_up(connection: Connection, column: Any) -> Any:
    for key in column.foreign_keys:
        return connection.scalar(select(func.min(key.column)))
    samples = (
        (JSON, {"made": "up"}),
        (DateTime, datetime(2026, 1, 1, tzinfo=UTC) + timedelta(hours=1)),
        (Boolean, False),
        (Float, 1.5),
        (Integer, 1),
        (LargeBinary, b"made up"),
    )
    return next((value for kind, value in samples if isinstance(column.type, kind)), "made up")
