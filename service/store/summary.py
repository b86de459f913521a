"""Biases of a grid, from the sums that are kept with every result."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, Row, RowMapping, select

from service.domain.payload import ESTIMATES
from service.domain.views import GridView
from service.store.tables import COUNTED, GROUP_COLUMNS, SUMMED, grid_sum, input_sum

_PARTS = ("shift", "shift2", "sd", "bias", "bias_runs")
# In the order in which _rows takes them apart: the input, its runs, and a block for each estimate.
_SELECTED = (
    *(input_sum.c[name] for name in (*GROUP_COLUMNS, "runs")),
    *(
        input_sum.c[f"{estimate}_{name}"]
        for estimate in ESTIMATES
        for name in (*COUNTED, *(f"{quantity}_{part}" for quantity in SUMMED for part in _PARTS))
    ),
)
_TRUE = [GROUP_COLUMNS.index(quantity) for quantity in SUMMED]


def summarise(connection: Connection, grid: GridView, limit: int, offset: int = 0) -> dict[str, Any]:
    """Rows by input (all but the seed) and the whole grid, in the transaction that read the grid.

    The answer is a :class:`~service.domain.views.Summary` as plain data, keys in the order of the fields. A page can
    hold two hundred thousand numbers: models of them take longer to make than all the rest, only to check what this
    module has written. ``next`` holds the offset of the next page of rows.
    """
    order = [input_sum.c[name] for name in GROUP_COLUMNS]
    rows = select(*_SELECTED).where(input_sum.c.grid_id == grid.id).order_by(*order).limit(limit + 1).offset(offset)
    found = connection.execute(rows).all()
    whole = connection.execute(select(grid_sum).where(grid_sum.c.grid_id == grid.id)).one_or_none()
    return {
        "grid_id": grid.id,
        "state": grid.state,
        "n_runs": grid.n_runs,
        "n_stored": 0 if whole is None else whole.runs,
        "rows": _rows(found[:limit]) if found else [],
        "overall": {} if whole is None else {name: _overall(whole, name) for name in ESTIMATES},
        "next": str(offset + limit) if len(found) > limit else None,
    }


def _rows(found: Sequence[Row[Any]]) -> list[dict[str, Any]]:
    """Each a :class:`service.domain.views.SummaryRow` as plain data."""
    first = len(GROUP_COLUMNS) + 1
    inputs = [row[:first] for row in found]
    blocks = np.array([row[first:] for row in found]).reshape(len(found), len(ESTIMATES), -1)
    columns = [
        _estimates(blocks[:, place, : len(COUNTED)], blocks[:, place, len(COUNTED) :], inputs)
        for place in range(len(ESTIMATES))
    ]
    return [
        {
            "input": dict(zip(GROUP_COLUMNS, place, strict=False)),
            "n_runs": place[-1],
            "estimates": dict(zip(ESTIMATES, estimates, strict=True)),
        }
        for place, estimates in zip(inputs, zip(*columns, strict=True), strict=True)
    ]


def _estimates(
    counted: NDArray[np.float64], sums: NDArray[np.float64], inputs: Sequence[Sequence[Any]]
) -> list[dict[str, Any] | None]:
    """One estimate of each row: a :class:`~service.domain.views.SummaryEstimate` as plain data; None: no run has it."""
    runs = counted[:, 0]
    quantities = []
    for number, place in enumerate(_TRUE):
        total, squares, sd, bias, bias_runs = sums[:, number * len(_PARTS) : (number + 1) * len(_PARTS)].T
        true = [row[place] for row in inputs]
        # What was divided by nothing is not taken over.
        with np.errstate(divide="ignore", invalid="ignore"):
            shift = total / runs
            spread = np.sqrt(np.maximum(squares / runs - shift * shift, 0.0) * runs / (runs - 1.0))
            columns = (
                true,
                (true + shift).tolist(),
                (sd / runs).tolist(),
                _or_none(spread, runs >= 2),
                _or_none(bias / bias_runs, bias_runs > 0),
            )
        quantities.append(
            [
                {"input": true, "mean": mean, "sd": sd, "scatter": scatter, "bias": bias}
                for true, mean, sd, scatter, bias in zip(*columns, strict=True)
            ]
        )
    # The names of SUMMED and COUNTED in their order, written out because it is a quarter faster.
    return [
        {"magnitude": magnitude, "r_eff": r_eff, "n": n, "runs": answered, "at_bound": at_bound, "failed": failed}
        if answered
        else None
        for magnitude, r_eff, n, (answered, at_bound, failed) in zip(
            *quantities, counted.astype(np.int64).tolist(), strict=True
        )
    ]


def _or_none(values: NDArray[np.float64], known: NDArray[np.bool_]) -> list[float | None]:
    """Values as a list, with None for those that are not known."""
    found: list[float | None] = values.tolist()
    if known.all():
        return found
    return [value if there else None for value, there in zip(found, known.tolist(), strict=True)]


def _overall(row: Row[*tuple[Any, ...]], estimate: str) -> dict[str, Any] | None:
    """One estimator over a grid: a :class:`service.domain.views.OverallEstimate` as plain data."""
    column = row._mapping
    runs = column[f"{estimate}_runs"]
    if not runs:
        return None
    values: dict[str, Any] = {}
    for quantity in SUMMED:
        name = f"{estimate}_{quantity}"
        bias, square = (_mean(column, f"{name}_{part}", f"{name}_bias_runs") for part in ("bias", "bias2"))
        spread = None if bias is None or square is None else _scatter(bias, square, column[f"{name}_bias_runs"])
        values[quantity] = {"bias": bias, "bias_scatter": spread, "sd": column[f"{name}_sd"] / runs}
    return {**values, "runs": runs}


def _mean(column: RowMapping, total: str, runs: str) -> float | None:
    """A sum over those runs that have the number; None where none has."""
    return column[total] / column[runs] if column[runs] else None


def _scatter(mean: float, mean_of_squares: float, runs: int) -> float | None:
    """Sample standard deviation from two moments, None for one run alone."""
    if runs < 2:
        return None
    return math.sqrt(max(mean_of_squares - mean * mean, 0.0) * runs / (runs - 1))
