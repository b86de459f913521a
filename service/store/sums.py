"""Sums over stored results, kept with each of them: a summary need not read a hundred thousand wide rows.

They change in the transaction that stores the results, under the lock of the grid, so they are always those of the
results that are there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, Insert, Integer, Table
from sqlalchemy.dialects import postgresql, sqlite

from service.domain.payload import ESTIMATES
from service.store.tables import COUNTED, GROUP_COLUMNS, SUMMED, grid_sum, input_sum

_INSERT: dict[str, Callable[[Table], sqlite.Insert | postgresql.Insert]] = {
    "sqlite": sqlite.insert,
    "postgresql": postgresql.insert,
}


def add_to_sums(connection: Connection, rows: Sequence[dict[str, Any]]) -> None:
    """Add results that are being stored, given as rows of the result table; the caller holds their grids' locks."""
    by_input: dict[tuple[Any, ...], list[int]] = {}
    by_grid: dict[tuple[Any, ...], list[int]] = {}
    for place, row in enumerate(rows):
        by_input.setdefault(tuple(row[name] for name in _INPUT), []).append(place)
        by_grid.setdefault((row["grid_id"],), []).append(place)
    moments = _moments(rows)
    for table, keys, groups in ((input_sum, _INPUT, by_input), (grid_sum, ("grid_id",), by_grid)):
        columns = _COLUMNS[table]
        terms = np.concatenate([moments[part] for part in _PARTS[table]], axis=2)
        # One order for all who write, so that nobody waits for a row that another has while that one waits for his.
        added = [
            dict(zip(keys, group, strict=True))
            | {"runs": len(places)}
            | {
                name: int(total) if whole else total
                for (name, whole), total in zip(columns, terms[places].sum(axis=0).ravel().tolist(), strict=True)
            }
            for group, places in sorted(groups.items())
        ]
        connection.execute(_upsert(connection.dialect.name, table), added)


def _moments(rows: Sequence[dict[str, Any]]) -> dict[str, NDArray[np.float64]]:
    """What is added up of each row, of shape (rows, estimates, quantities) each; zero where there is no answer.

    ``counted`` has the columns of ``COUNTED`` in the place of quantities.
    """
    # None becomes NaN.
    read = np.array([_READ(row) for row in rows], dtype=float).reshape(len(rows), len(ESTIMATES), -1)
    true = np.array([[row[name] for name in SUMMED] for row in rows], dtype=float)[:, None, :]
    mean, sd, bias = (read[:, :, part : part + len(SUMMED)] for part in range(0, 3 * len(SUMMED), len(SUMMED)))
    known = ~np.isnan(bias)
    # Sums are kept of the shift from the input: those of squares of a magnitude near 20 would lose its digits.
    shift = np.nan_to_num(mean - true)
    bias = np.nan_to_num(bias)
    answered = ~np.isnan(mean[:, :, :1])
    counted = np.concatenate([answered, np.nan_to_num(read[:, :, 3 * len(SUMMED) :])], axis=2)
    return {
        "counted": counted,
        "sd": np.nan_to_num(sd),
        "bias": bias,
        "bias2": bias * bias,
        "bias_runs": known.astype(float),
        "shift": shift,
        "shift2": shift * shift,
    }


_INPUT = ("grid_id", *GROUP_COLUMNS)
_PARTS = {
    input_sum: ("counted", "sd", "bias", "bias_runs", "shift", "shift2"),
    grid_sum: ("counted", "sd", "bias", "bias2", "bias_runs"),
}
# The magnitude comes first: an estimate without one has no answer at all.
_READ = itemgetter(
    *(
        f"{estimate}_{name}"
        for estimate in ESTIMATES
        for name in (*(f"{quantity}_{part}" for part in ("mean", "sd", "bias") for quantity in SUMMED), *COUNTED[1:])
    )
)


def _columns(table: Table) -> list[tuple[str, bool]]:
    """Columns in the order in which the moments lie, and whether each holds whole numbers."""
    names = [
        f"{estimate}_{name}"
        for estimate in ESTIMATES
        for name in (*COUNTED, *(f"{quantity}_{part}" for part in _PARTS[table][1:] for quantity in SUMMED))
    ]
    return [(name, isinstance(table.c[name].type, Integer)) for name in names]


_COLUMNS = {table: _columns(table) for table in _PARTS}


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
