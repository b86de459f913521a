"""Engines and transactions for SQLite and PostgreSQL, with the settings that the queue's promises rest on."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from pydantic_core import from_json, to_json
from sqlalchemy import Connection, Engine, create_engine, event
from sqlalchemy.engine import make_url
from sqlalchemy.exc import InterfaceError, InternalError, OperationalError
from sqlalchemy.pool import NullPool

BUSY_TIMEOUT_MS = 30_000
_NETWORK = {
    "connect_timeout": 5,
    # A server whose machine is gone says nothing more: after half a minute without an answer to what was sent, or to
    # three questions whether it is there, it is taken for away. The system's own patience is up to two hours.
    "keepalives_idle": 10,
    "keepalives_interval": 5,
    "keepalives_count": 3,
    "tcp_user_timeout": 30_000,
}
AWAY = (OperationalError, InterfaceError, InternalError)
"""The database cannot be written now: none of it is the fault of what was to be written, and a later try may succeed.

The last is what a server says that has become a read-only replica.
"""


class Database:
    """A database and its two kinds of transaction.

    On SQLite ``write`` begins IMMEDIATE: a transaction that reads first and then wants to write fails at once when
    another writer was there in between, whatever the busy timeout; one that waits for its turn at the beginning
    does not. ``read`` stays deferred, so that readers never wait (the journal is a WAL). ``foreign_keys`` is only ever
    turned off by migrations, which replace tables that others refer to. A connection is ``asked_first`` whether it is
    still there, except by who tries again anyway.
    """

    def __init__(self, url: str, *, pooled: bool = True, asked_first: bool = True, foreign_keys: bool = True) -> None:
        self.url = make_url(url)
        if self.url.drivername in {"postgresql", "postgres"}:
            self.url = self.url.set(drivername="postgresql+psycopg")
        options: dict[str, Any] = {"pool_pre_ping": asked_first} if pooled else {"poolclass": NullPool}
        if self.is_sqlite:
            options["connect_args"] = {"timeout": BUSY_TIMEOUT_MS / 1000}
        else:
            # What the URL says itself goes before.
            options["connect_args"] = {name: value for name, value in _NETWORK.items() if name not in self.url.query}
        self.engine: Engine = create_engine(self.url, json_serializer=_to_json, json_deserializer=from_json, **options)
        if self.is_sqlite:
            event.listen(self.engine, "connect", _prepare_sqlite)
            if foreign_keys:
                event.listen(self.engine, "connect", _enforce_foreign_keys)
            event.listen(self.engine, "begin", _begin_sqlite)
        self._writer = self.engine.execution_options(hostlens_write=True)

    @property
    def is_sqlite(self) -> bool:
        """Whether this is the embedded database."""
        return self.url.get_backend_name() == "sqlite"

    @contextmanager
    def read(self) -> Iterator[Connection]:
        """A transaction that only reads: one consistent picture on SQLite."""
        with self.engine.begin() as connection:
            yield connection

    @contextmanager
    def write(self) -> Iterator[Connection]:
        """A transaction that may write: committed as a whole or not at all."""
        with self._writer.begin() as connection:
            yield connection

    def close(self) -> None:
        """Close all pooled connections."""
        self.engine.dispose()


def _to_json(value: Any) -> str:
    # A grid of 100,000 runs has 200,000 documents, which the standard library takes four times as long for.
    return to_json(value).decode()


def _prepare_sqlite(connection: Any, _record: Any) -> None:
    # The driver's own BEGIN comes late and is deferred; _begin_sqlite says it instead.
    connection.isolation_level = None
    cursor = connection.cursor()
    cursor.execute(f"PRAGMA busy_timeout = {BUSY_TIMEOUT_MS}")
    cursor.execute("PRAGMA journal_mode = WAL")
    # FULL, not NORMAL: an accepted grid (202) must survive a power failure, not only a crash of the process.
    cursor.execute("PRAGMA synchronous = FULL")
    cursor.close()


def _enforce_foreign_keys(connection: Any, _record: Any) -> None:
    cursor = connection.cursor()
    cursor.execute("PRAGMA foreign_keys = ON")
    cursor.close()


def _begin_sqlite(connection: Connection) -> None:
    writes = connection.get_execution_options().get("hostlens_write", False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")
