"""Biases of a grid, from the sums that are kept with every result."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, Row, bindparam, select

from service.domain.payload import ESTIMATES, estimator_and_prior
from service.domain.views import GridView
from service.store.points import precisions
from service.store.tables import COUNTED, GROUP_COLUMNS, SUMMED, grid_moments, input_group, input_moments

_PARTS = ("shift", "shift2", "sd", "bias", "bias_runs")
_PLACES = {estimator_and_prior(name): place for place, name in enumerate(ESTIMATES)}
_KEY = ("estimator", "index_prior")
_INPUTS = (
    select(input_group.c.id, *(input_group.c[name] for name in (*GROUP_COLUMNS, "runs")))
    .where(input_group.c.grid_id == bindparam("grid"))
    .order_by(*(input_group.c[name] for name in GROUP_COLUMNS), input_group.c.id)
    .limit(bindparam("limit"))
    .offset(bindparam("offset"))
)
# In the order in which _estimates takes them apart.
_MOMENTS = select(
    input_moments.c.input_id,
    *(input_moments.c[name] for name in (*_KEY, *COUNTED)),
    *(input_moments.c[f"{quantity}_{part}"] for quantity in SUMMED for part in _PARTS),
).where(input_moments.c.input_id.in_(bindparam("inputs", expanding=True)))
_WHOLE = select(grid_moments).where(grid_moments.c.grid_id == bindparam("grid"))
_TRUE = [GROUP_COLUMNS.index(quantity) for quantity in SUMMED]


def summarise(connection: Connection, grid: GridView, limit: int, offset: int = 0) -> dict[str, Any]:
    """Rows by input (all but the seed) and the whole grid, in the transaction that read the grid.

    The answer is a :class:`~service.domain.views.Summary` as plain data, keys in the order of the fields. A page can
    hold two hundred thousand numbers: models of them take longer to make than all the rest, only to check what this
    module has written. ``next`` holds the offset of the next page of rows.
    """
    stored = grid.counts.done
    page = {"grid": grid.id, "limit": limit + 1, "offset": offset}
    found = connection.execute(_INPUTS, page).all()
    whole = {(row.estimator, row.index_prior): row for row in connection.execute(_WHOLE, {"grid": grid.id})}
    return {
        "grid_id": grid.id,
        "state": grid.state,
        "n_runs": grid.n_runs,
        "n_stored": stored,
        "rows": _rows(connection, grid, found[:limit]) if found else [],
        "overall": {name: _overall(whole.get(estimator_and_prior(name))) for name in ESTIMATES} if stored else {},
        "next": str(offset + limit) if len(found) > limit else None,
    }


def _rows(connection: Connection, grid: GridView, inputs: Sequence[Row[Any]]) -> list[dict[str, Any]]:
    """Each a :class:`service.domain.views.SummaryRow` as plain data."""
    places = {row.id: place for place, row in enumerate(inputs)}
    answers: list[dict[str, Any] | None] = [None] * (len(inputs) * len(ESTIMATES))
    rows = connection.execute(_MOMENTS, {"inputs": list(places)}).all()
    # An estimator of another version of this code is stored, and not shown.
    known = [row for row in rows if row[1:3] in _PLACES]
    estimates = _estimates(known, [inputs[places[row[0]]][1:] for row in known]) if known else []
    for row, answer in zip(known, estimates, strict=True):
        answers[places[row[0]] * len(ESTIMATES) + _PLACES[row[1:3]]] = answer
    known_to = {} if grid.until is None else precisions(connection, grid.id, places)
    return [
        {
            "input": dict(zip(GROUP_COLUMNS, row[1:], strict=False)),
            "n_runs": row.runs,
            "precision": known_to.get(row.id),
            "estimates": dict(
                zip(ESTIMATES, answers[place * len(ESTIMATES) : (place + 1) * len(ESTIMATES)], strict=True)
            ),
        }
        for place, row in enumerate(inputs)
    ]


def _estimates(rows: Sequence[Row[Any]], inputs: Sequence[Sequence[Any]]) -> list[dict[str, Any]]:
    """One estimate for each row of sums: a :class:`service.domain.views.SummaryEstimate` as plain data."""
    first = 1 + len(_KEY)
    sums = np.array([row[first:] for row in rows], dtype=float)
    counted, runs = sums[:, : len(COUNTED)].astype(np.int64).tolist(), sums[:, 0]
    quantities = []
    for number, place in enumerate(_TRUE):
        part = len(COUNTED) + number * len(_PARTS)
        total, squares, sd, bias, bias_runs = sums[:, part : part + len(_PARTS)].T
        true = [row[place] for row in inputs]
        # What sums are kept of the shift from.
        base = np.array([0.0 if value is None else value for value in true])
        # What was divided by nothing is not taken over.
        with np.errstate(divide="ignore", invalid="ignore"):
            shift = total / runs
            spread = np.sqrt(np.maximum(squares / runs - shift * shift, 0.0) * runs / (runs - 1.0))
            columns = (
                true,
                (base + shift).tolist(),
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
        for magnitude, r_eff, n, (answered, at_bound, failed) in zip(*quantities, counted, strict=True)
    ]


def _or_none(values: NDArray[np.float64], known: NDArray[np.bool_]) -> list[float | None]:
    """Values as a list, with None for those that are not known."""
    found: list[float | None] = values.tolist()
    if known.all():
        return found
    return [value if there else None for value, there in zip(found, known.tolist(), strict=True)]


def _overall(row: Row[Any] | None) -> dict[str, Any] | None:
    """One estimator over a grid: a :class:`service.domain.views.OverallEstimate` as plain data."""
    if row is None:
        return None
    column = row._mapping
    values: dict[str, Any] = {}
    for quantity in SUMMED:
        known = column[f"{quantity}_bias_runs"]
        bias = column[f"{quantity}_bias"] / known if known else None
        spread = None if bias is None else _scatter(bias, column[f"{quantity}_bias2"] / known, known)
        values[quantity] = {"bias": bias, "bias_scatter": spread, "sd": column[f"{quantity}_sd"] / row.runs}
    return {**values, "runs": row.runs}


def _scatter(mean: float, mean_of_squares: float, runs: int) -> float | None:
    """Sample standard deviation from two moments, None for one run alone."""
    if runs < 2:
        return None
    return math.sqrt(max(mean_of_squares - mean * mean, 0.0) * runs / (runs - 1))
