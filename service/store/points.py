"""Points of grids whose replicates end once the mean bias is known (:mod:`service.domain.precision`).

A point is judged in the transaction that stores a result of it: there is no moment at which it is known well enough and
replicates of it wait. So there is nothing to look for at any other time, and nothing for a crash to leave.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from datetime import datetime
from functools import cache
from typing import Any, NamedTuple

from sqlalchemy import ColumnElement, Connection, Insert, Table, case, func, literal_column, select
from sqlalchemy.dialects import postgresql, sqlite

from service.domain.precision import Until, standard_error, upper_limit
from service.domain.states import SPARE
from service.store.leases import add_events, new_event
from service.store.tables import estimate, grid, point, run
from service.store.transitions import move

_AT_ONCE = 1000
_INSERT: dict[str, Callable[[Table], sqlite.Insert | postgresql.Insert]] = {
    "sqlite": sqlite.insert,
    "postgresql": postgresql.insert,
}


class Replicate(NamedTuple):
    """A result that is being stored: which place of its grid, and the input that it was counted to."""

    grid_id: str
    ordinal: int
    input_id: int


def judge_points(connection: Connection, stored: Sequence[Replicate], now: datetime) -> int:
    """Judge the points that results have just been stored of, and end the replicates of those known well enough.

    Returns how many. Only the answers of these points are read. What is running goes on to its end, and is stored. The
    caller holds the locks of the grids.
    """
    ended = 0
    wanted = select(grid.c.id, grid.c.until, grid.c.points, grid.c.n_runs)
    ids = sorted({one.grid_id for one in stored})
    for row in connection.execute(wanted.where(grid.c.id.in_(ids), grid.c.points.is_not(None)).order_by(grid.c.id)):
        inputs = {one.ordinal % row.points: one.input_id for one in stored if one.grid_id == row.id}
        until = Until.model_validate(row.until)
        judged = _judged(connection, until, inputs)
        before = set(connection.scalars(_reached(row.id, inputs)))
        reached = {place: now for place, one in judged.items() if one.pop("is_kept") or place in before}
        rows = [
            {"grid_id": row.id, "place": place, **one, "reached_at": reached.get(place)}
            for place, one in sorted(judged.items())
        ]
        connection.execute(_upsert(connection.dialect.name), rows)
        for place in sorted(reached.keys() - before):
            replicates = range(place, row.n_runs, row.points)
            mine = (run.c.grid_id == row.id) & run.c.ordinal.in_(replicates)
            spared = move(connection, SPARE, mine, finished_at=now)
            ended += len(spared)
            known = {name: judged[place][name] for name in ("runs", "standard_error")}
            told = new_event(row.id, "point_reached", now, place=place, **known, not_needed=len(spared))
            add_events(connection, [told])
    return ended


def _judged(connection: Connection, until: Until, inputs: Mapping[int, int]) -> dict[int, dict[str, Any]]:
    """What is known of each place by now: columns of its row, and whether that is enough."""
    biases: dict[int, list[float]] = defaultdict(list)
    bias = estimate.c[f"{until.quantity}_bias"]
    asked = select(estimate.c.input_id, bias).where(
        # One look into the index of answers.
        estimate.c.estimator == until.estimator,
        estimate.c.index_prior == until.index_prior,
        bias.is_not(None),
    )
    for some in _parts(sorted(set(inputs.values()))):
        for input_id, value in connection.execute(asked.where(estimate.c.input_id.in_(some))):
            biases[input_id].append(value)
    found: dict[int, dict[str, Any]] = {}
    for place, input_id in inputs.items():
        known = biases[input_id]
        error = standard_error(known)
        found[place] = {
            "input_id": input_id,
            "runs": len(known),
            "standard_error": error,
            "wanted": until.wanted(error, len(known)),
            "is_kept": until.is_kept(error, len(known)),
        }
    return found


def _parts(ids: Sequence[int]) -> Iterator[Sequence[int]]:
    for first in range(0, len(ids), _AT_ONCE):
        yield ids[first : first + _AT_ONCE]


def _reached(grid_id: str, places: Collection[int]) -> Any:
    return select(point.c.place).where(
        point.c.grid_id == grid_id, point.c.place.in_(sorted(places)), point.c.reached_at.is_not(None)
    )


@cache
def _upsert(dialect: str) -> Insert:
    statement = _INSERT[dialect](point)
    new = statement.excluded
    changed: dict[str, ColumnElement[Any]] = {
        name: new[name] for name in ("input_id", "runs", "standard_error", "wanted")
    }
    # The first time stays.
    changed["reached_at"] = func.coalesce(point.c.reached_at, new.reached_at)
    return statement.on_conflict_do_update(index_elements=["grid_id", "place"], set_=changed)


class Progress(NamedTuple):
    """Of a grid's points: how many are known well enough, and how many replicates the others should still take."""

    reached: int
    left: int


def progress(connection: Connection, grids: Mapping[str, tuple[int, int]]) -> dict[str, Progress]:
    """How far grids are, by their ids with the number of their points and ``at_most``."""
    if not grids:
        return {}
    is_open = point.c.reached_at.is_(None)
    counted = (
        select(
            point.c.grid_id,
            func.count().label("seen"),
            func.count(point.c.reached_at).label("reached"),
            func.sum(case((is_open, point.c.wanted - point.c.runs), else_=literal_column("0"))).label("left"),
        )
        .where(point.c.grid_id.in_(sorted(grids)))
        .group_by(point.c.grid_id)
    )
    found = {row.grid_id: row for row in connection.execute(counted)}
    far = {}
    for grid_id, (points, at_most) in grids.items():
        row = found.get(grid_id)
        seen, reached, left = (0, 0, 0) if row is None else (row.seen, row.reached, row.left)
        far[grid_id] = Progress(reached, int(left) + (points - seen) * at_most)
    return far


def precisions(connection: Connection, grid_id: str, inputs: Collection[int]) -> dict[int, dict[str, Any]]:
    """Of some inputs of a grid, each a :class:`service.domain.views.PrecisionView` as plain data."""
    columns = (point.c.input_id, point.c.runs, point.c.standard_error, point.c.reached_at)
    wanted = select(*columns).where(point.c.grid_id == grid_id, point.c.input_id.in_(sorted(inputs)))
    return {
        row.input_id: {
            "reached": row.reached_at is not None,
            "runs": row.runs,
            "standard_error": row.standard_error,
            "upper_limit": upper_limit(row.standard_error, row.runs),
        }
        for row in connection.execute(wanted)
    }
