"""Engines and transactions for SQLite and PostgreSQL, with the settings that the queue's promises rest on."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Iterator
from contextlib import contextmanager
from threading import BoundedSemaphore
from typing import Any

from pydantic_core import from_json, to_json
from sqlalchemy import Connection, Engine, create_engine, event, text
from sqlalchemy.engine import ExceptionContext
from sqlalchemy.exc import TimeoutError as PoolTimeoutError
from sqlalchemy.pool import NullPool

from service.store.address import SqliteAddress, read_address
from service.store.faults import AWAY, DatabaseAwayError, SchemaMismatchError, translate
from service.store.sqlite_file import SqliteFile
from service.store.tables import REVISION

__all__ = ["AWAY", "Database"]

_READING, _WRITING = {"pool_size": 5, "max_overflow": 10}, {"pool_size": 5, "max_overflow": 5}
_MAX_WRITERS = 24
"""Threads that may wait to write, of the forty that serve requests: the others are for those who read."""
_STUCK_S = 1.0


class Database:
    """A database and its two kinds of transaction, each with a pool of its own: who reads never waits for who writes.

    On SQLite ``write`` begins IMMEDIATE: a transaction that reads first and then wants to write fails at once when
    another writer was there in between, whatever the busy timeout; one that waits for its turn at the beginning
    does not. ``read`` stays deferred, so that readers never wait (the journal is a WAL). ``foreign_keys`` is only ever
    turned off by migrations, which replace tables that others refer to, and only an upgrade may ``create`` the file.
    A connection is ``asked_first`` whether it is still there, except by who tries again anyway.

    On PostgreSQL nothing is left in a session between two transactions, so a pooler may hand each to another.
    """

    def __init__(
        self,
        url: str,
        *,
        pooled: bool = True,
        asked_first: bool = True,
        foreign_keys: bool = True,
        create: bool = False,
    ) -> None:
        self._address = read_address(url)
        self.url = self._address.url
        """Without password and options."""
        self._file: SqliteFile | None = None
        if isinstance(self._address, SqliteAddress):
            self._file = SqliteFile(self._address.file, self._address.options, create=create)
        self._pooling: dict[str, Any] = {"pool_pre_ping": asked_first} if pooled else {"poolclass": NullPool}
        self._foreign_keys = foreign_keys
        self.engine = self._make_engine({**self._pooling, **(_WRITING if pooled else {})}, writes=True)
        self.reader = self._make_engine({**self._pooling, **(_READING if pooled else {})}, writes=False)
        self._writers = BoundedSemaphore(_MAX_WRITERS)
        self._moved = 0.0
        """When a writer last came to its turn or ended."""

    @property
    def is_sqlite(self) -> bool:
        """Whether this is the embedded database."""
        return self._file is not None

    @contextmanager
    def read(self) -> Iterator[Connection]:
        """A transaction that only reads: one consistent picture of the database, from its first statement on."""
        with self._told(), self.reader.begin() as connection:
            yield connection

    @contextmanager
    def write(self) -> Iterator[Connection]:
        """A transaction that may write: committed as a whole or not at all."""
        with self._told(), self._turn(), self.engine.connect() as connection:
            with connection.begin():
                yield connection
            if self._file is not None:
                self._file.require_written(connection.connection.driver_connection, connection.info)

    def revision(self) -> str | None:
        """The revision of the schema, None where there is none."""
        try:
            with self.reader.begin() as connection:
                found: str | None = connection.scalar(text("SELECT version_num FROM alembic_version"))
                return found
        except SchemaMismatchError:
            return None

    def require_schema(self) -> None:
        """Let only the schema pass that this code was written for; a SchemaMismatchError says what to do."""
        found = self.revision()
        if found != REVISION:
            raise SchemaMismatchError(_mismatch(found), LookupError(found))

    def log_bytes(self) -> int:
        """Size of SQLite's write-ahead log, 0 elsewhere."""
        return 0 if self._file is None else self._file.log_bytes()

    def cut_log(self) -> None:
        """Cut SQLite's write-ahead log where it has grown long and no reader needs it; do nothing elsewhere."""
        if self._file is not None:
            self._file.cut_log()

    def close(self) -> None:
        """Close all pooled connections."""
        self.engine.dispose()
        self.reader.dispose()

    def _make_engine(self, options: dict[str, Any], *, writes: bool) -> Engine:
        common: dict[str, Any] = {"json_serializer": _to_json, "json_deserializer": from_json, "hide_parameters": True}
        if self._file is None:
            # Statements that the server has prepared belong to a session, and a pooler hands out another each time.
            arguments = {**self._address.options, "prepare_threshold": None}
            engine = create_engine(
                "postgresql+psycopg://", connect_args=arguments, use_native_hstore=False, **common, **options
            )
            if not writes:
                event.listen(engine, "connect", _read_one_picture)
        else:
            engine = create_engine(self.url, creator=self._file.connect, **common, **options)
            if not writes:
                event.listen(engine, "connect", _refuse_writes)
            if self._foreign_keys:
                event.listen(engine, "connect", _enforce_foreign_keys)
            event.listen(engine, "connect", self._file.opened)
            event.listen(engine, "checkout", self._file.checked_out)
            event.listen(engine, "begin", _begin_immediate if writes else _begin_deferred)
        event.listen(engine, "handle_error", translate)
        event.listen(engine, "handle_error", self._lose_others)
        return engine

    def _lose_others(self, context: ExceptionContext) -> None:
        """Where one pool has lost a connection, close what waits in the other: most likely that is lost too.

        Else a server that is back is met with a dead connection by the first who writes, and is taken for away again.
        """
        if context.is_disconnect and not context.is_pre_ping:
            (self.reader if context.engine is self.engine else self.engine).dispose()

    @contextmanager
    def _turn(self) -> Iterator[None]:
        """Wait to write with others, but not behind many of whom none comes to an end."""
        while not self._writers.acquire(timeout=_STUCK_S / 4):
            if time.monotonic() - self._moved > _STUCK_S:
                reason = f"{_MAX_WRITERS} others wait to write, and none of them gets on"
                raise DatabaseAwayError(reason, TimeoutError(reason))
        self._moved = time.monotonic()
        try:
            yield
        finally:
            self._moved = time.monotonic()
            self._writers.release()

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Say of some errors what they mean here."""
        try:
            yield
        except PoolTimeoutError as error:
            raise DatabaseAwayError("no connection to the database has become free for 30 s", error) from error
        except SchemaMismatchError as error:
            found = self.revision()
            reason = _mismatch(found) if found != REVISION else f"the schema, revision {found}, is damaged: {error}"
            raise SchemaMismatchError(reason, error) from error


def is_at_head(url: str) -> bool:
    """Whether a database has the schema that this code was written for; a file that is missing is made."""
    database = Database(url, pooled=False, create=True)
    try:
        return database.revision() == REVISION
    finally:
        database.close()


def _mismatch(found: str | None) -> str:
    if found is None:
        return "the database has no tables of hostlens: run hostlens db upgrade"
    told = f"the database's schema is revision {found}, this code needs {REVISION}"
    return f"{told}: run hostlens db upgrade" if found < REVISION else f"{told}: install the newer hostlens"


def _to_json(value: Any) -> str:
    # A grid of 100,000 runs has 200,000 documents, which the standard library takes four times as long for.
    return to_json(value).decode()


def _read_one_picture(connection: Any, _record: Any) -> None:
    # Attributes of the driver, which says them in each BEGIN: nothing is set in the session.
    from psycopg import IsolationLevel  # noqa: PLC0415 - an extra

    connection.isolation_level = IsolationLevel.REPEATABLE_READ
    connection.read_only = True


def _refuse_writes(connection: sqlite3.Connection, _record: Any) -> None:
    connection.execute("PRAGMA query_only = ON")


def _enforce_foreign_keys(connection: sqlite3.Connection, _record: Any) -> None:
    connection.execute("PRAGMA foreign_keys = ON")


def _begin_immediate(connection: Connection) -> None:
    connection.exec_driver_sql("BEGIN IMMEDIATE")


def _begin_deferred(connection: Connection) -> None:
    connection.exec_driver_sql("BEGIN")
