"""What the database says after a drill: the store itself is asked, not the API that is being drilled."""

from __future__ import annotations

from collections import Counter
from contextlib import closing
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, func, select

from service.store.database import Database
from service.store.tables import attempt, estimate, event, result, run
from tests.drills.installation import Installation

_OF_THIS_GRID = frozenset({"run_id", "grid_id", "input_id", "stored_at"})


@dataclass(frozen=True)
class Records:
    """A grid as it was stored."""

    states: dict[str, int]
    """Runs by state."""
    results: list[tuple[Any, ...]]
    """Every stored result in the grid's order, without identifiers and time of storing."""
    outcomes: dict[str, int]
    """Attempts by outcome."""
    charged: dict[int, Counter[str]]
    """Attempts by outcome of each run that had more than one, by its place in the grid."""
    late: int
    """Results that came too late and were dropped."""

    @property
    def stored(self) -> int:
        """Runs with a result."""
        return len(self.results)


def read_records(database_url: str, grid_id: str) -> Records:
    """Ask the database, in one transaction."""
    columns = [column for column in result.c if column.name not in _OF_THIS_GRID]
    with closing(Database(database_url, pooled=False)) as database, database.read() as connection:
        counted = select(run.c.state, func.count().label("runs")).where(run.c.grid_id == grid_id)
        states = {row.state: row.runs for row in connection.execute(counted.group_by(run.c.state))}
        mine = select(*columns).join(run, run.c.id == result.c.run_id).where(run.c.grid_id == grid_id)
        results = [tuple(row) for row in connection.execute(mine.order_by(run.c.ordinal))]
        answers = _answers(connection, grid_id)
        ended = select(run.c.ordinal, attempt.c.outcome).join(run, run.c.id == attempt.c.run_id)
        charged: dict[int, Counter[str]] = {}
        for row in connection.execute(ended.where(run.c.grid_id == grid_id)):
            charged.setdefault(row.ordinal, Counter())[row.outcome] += 1
        stale = select(func.count()).where(event.c.grid_id == grid_id, event.c.kind == "stale_result")
        late = connection.scalar(stale) or 0
    outcomes: Counter[str] = sum(charged.values(), Counter())
    repeated = {ordinal: ends for ordinal, ends in charged.items() if ends.total() > 1}
    stored = [(*_comparable(row), *found) for row, found in zip(results, answers, strict=True)]
    return Records(states, stored, dict(outcomes), repeated, late)


def _answers(connection: Connection, grid_id: str) -> list[tuple[Any, ...]]:
    """Every estimate of each result, in the grid's order."""
    columns = [column for column in estimate.c if column.name not in _OF_THIS_GRID]
    mine = select(run.c.ordinal, *columns).select_from(run.join(result).outerjoin(estimate))
    found: dict[int, tuple[Any, ...]] = {}
    for ordinal, *values in connection.execute(
        mine.where(run.c.grid_id == grid_id).order_by(run.c.ordinal, estimate.c.estimator, estimate.c.index_prior)
    ):
        found[ordinal] = (*found.get(ordinal, ()), *map(repr, values))
    return list(found.values())


def records(installation: Installation, grid_id: str) -> Records:
    """What an installation has stored of a grid."""
    return read_records(installation.database, grid_id)


def _comparable(row: tuple[Any, ...]) -> tuple[Any, ...]:
    # Documents come back as lists and dictionaries, in the order in which a database keeps them.
    return tuple(repr(sorted(value.items())) if isinstance(value, dict) else repr(value) for value in row)
