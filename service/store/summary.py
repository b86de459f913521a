"""Biases of a grid, from the sums that are kept with every result."""

from __future__ import annotations

import math
from typing import Any

from sqlalchemy import Row, RowMapping, select

from service.payload import ESTIMATES, QUANTITIES
from service.schemas import (
    GridView,
    OverallEstimate,
    OverallValue,
    Summary,
    SummaryEstimate,
    SummaryRow,
    SummaryValue,
)
from service.store.database import Database
from service.store.tables import COUNTED, GROUP_COLUMNS, INPUT_COLUMNS, grid_sum, input_sum

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
    return Summary(
        grid_id=grid.id,
        state=grid.state,
        n_runs=grid.n_runs,
        n_stored=0 if whole is None else whole.runs,
        rows=[_row(row) for row in found[:limit]],
        overall={} if whole is None else {name: _overall(whole, name) for name in ESTIMATES},
        next=str(offset + limit) if len(found) > limit else None,
    )


def _row(row: Row[*tuple[Any, ...]]) -> SummaryRow:
    column = row._mapping
    return SummaryRow(
        input={name: column[name] for name in GROUP_COLUMNS},
        n_runs=row.runs,
        estimates={
            name: SummaryEstimate(
                **{quantity: _value(column, name, quantity) for quantity in QUANTITIES},
                **{part: column[f"{name}_{part}"] for part in COUNTED},
            )
            for name in ESTIMATES
        },
    )


def _value(column: RowMapping, estimate: str, quantity: str) -> SummaryValue:
    name, runs = f"{estimate}_{quantity}", column["runs"]
    true = column[quantity] if quantity in _INPUTS else None
    shift = column[f"{name}_shift"] / runs
    return SummaryValue(
        input=true,
        mean=shift if true is None else true + shift,
        sd=column[f"{name}_sd"] / runs,
        scatter=_scatter(shift, column[f"{name}_shift2"] / runs, runs),
        bias=_mean(column, f"{name}_bias", f"{name}_bias_runs"),
    )


def _overall(row: Row[*tuple[Any, ...]], estimate: str) -> OverallEstimate:
    column = row._mapping
    values = {}
    for quantity in QUANTITIES:
        name = f"{estimate}_{quantity}"
        bias, square = (_mean(column, f"{name}_{part}", f"{name}_bias_runs") for part in ("bias", "bias2"))
        spread = None if bias is None or square is None else _scatter(bias, square, column[f"{name}_bias_runs"])
        values[quantity] = OverallValue(bias=bias, bias_scatter=spread, sd=column[f"{name}_sd"] / row.runs)
    return OverallEstimate(**values)


def _mean(column: RowMapping, total: str, runs: str) -> float | None:
    """A sum over those runs that have the number; None where none has."""
    return column[total] / column[runs] if column[runs] else None


def _scatter(mean: float, mean_of_squares: float, runs: int) -> float | None:
    """Sample standard deviation from two moments, None for one run alone."""
    if runs < 2:
        return None
    return math.sqrt(max(mean_of_squares - mean * mean, 0.0) * runs / (runs - 1))
