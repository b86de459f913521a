"""Sums over stored results, kept with each of them: a summary need not read a million answers.

They change in the transaction that stores the results, under the lock of the grid, so they are always those of the
results that are there.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, lru_cache
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, Insert, Integer, Table
from sqlalchemy.dialects import postgresql, sqlite

from service.store.tables import COUNTED, KEY_COLUMNS, SUMMED, USUAL_INPUTS, grid_moments, input_group, input_moments

_INSERT: dict[str, Callable[[Table], sqlite.Insert | postgresql.Insert]] = {
    "sqlite": sqlite.insert,
    "postgresql": postgresql.insert,
}
_KEY = itemgetter(*KEY_COLUMNS)
_TRUE = itemgetter(*SUMMED)
_ADDED = ("runs", "wall_s", "cpu_s")


def add_to_inputs(connection: Connection, rows: Sequence[Mapping[str, Any]]) -> list[int]:
    """Count results that are being stored, rows of the result table, to their inputs; the input's id for each row.

    An input that is new is made. The caller holds the locks of the grids.
    """
    keys = [(row["grid_id"], input_digest(_KEY(row))) for row in rows]
    added: dict[tuple[str, str], dict[str, Any]] = {}
    for key, row in zip(keys, rows, strict=True):
        one = added.get(key)
        if one is None:
            common = dict(zip(KEY_COLUMNS, _KEY(row), strict=True))
            added[key] = one = {"grid_id": key[0], "digest": key[1], **common, "runs": 0, "wall_s": 0.0, "cpu_s": 0.0}
        one["runs"] += 1
        one["wall_s"] += row["wall_s"]
        one["cpu_s"] += row["cpu_s"]
    found = connection.execute(_upsert_input(connection.dialect.name), [added[key] for key in sorted(added)])
    ids = {(row.grid_id, row.digest): row.id for row in found}
    return [ids[key] for key in keys]


@lru_cache(10_000)
def _digest(values: tuple[Any, ...]) -> str:
    given = zip(KEY_COLUMNS, values, strict=True)
    named = {name: value for name, value in given if value is not None and value != USUAL_INPUTS.get(name)}
    return hashlib.sha256(json.dumps(named, sort_keys=True).encode()).hexdigest()[:32]


def input_digest(values: Iterable[Any]) -> str:
    """What an input is known by within its grid, of its values of KEY_COLUMNS: null or usual is as without a column."""
    return _digest(tuple(float(value) if isinstance(value, int) else value for value in values))


def add_to_moments(
    connection: Connection, results: Sequence[Mapping[str, Any]], estimates: Sequence[Mapping[str, Any]]
) -> None:
    """Add answers that are being stored, rows of the estimate table, whose results are among ``results``."""
    if not estimates:
        return
    owners = {row["run_id"]: row for row in results}
    mine = [owners[row["run_id"]] for row in estimates]
    moments = _moments(estimates, mine)
    for table, owner, owned in (
        (input_moments, "input_id", [row["input_id"] for row in estimates]),
        (grid_moments, "grid_id", [row["grid_id"] for row in mine]),
    ):
        groups: dict[tuple[Any, ...], list[int]] = {}
        for place, (row, owner_id) in enumerate(zip(estimates, owned, strict=True)):
            groups.setdefault((owner_id, row["estimator"], row["index_prior"]), []).append(place)
        columns = _COLUMNS[table]
        terms = np.concatenate([moments[part] for part in _PARTS[table]], axis=1)
        # One order for all who write, so that nobody waits for a row that another has while that one waits for his.
        ordered = sorted(groups)
        places = np.concatenate([groups[key] for key in ordered])
        starts = np.cumsum([0, *(len(groups[key]) for key in ordered[:-1])])
        totals = np.add.reduceat(terms[places], starts, axis=0).tolist()
        keys = (owner, "estimator", "index_prior")
        added = [
            dict(zip(keys, key, strict=True))
            | {name: int(total) if whole else total for (name, whole), total in zip(columns, one, strict=True)}
            for key, one in zip(ordered, totals, strict=True)
        ]
        connection.execute(_upsert(connection.dialect.name, table), added)


def _moments(
    estimates: Sequence[Mapping[str, Any]], results: Sequence[Mapping[str, Any]]
) -> dict[str, NDArray[np.float64]]:
    """What is added up of each answer, of shape (answers, quantities) each.

    ``counted`` has the columns of ``COUNTED`` in the place of quantities.
    """
    # None becomes NaN.
    read = np.array([_READ(row) for row in estimates], dtype=float)
    true = np.array([_TRUE(row) for row in results], dtype=float)
    mean, sd, bias = (read[:, part : part + len(SUMMED)] for part in range(0, 3 * len(SUMMED), len(SUMMED)))
    known = ~np.isnan(bias)
    # Sums are kept of the shift from the input: those of squares of a magnitude near 20 would lose its digits. Where
    # there is no input, from zero: an index is small.
    shift = np.nan_to_num(mean - np.nan_to_num(true))
    bias = np.nan_to_num(bias)
    counted = np.concatenate([np.ones((len(read), 1)), np.nan_to_num(read[:, 3 * len(SUMMED) :])], axis=1)
    return {
        "counted": counted,
        "sd": np.nan_to_num(sd),
        "bias": bias,
        "bias2": bias * bias,
        "bias_runs": known.astype(float),
        "shift": shift,
        "shift2": shift * shift,
    }


_PARTS = {
    input_moments: ("counted", "sd", "bias", "bias_runs", "shift", "shift2"),
    grid_moments: ("counted", "sd", "bias", "bias2", "bias_runs"),
}
_READ = itemgetter(*(f"{quantity}_{part}" for part in ("mean", "sd", "bias") for quantity in SUMMED), *COUNTED[1:])


def _columns(table: Table) -> list[tuple[str, bool]]:
    """Columns in the order in which the moments lie, and whether each holds whole numbers."""
    names = (*COUNTED, *(f"{quantity}_{part}" for part in _PARTS[table][1:] for quantity in SUMMED))
    return [(name, isinstance(table.c[name].type, Integer)) for name in names]


_COLUMNS = {table: _columns(table) for table in _PARTS}


@cache
def _upsert(dialect: str, table: Table) -> Insert:
    """Insert a row of sums or add it to the one that is there."""
    statement = _INSERT[dialect](table)
    added = {
        column.name: table.c[column.name] + statement.excluded[column.name]
        for column in table.columns
        if not column.primary_key
    }
    keys = [column.name for column in table.primary_key]
    return statement.on_conflict_do_update(index_elements=keys, set_=added)


@cache
def _upsert_input(dialect: str) -> Any:
    statement = _INSERT[dialect](input_group)
    added = {name: input_group.c[name] + statement.excluded[name] for name in _ADDED}
    counted = statement.on_conflict_do_update(index_elements=["grid_id", "digest"], set_=added)
    return counted.returning(input_group.c.id, input_group.c.grid_id, input_group.c.digest)
