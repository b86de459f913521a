"""Biases of a grid, from the sums that are kept with every result."""

from __future__ import annotations

import math
from typing import Any

from sqlalchemy import Row, RowMapping, select

from service.payload import ESTIMATES
from service.schemas import (
    GridView,
    OverallEstimate,
    OverallValue,
    Summary,
)
from service.store.database import Database
from service.store.tables import COUNTED, GROUP_COLUMNS, INPUT_COLUMNS, SUMMED, grid_sum, input_sum

_INPUTS = frozenset(INPUT_COLUMNS)


def summarise(database: Database, grid: GridView, limit: int, offset: int = 0) -> Summary:
    """Rows by input (all but the seed) and the whole grid, both from one picture of the database.

    ``next`` holds the offset of the next page of rows.
    """
    order = [input_sum.c[name] for name in GROUP_COLUMNS]
    rows = select(input_sum).where(input_sum.c.grid_id == grid.id).order_by(*order).limit(limit + 1).offset(offset)
    with database.read() as connection:
        found = connection.execute(rows).all()
        whole = connection.execute(select(grid_sum).where(grid_sum.c.grid_id == grid.id)).one_or_none()
    # As plain data, checked once: a page can hold twenty thousand values, and a model is made faster by the thousand.
    return Summary.model_validate(
        {
            "grid_id": grid.id,
            "state": grid.state,
            "n_runs": grid.n_runs,
            "n_stored": 0 if whole is None else whole.runs,
            "rows": [_row(tuple(row)) for row in found[:limit]],
            "overall": {} if whole is None else {name: _overall(whole, name) for name in ESTIMATES},
            "next": str(offset + limit) if len(found) > limit else None,
        }
    )


_AT = {column.name: place for place, column in enumerate(input_sum.columns)}
_PARTS = ("shift", "shift2", "sd", "bias", "bias_runs")


def _places(estimate: str, quantity: str) -> tuple[int | None, tuple[int, ...]]:
    """Where a row has a quantity's input, if it is one, and its sums."""
    return _AT[quantity] if quantity in _INPUTS else None, tuple(
        _AT[f"{estimate}_{quantity}_{part}"] for part in _PARTS
    )


_QUANTITIES = {name: {quantity: _places(name, quantity) for quantity in SUMMED} for name in ESTIMATES}


def _row(row: tuple[Any, ...]) -> dict[str, Any]:
    """A :class:`SummaryRow` as plain data."""
    estimates: dict[str, dict[str, Any] | None] = {}
    for name, quantities in _QUANTITIES.items():
        estimate: dict[str, Any] = {part: row[_AT[f"{name}_{part}"]] for part in COUNTED}
        runs = estimate["runs"]
        if not runs:
            estimates[name] = None
            continue
        for quantity, (place, sums) in quantities.items():
            true = None if place is None else row[place]
            total, squares, sd, bias, bias_runs = (row[at] for at in sums)
            shift = total / runs
            estimate[quantity] = {
                "input": true,
                "mean": shift if true is None else true + shift,
                "sd": sd / runs,
                "scatter": _scatter(shift, squares / runs, runs),
                "bias": bias / bias_runs if bias_runs else None,
            }
        estimates[name] = estimate
    return {
        "input": {name: row[_AT[name]] for name in GROUP_COLUMNS},
        "n_runs": row[_AT["runs"]],
        "estimates": estimates,
    }


def _overall(row: Row[*tuple[Any, ...]], estimate: str) -> OverallEstimate | None:
    column = row._mapping
    runs = column[f"{estimate}_runs"]
    if not runs:
        return None
    values = {}
    for quantity in SUMMED:
        name = f"{estimate}_{quantity}"
        bias, square = (_mean(column, f"{name}_{part}", f"{name}_bias_runs") for part in ("bias", "bias2"))
        spread = None if bias is None or square is None else _scatter(bias, square, column[f"{name}_bias_runs"])
        values[quantity] = OverallValue(bias=bias, bias_scatter=spread, sd=column[f"{name}_sd"] / runs)
    return OverallEstimate(runs=runs, **values)


def _mean(column: RowMapping, total: str, runs: str) -> float | None:
    """A sum over those runs that have the number; None where none has."""
    return column[total] / column[runs] if column[runs] else None


def _scatter(mean: float, mean_of_squares: float, runs: int) -> float | None:
    """Sample standard deviation from two moments, None for one run alone."""
    if runs < 2:
        return None
    return math.sqrt(max(mean_of_squares - mean * mean, 0.0) * runs / (runs - 1))
