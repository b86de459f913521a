"""What every drill is: sizes, a place to take place in, and a report."""

from __future__ import annotations

import tempfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, Self

from service.store.database import Database
from service.store.grids import GridStore
from service.store.migrate import upgrade
from tests.drills.installation import DrillError
from tests.drills.postgres import PostgresServer, postgres_server
from tests.drills.report import Report

BODY: dict[str, Any] = {
    "preset": "h0licow-vi/HE0435", "n": [2], "magnitude": [20.5], "l_eta": [1.0], "r_eff": [0.39],
}  # fmt: skip


def body(runs: int, seed: int = 0) -> dict[str, Any]:
    """A request for ``runs`` runs of one input, which differ in their seed."""
    return {**BODY, "replicates": runs, "seed": seed}


@dataclass(frozen=True)
class Ground:
    """Where a drill takes place: a folder, and a database elsewhere if it is not to be a SQLite file there.

    ``server`` is that of the database where it was started for the drill.
    """

    folder: Path
    database_url: str | None = None
    server: PostgresServer | None = None

    @property
    def settings(self) -> dict[str, str]:
        """The database as the service's settings."""
        return {} if self.database_url is None else {"HOSTLENS_DATABASE_URL": self.database_url}

    @property
    def backend(self) -> str:
        """The kind of database, for the report."""
        return "SQLite" if self.database_url is None or self.database_url.startswith("sqlite") else "PostgreSQL"

    @property
    def owns_database(self) -> bool:
        """Whether the database is no process that was there before the drill."""
        return self.backend == "SQLite" or self.server is not None


class SizeError(ValueError):
    """A drill has no such size, or the size is not one."""


class OccupiedError(ValueError):
    """A drill was pointed at a database that holds somebody's grids."""


_MOST = 10_000_000
THROW_AWAY = "postgresql"
"""Instead of a database's URL: a PostgreSQL server that is started for the drill and leaves nothing."""


@contextmanager
def ground(database_url: str | None = None) -> Iterator[Ground]:
    """A temporary place; with ``postgresql`` as the database a server of its own is part of it.

    Raises
    ------
    OccupiedError
        The database holds grids: a drill kills what it finds, so it wants one of its own.
    tests.drills.installation.DrillError
        There is no PostgreSQL to start, or no driver for it.
    """
    with ExitStack() as stack:
        server = stack.enter_context(postgres_server()) if database_url == THROW_AWAY else None
        url = database_url if server is None else server.create("drill")
        if url is not None:
            _prepare(url)
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="hostlens-drill-", ignore_cleanup_errors=True))
        yield Ground(Path(folder), url, server)


def _prepare(url: str) -> None:
    try:
        upgrade(url)
    except ModuleNotFoundError as error:
        raise DrillError(f"{url.partition(':')[0]} needs hostlens with its extra postgres: {error}") from error
    with closing(Database(url, pooled=False)) as database:
        if GridStore(database).grids(1).items:
            raise OccupiedError(f"the database {database.url} holds grids; a drill needs an empty one")


class Drill(ABC):
    """One drill; its fields are its sizes, and the defaults those that the documentation speaks of."""

    name: ClassVar[str]
    what: ClassVar[str]
    """What is done to the service, for the list."""
    claim: ClassVar[str]
    """What must hold, for the list."""
    small: ClassVar[dict[str, Any]] = {}
    """Sizes that take seconds."""

    @abstractmethod
    def run(self, ground: Ground) -> Report:
        """Carry it out; a DrillError where that is not possible."""

    @classmethod
    def sized(cls, changes: dict[str, str], *, small: bool) -> Self:
        """A drill with its default or small sizes and with some of them changed; a SizeError names what is wrong."""
        known = {field.name: field for field in fields(cls)}  # type: ignore[arg-type]
        sizes: dict[str, Any] = dict(cls.small) if small else {}
        for name, value in changes.items():
            if name not in known:
                raise SizeError(f"drill {cls.name} has no size {name}: it has {', '.join(known) or 'none'}")
            kind: Callable[[str], Any] = type(known[name].default)
            try:
                sizes[name] = kind(value)
            except ValueError:
                raise SizeError(f"{name}: got {value!r}, allowed is a number") from None
            least = 1 if kind is int and known[name].default else 0
            if not least <= sizes[name] <= _MOST:
                raise SizeError(f"{name}: got {value!r}, allowed is a number from {least} to {_MOST:g}")
        return cls(**sizes)
