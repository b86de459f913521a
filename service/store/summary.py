"""Biases of a grid, added up by the database."""

from __future__ import annotations

import math
from typing import Any

from sqlalchemy import ColumnElement, Row, func, select

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
from service.store.tables import INPUT_COLUMNS, result

_GROUP = tuple(result.c[name] for name in INPUT_COLUMNS if name != "seed")
_INPUTS = frozenset(INPUT_COLUMNS)


def summarise(database: Database, grid: GridView, limit: int, offset: int = 0) -> Summary:
    """Rows by input (all but the seed) and the whole grid, both from one picture of the database.

    ``next`` holds the offset of the next page of rows.
    """
    mine = result.c.grid_id == grid.id
    rows = (
        select(*_GROUP, func.count().label("runs"), *_sums())
        .where(mine)
        .group_by(*_GROUP)
        .order_by(*_GROUP)
        .limit(limit + 1)
        .offset(offset)
    )
    overall = select(func.count().label("runs"), *_sums()).where(mine)
    with database.read() as connection:
        found = connection.execute(rows).all()
        whole = connection.execute(overall).one()
    return Summary(
        grid_id=grid.id,
        state=grid.state,
        n_runs=grid.n_runs,
        n_stored=whole.runs,
        rows=[_row(row) for row in found[:limit]],
        overall={name: _overall(whole, name) for name in ESTIMATES} if whole.runs else {},
        next=str(offset + limit) if len(found) > limit else None,
    )


def _sums() -> list[ColumnElement[Any]]:
    columns: list[ColumnElement[Any]] = []
    for estimate in ESTIMATES:
        for quantity in QUANTITIES:
            name = f"{estimate}_{quantity}"
            mean, sd, bias = (result.c[f"{name}_{part}"] for part in ("mean", "sd", "bias"))
            # Squares are taken about the input, since those of a magnitude near 20 would lose the scatter's digits.
            shifted = mean - result.c[quantity] if quantity in _INPUTS else mean
            columns += [
                func.avg(mean).label(f"{name}_mean"),
                func.avg(sd).label(f"{name}_sd"),
                func.avg(bias).label(f"{name}_bias"),
                func.avg(bias * bias).label(f"{name}_bias2"),
                func.avg(shifted).label(f"{name}_shift"),
                func.avg(shifted * shifted).label(f"{name}_shift2"),
            ]
        columns += [func.sum(result.c[f"{estimate}_{part}"]).label(f"{estimate}_{part}") for part in _COUNTED]
    return columns


_COUNTED = ("at_bound", "failed")


def _row(row: Row[*tuple[Any, ...]]) -> SummaryRow:
    column = row._mapping
    return SummaryRow(
        input={part.name: column[part.name] for part in _GROUP},
        n_runs=row.runs,
        estimates={
            name: SummaryEstimate(
                **{quantity: _value(row, name, quantity) for quantity in QUANTITIES},
                **{part: int(column[f"{name}_{part}"]) for part in _COUNTED},
            )
            for name in ESTIMATES
        },
    )


def _value(row: Row[*tuple[Any, ...]], estimate: str, quantity: str) -> SummaryValue:
    column, name = row._mapping, f"{estimate}_{quantity}"
    return SummaryValue(
        input=column[quantity] if quantity in _INPUTS else None,
        mean=column[f"{name}_mean"],
        sd=column[f"{name}_sd"],
        scatter=_scatter(column[f"{name}_shift"], column[f"{name}_shift2"], row.runs),
        bias=column[f"{name}_bias"],
    )


def _overall(row: Row[*tuple[Any, ...]], estimate: str) -> OverallEstimate:
    column = row._mapping
    values = {}
    for quantity in QUANTITIES:
        name = f"{estimate}_{quantity}"
        bias = column[f"{name}_bias"]
        spread = None if bias is None else _scatter(bias, column[f"{name}_bias2"], row.runs)
        values[quantity] = OverallValue(bias=bias, bias_scatter=spread, sd=column[f"{name}_sd"])
    return OverallEstimate(**values)


def _scatter(mean: float, mean_of_squares: float, runs: int) -> float | None:
    """Sample standard deviation from two moments, None for one run alone."""
    if runs < 2:
        return None
    return math.sqrt(max(mean_of_squares - mean * mean, 0.0) * runs / (runs - 1))
