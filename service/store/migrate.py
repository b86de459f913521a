"""The schema by Alembic: one tree for every database, found in a checkout and in an installed wheel."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

from alembic import command
from alembic.config import Config
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from alembic.util.exc import CommandError
from sqlalchemy import Connection, text

from service.store.database import Database
from service.store.faults import MigrationError, SchemaMismatchError

# Any number that no other program on the same database takes for its own advisory lock.
_LOCK = 4_650_048_421


def migrations_folder() -> Path:
    """Where the migrations lie; FileNotFoundError where the installation lacks them."""
    package = Path(__file__).resolve().parent.parent
    for folder in (package / "migrations", package.parent / "migrations"):
        if (folder / "env.py").is_file():
            return folder
    raise FileNotFoundError(f"no migrations beside {package}")


def revisions(folder: Path | None = None) -> tuple[str, ...]:
    """Every revision of the tree, oldest first; the last is the one that the code expects."""
    walked = ScriptDirectory.from_config(_config(folder)).walk_revisions()
    return tuple(reversed([script.revision for script in walked]))


def current(url: str) -> str | None:
    """The revision that a database is at, None for one without tables; also one that this code does not know."""
    database = Database(url, pooled=False)
    try:
        return database.revision()
    finally:
        database.close()


def upgrade(url: str, revision: str = "head", folder: Path | None = None) -> None:
    """Bring the database to ``revision``: idempotent; an empty database gets all tables.

    One transaction, and one process at a time: every process of an installation may do this when it starts.

    Raises
    ------
    MigrationError
        A migration does not know the revision, or would leave rows that refer to nothing.
    """
    _run(url, lambda config: command.upgrade(config, revision), folder, create=True)


def downgrade(url: str, revision: str, folder: Path | None = None) -> None:
    """Take the database back to ``revision`` (``base`` drops all tables and what is in them); as :func:`upgrade`."""
    _run(url, lambda config: command.downgrade(config, revision), folder)


def differences(url: str) -> str | None:
    """What ``alembic check`` finds between the migrated database and the tables in the code; None where they agree."""
    database = Database(url, pooled=False)
    try:
        database.require_schema()
        _run(url, command.check)
    except (MigrationError, SchemaMismatchError) as error:
        return str(error)
    finally:
        database.close()
    return None


def _config(folder: Path | None) -> Config:
    config = Config(stdout=io.StringIO())
    config.set_main_option("script_location", str(folder or migrations_folder()).replace("%", "%%"))
    return config


def _run(url: str, action: Callable[[Config], object], folder: Path | None = None, *, create: bool = False) -> None:
    config = _config(folder)
    # Without foreign keys, or SQLite would see a table that a migration copies as the loss of all that refers to it;
    # the check before the commit makes up for them.
    database = Database(url, pooled=False, foreign_keys=False, create=create)
    try:
        # The service's own connection, so that migrations run under the same settings as everything else.
        with database.write() as connection:
            if not database.is_sqlite:
                connection.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": _LOCK})
            config.attributes["connection"] = connection
            before = MigrationContext.configure(connection).get_current_revision()
            action(config)
            moved = MigrationContext.configure(connection).get_current_revision() != before
            if moved and database.is_sqlite:
                _require_references(connection)
    except CommandError as error:
        raise MigrationError(str(error)) from error
    finally:
        database.close()


def _require_references(connection: Connection) -> None:
    broken = connection.exec_driver_sql("PRAGMA foreign_key_check").all()
    if broken:
        table, _, other, _ = broken[0]
        raise MigrationError(f"{len(broken)} rows would refer to nothing, the first in {table} to {other}")
