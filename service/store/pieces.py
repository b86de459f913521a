"""What concerns very many runs is done in pieces, each a transaction of its own, so that nobody waits for all of it."""

from __future__ import annotations

import time

from sqlalchemy import ColumnElement

from service.store.database import Database
from service.store.tables import run

PIECE = 2000
"""Places of a grid that one transaction goes through: some 0.1 s of work."""
_TURN_S = 0.1
"""SQLite's writers form no line: each looks by itself whether it may write, and sleeps up to 0.1 s in between."""


def places(grid_id: str, first: int) -> ColumnElement[bool]:
    """The runs of the piece of a grid that begins at place ``first``."""
    return (run.c.grid_id == grid_id) & (run.c.ordinal >= first) & (run.c.ordinal < first + PIECE)


class Turns:
    """Lets the database's other writers have theirs between two pieces; what was done meanwhile counts as waiting."""

    def __init__(self, database: Database) -> None:
        self._wait_s = _TURN_S if database.is_sqlite else 0.0
        self._next = 0.0

    def wait(self) -> None:
        """Before a piece: wait until those who waited for the last one have had time to see that it is over."""
        time.sleep(max(self._next - time.monotonic(), 0.0))

    def ended(self) -> None:
        """After a piece."""
        self._next = time.monotonic() + self._wait_s
