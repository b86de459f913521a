"""The schema by Alembic: one tree for every database, found in a checkout and in an installed wheel."""

from __future__ import annotations

from pathlib import Path

from alembic import command
from alembic.config import Config
from alembic.util.exc import CommandError

from service.store.database import Database


def migrations_folder() -> Path:
    """Where the migrations lie; FileNotFoundError where the installation lacks them."""
    package = Path(__file__).resolve().parent.parent
    for folder in (package / "migrations", package.parent / "migrations"):
        if (folder / "env.py").is_file():
            return folder
    raise FileNotFoundError(f"no migrations beside {package}")


def upgrade(url: str, revision: str = "head") -> None:
    """Bring the database to ``revision``: idempotent; an empty database gets all tables."""
    _run(url, lambda config: command.upgrade(config, revision))


def downgrade(url: str, revision: str) -> None:
    """Take the database back to ``revision`` (``base`` drops all tables and what is in them)."""
    _run(url, lambda config: command.downgrade(config, revision))


def differences(url: str) -> str | None:
    """What ``alembic check`` finds between the migrated database and the tables in the code; None where they agree."""
    try:
        _run(url, command.check)
    except CommandError as error:
        return str(error)
    return None


def _run(url: str, action: object) -> None:
    if not callable(action):
        raise TypeError(type(action))
    config = Config()
    config.set_main_option("script_location", str(migrations_folder()).replace("%", "%%"))
    # Without foreign keys, or SQLite would see a table that a migration copies as the loss of all that refers to it.
    database = Database(url, pooled=False, foreign_keys=False)
    try:
        # The service's own connection, so that migrations run under the same settings as everything else.
        with database.write() as connection:
            config.attributes["connection"] = connection
            action(config)
            if database.is_sqlite:
                broken = connection.exec_driver_sql("PRAGMA foreign_key_check").all()
                if broken:
                    raise RuntimeError(f"the migration would leave rows that refer to nothing: {broken[:5]}")
    finally:
        database.close()
