"""The file of the embedded database: opened, never made anew by the way, and watched for being taken away."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping
from contextlib import closing, suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlencode

from sqlalchemy.exc import InvalidatePoolError

from service.store.faults import DatabaseAwayError

_BUSY_TIMEOUT_S = 30.0
LOG_LIMIT = 64 * 2**20
"""Beyond so many bytes the write-ahead log is cut as soon as no reader needs it."""
_BRIEFLY_MS = 250
_FILES = "hostlens_files"

Identity = tuple[int, int] | None


class SqliteFile:
    """One database file as one process knows it.

    SQLite goes on for ever in a file that was deleted, moved or replaced, and what it writes there is lost: so the
    path is compared with what a connection has open, at each checkout and after each commit. Another file under the
    same name is refused as long as this process lives, since it would be read through the old file's log.
    """

    def __init__(self, path: Path, options: Mapping[str, str], *, create: bool) -> None:
        self.path = path
        self._log = path.with_name(f"{path.name}-wal")
        self._index = path.with_name(f"{path.name}-shm")
        mode = {"mode": "rwc" if create else "rw", **options}
        self._create = create
        self._uri = f"file:{quote(str(path))}?{urlencode(mode)}"
        self._known: Identity = None

    def connect(self) -> sqlite3.Connection:
        """Open it; a DatabaseAwayError where it is not there, or is no longer the file that this process knows."""
        before = _identity(self.path)
        try:
            # Transactions are begun by whoever uses it: the driver's own BEGIN comes late and is deferred.
            connection = sqlite3.connect(
                self._uri, uri=True, timeout=_BUSY_TIMEOUT_S, isolation_level=None, check_same_thread=False
            )
        except sqlite3.Error as error:
            missing = before is None and not self._create
            reason = f"there is no database file {self.path}" if missing else f"{error}: {self.path}"
            raise DatabaseAwayError(reason, error) from None
        now = _identity(self.path)
        if now is None or (before or now) != now or (self._known or now) != now:
            connection.close()
            reason = f"the database file {self.path} is not the one that was opened: put that back, or restart hostlens"
            raise DatabaseAwayError(reason, FileNotFoundError(reason))
        try:
            self._prepare(connection)
        except sqlite3.Error as error:
            connection.close()
            raise DatabaseAwayError(f"{error}: {self.path}", error) from None
        self._known = now
        return connection

    def _prepare(self, connection: sqlite3.Connection) -> None:
        connection.execute("PRAGMA journal_mode = WAL")
        # FULL, not NORMAL: an accepted grid (202) must survive a power failure, not only a crash of the process.
        connection.execute("PRAGMA synchronous = FULL")
        connection.execute(f"PRAGMA journal_size_limit = {LOG_LIMIT}")
        # Opens the log, if nothing has yet.
        connection.execute("SELECT 1 FROM sqlite_master LIMIT 1").fetchall()

    def opened(self, _connection: Any, record: Any) -> None:
        """Remember which files a connection has open; as SQLAlchemy's pool event ``connect``."""
        record.info[_FILES] = self._identities()

    def checked_out(self, connection: Any, record: Any, _proxy: Any) -> None:
        """Compare before use; as the pool's event ``checkout``: without its files a connection is replaced."""
        if self._identities() != record.info[_FILES]:
            self._rescue(connection)
            raise InvalidatePoolError(f"{self.path} has been moved, removed or replaced")

    def require_written(self, connection: Any, info: Mapping[Any, Any]) -> None:
        """Compare after a commit; a DatabaseAwayError where it went into a file that is no longer there."""
        if self._identities() != info[_FILES]:
            self._rescue(connection)
            reason = f"the database file {self.path}, or its log, was taken away while it was written"
            raise DatabaseAwayError(reason, FileNotFoundError(reason), invalidated=True)

    def log_bytes(self) -> int:
        """Size of the write-ahead log."""
        try:
            return self._log.stat().st_size
        except OSError:
            return 0

    def cut_log(self) -> None:
        """Write a long log back and cut it, unless a reader needs it for longer than writers may be kept waiting.

        SQLite does so by itself only in a moment without any reader, and there may never be one.
        """
        if self.log_bytes() <= LOG_LIMIT:
            return
        with closing(self.connect()) as connection:
            try:
                connection.execute(f"PRAGMA busy_timeout = {_BRIEFLY_MS}")
                connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
            except sqlite3.Error as error:
                raise DatabaseAwayError(f"{error}: {self._log}", error) from None

    def _identities(self) -> tuple[Identity, ...]:
        return _identity(self.path), _identity(self._log), _identity(self._index)

    @staticmethod
    def _rescue(connection: Any) -> None:
        """Write what the log holds into the file that belongs to it, and leave an empty one.

        Found later beside another file, a log would be taken for that one's and destroy it.
        """
        with suppress(sqlite3.Error):
            connection.execute(f"PRAGMA busy_timeout = {_BRIEFLY_MS}")
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()


def _identity(path: Path) -> Identity:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino
