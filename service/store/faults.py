"""What an error of the database means: that it is away, or that it refuses what it was given. Judged here alone."""

from __future__ import annotations

import re
import sqlite3
from typing import Any

from sqlalchemy.engine import ExceptionContext
from sqlalchemy.exc import DatabaseError, InterfaceError, InternalError, OperationalError


class DatabaseAwayError(OperationalError):
    """The database cannot serve now: not the fault of what was asked, and a later try may succeed.

    Its text is one line that holds neither values nor a password.
    """

    def __init__(self, reason: str, orig: BaseException, *, invalidated: bool = False) -> None:
        super().__init__(None, None, orig, hide_parameters=True, connection_invalidated=invalidated)
        self.reason = reason

    def __str__(self) -> str:
        return self.reason


class StatementTooLongError(DatabaseAwayError):
    """A statement took longer than the database lets it (``statement_timeout``)."""


class SchemaMismatchError(DatabaseAwayError):
    """The database lacks tables or columns that this code needs, or is at another revision."""


class AccessRefusedError(DatabaseAwayError):
    """Wrong user or password, no such database, or not allowed to do this there."""


class StatementRefusedError(DatabaseError):
    """The database refuses a statement for what it is, though its driver calls that operational."""


class MigrationError(RuntimeError):
    """The schema cannot be brought to where it was asked to be; nothing has been changed."""


AWAY = (OperationalError, InterfaceError, InternalError)
"""What :func:`translate` leaves of these means that the database cannot serve now."""

# Classes of SQLSTATE (PostgreSQL, appendix A): connection, invalid transaction state, prepared statement or cursor of a
# session that is no longer ours, rolled back, out of resources, not in the right state (locks), operator, system,
# configuration, internal. Left out is 54, a limit of the program, which the statement would meet again and again.
_AWAY_CLASSES = frozenset({"08", "25", "26", "34", "40", "53", "55", "57", "58", "F0", "XX"})
_DUPLICATE_PREPARED = "42P05"
_KINDS: dict[str, type[DatabaseAwayError]] = {
    _DUPLICATE_PREPARED: DatabaseAwayError,
    "57014": StatementTooLongError,
    # Undefined table, column, schema, type.
    **dict.fromkeys(("42P01", "42703", "3F000", "42704"), SchemaMismatchError),
    # Not let in, no such database, not allowed.
    **dict.fromkeys(("28000", "28P01", "3D000", "42501"), AccessRefusedError),
}
# Before there is a session the driver hands on no code, only the text of server or pooler.
_ACCESS_TEXT = re.compile(
    r"password authentication failed|authentication failed|no password supplied|no pg_hba\.conf entry|no such database"
    r"|no such user|(role|database) \"[^\"]*\" does not exist|permission denied for database|is not permitted to log in"
)
_SQLITE_SCHEMA = re.compile(r"no such (table|column)|has no column named")
_SQLITE_REOPENED = frozenset(
    {
        sqlite3.SQLITE_READONLY, sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_CANTOPEN,
        sqlite3.SQLITE_NOTADB,
    }
)  # fmt: skip
# Without room for a write a connection still reads, and a new one could not be opened: SQLite writes for that too.
_SQLITE_NO_ROOM = frozenset(
    {
        sqlite3.SQLITE_IOERR_WRITE, sqlite3.SQLITE_IOERR_FSYNC, sqlite3.SQLITE_IOERR_TRUNCATE,
        sqlite3.SQLITE_IOERR_SHMSIZE,
    }
)  # fmt: skip
_SQLITE_AWAY = frozenset(
    {
        sqlite3.SQLITE_PERM, sqlite3.SQLITE_ABORT, sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED, sqlite3.SQLITE_NOMEM,
        sqlite3.SQLITE_READONLY, sqlite3.SQLITE_INTERRUPT, sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CORRUPT,
        sqlite3.SQLITE_FULL, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_PROTOCOL, sqlite3.SQLITE_SCHEMA,
        sqlite3.SQLITE_AUTH, sqlite3.SQLITE_NOTADB,
    }
)  # fmt: skip


def translate(context: ExceptionContext) -> BaseException | None:
    """As SQLAlchemy's event ``handle_error``: the error that is raised instead, None for SQLAlchemy's own.

    Texts of the server lose what may be values of ours: the detail of a broken constraint, an input that is no number.
    """
    if context.is_pre_ping or context.sqlalchemy_exception is None:
        return None
    orig, wrapped = context.original_exception, context.sqlalchemy_exception
    line = one_line(orig)
    if getattr(orig, "sqlstate", None) is not None:
        orig.args = (line,)
        name = f"{type(orig).__module__}.{type(orig).__name__}"
        wrapped.args = (f"({name}) {line}",)
    kind = _judge(orig, operational=isinstance(wrapped, AWAY))
    if kind is not None:
        if _lost_session(orig):
            context.is_disconnect = True
        return kind(line, orig, invalidated=context.is_disconnect)
    if isinstance(wrapped, AWAY):
        return StatementRefusedError(context.statement, None, orig, hide_parameters=True)
    return None


def one_line(error: BaseException) -> str:
    """What a database says, in one line and without values."""
    sqlstate, diagnosis = getattr(error, "sqlstate", None), getattr(error, "diag", None)
    if sqlstate is None:
        return " ".join(str(error).split())
    # Messages of class 22 quote the input that is no number, date or text.
    primary = None if sqlstate.startswith("22") or diagnosis is None else diagnosis.message_primary
    return f"{primary or type(error).__name__} ({sqlstate})"


def _judge(orig: BaseException, *, operational: bool) -> type[DatabaseAwayError] | None:
    """The kind of being away, None for what is refused for what it is."""
    if isinstance(orig, sqlite3.Error):
        return _judge_sqlite(orig, operational=operational)
    sqlstate: Any = getattr(orig, "sqlstate", None)
    if sqlstate is not None:
        return _KINDS.get(sqlstate, DatabaseAwayError if sqlstate[:2] in _AWAY_CLASSES else None)
    if not operational:
        return None
    return AccessRefusedError if _ACCESS_TEXT.search(str(orig)) else DatabaseAwayError


def _judge_sqlite(orig: sqlite3.Error, *, operational: bool) -> type[DatabaseAwayError] | None:
    code = getattr(orig, "sqlite_errorcode", None)
    if code is None:
        return DatabaseAwayError if operational else None
    # The lowest byte is the error, those above say which kind of it.
    if code & 0xFF in _SQLITE_AWAY:
        return DatabaseAwayError
    return SchemaMismatchError if _SQLITE_SCHEMA.search(str(orig)) else None


def _lost_session(orig: BaseException) -> bool:
    """Whether the connection is of no more use, though its driver may think otherwise."""
    if isinstance(orig, sqlite3.Error):
        # One that was opened while the file was read-only stays so, whatever becomes of the file.
        code = getattr(orig, "sqlite_errorcode", 0)
        return code & 0xFF in _SQLITE_REOPENED and code not in _SQLITE_NO_ROOM
    sqlstate: Any = getattr(orig, "sqlstate", None) or ""
    return sqlstate[:2] in {"08", "26", "34"} or sqlstate in {_DUPLICATE_PREPARED, "25P03", "57P01", "57P02", "57P05"}
