"""Sums over stored results, kept with each of them: a summary need not read a hundred thousand wide rows.

They change in the transaction that stores the results, under the lock of the grid, so they are always those of the
results that are there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import Any

from sqlalchemy import Connection, Insert, Table
from sqlalchemy.dialects import postgresql, sqlite

from service.payload import ESTIMATES
from service.store.tables import COUNTED, GROUP_COLUMNS, SUMMED, grid_sum, input_sum

_INSERT: dict[str, Callable[[Table], sqlite.Insert | postgresql.Insert]] = {
    "sqlite": sqlite.insert,
    "postgresql": postgresql.insert,
}


def add_to_sums(connection: Connection, rows: Sequence[dict[str, Any]]) -> None:
    """Add results that are being stored, given as rows of the result table; the caller holds their grids' locks."""
    by_input: dict[tuple[Any, ...], dict[str, Any]] = {}
    by_grid: dict[str, dict[str, Any]] = {}
    for row in rows:
        place = (row["grid_id"], *(row[name] for name in GROUP_COLUMNS))
        key = dict(zip(("grid_id", *GROUP_COLUMNS), place, strict=True))
        # Sums are kept of the shift from the input: those of squares of a magnitude near 20 would lose its digits.
        _add(by_input.setdefault(place, key), row, ("sd", "bias", "bias_runs", "shift", "shift2"))
        _add(by_grid.setdefault(row["grid_id"], {"grid_id": row["grid_id"]}), row, ("sd", "bias", "bias2", "bias_runs"))
    dialect = connection.dialect.name
    connection.execute(_upsert(dialect, input_sum), [by_input[place] for place in sorted(by_input)])
    connection.execute(_upsert(dialect, grid_sum), [by_grid[grid_id] for grid_id in sorted(by_grid)])


def _add(sums: dict[str, Any], row: dict[str, Any], parts: tuple[str, ...]) -> None:
    sums["runs"] = sums.get("runs", 0) + 1
    for estimate in ESTIMATES:
        answered = row[f"{estimate}_magnitude_mean"] is not None
        for name in COUNTED:
            column = f"{estimate}_{name}"
            added = 0 if not answered else 1 if name == "runs" else row[column]
            sums[column] = sums.get(column, 0) + added
        for quantity in SUMMED:
            prefix = f"{estimate}_{quantity}"
            for part, value in zip(parts, _moments(row, prefix, quantity, parts), strict=True):
                column = f"{prefix}_{part}"
                sums[column] = sums.get(column, 0) + value


def _moments(row: dict[str, Any], prefix: str, quantity: str, parts: tuple[str, ...]) -> Iterator[float]:
    mean = row[f"{prefix}_mean"]
    if mean is None:
        return iter([0] * len(parts))
    bias = row[f"{prefix}_bias"]
    shift = mean - (row[quantity] if quantity in GROUP_COLUMNS else 0.0)
    known = {
        "sd": row[f"{prefix}_sd"],
        "bias": 0.0 if bias is None else bias,
        "bias2": 0.0 if bias is None else bias * bias,
        "bias_runs": 0 if bias is None else 1,
        "shift": shift,
        "shift2": shift * shift,
    }
    return (known[part] for part in parts)


@cache
def _upsert(dialect: str, table: Table) -> Insert:
    """Insert a row of sums or add it to the one that is there; made once, for it has a hundred parts."""
    statement = _INSERT[dialect](table)
    added = {
        column.name: table.c[column.name] + statement.excluded[column.name]
        for column in table.columns
        if not column.primary_key
    }
    keys = [column.name for column in table.primary_key]
    return statement.on_conflict_do_update(index_elements=keys, set_=added)
