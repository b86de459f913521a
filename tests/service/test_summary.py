"""A summary is written as plain data, past its models: it must be what they would have written, to the byte."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fastapi.testclient import TestClient
from sqlalchemy import RowMapping, select

from service.api.app import create_app
from service.domain.payload import ESTIMATES, estimator_and_prior
from service.domain.requests import GridRequest, plan
from service.domain.views import (
    GridView,
    OverallEstimate,
    OverallValue,
    Summary,
    SummaryEstimate,
    SummaryRow,
    SummaryValue,
)
from service.runtime.settings import Settings
from service.store.database import Database
from service.store.grids import GridStore
from service.store.leadership import Leadership
from service.store.queue import RunQueue
from service.store.tables import GROUP_COLUMNS, SUMMED, grid_moments, input_group, input_moments
from tests.service.plans import result_of

REQUEST = {"preset": "h0licow-vi/HE0435", "n": [2, 4], "l_eta": [1.0], "r_eff": [0.39], "replicates": 3}


def store_some(database: Database) -> GridView:
    """A grid with an input of one run alone, without some estimates, and without some true indices."""
    request = GridRequest.model_validate(REQUEST)
    grids = GridStore(database)
    grid_id = grids.create(request.canonical(), lambda: plan(request, 1000)).grid.id
    generation = Leadership(database).take("test")
    assert generation is not None
    queue = RunQueue(database)
    leases = queue.claim(generation, 16)
    first = {**leases[0].spec, "seed": None}
    for place, lease in enumerate(leases):
        payload = result_of(lease)
        changed: dict[str, Any] = {**payload.estimates, "image_fixed": None}
        if place % 3 == 1:
            changed["paper_free"] = None
        free = changed["image_wide"]
        if {**lease.spec, "seed": None} == first:
            changed["paper_wide"] = None
            changed["image_wide"] = free.model_copy(update={"n": free.n.model_copy(update={"truth": None})})
        queue.store(lease, payload.model_copy(update={"estimates": changed}))
    return grids.grid(grid_id)


def scatter(mean: float, squares: float, runs: int) -> float | None:
    return None if runs < 2 else math.sqrt(max(squares - mean * mean, 0.0) * runs / (runs - 1))


def plain_estimate(true: RowMapping, column: RowMapping | None) -> SummaryEstimate | None:
    if column is None:
        return None
    runs = column["runs"]
    values = {}
    for quantity in SUMMED:
        total, squares, sd, bias, known = (
            column[f"{quantity}_{part}"] for part in ("shift", "shift2", "sd", "bias", "bias_runs")
        )
        values[quantity] = SummaryValue(
            input=true[quantity],
            mean=true[quantity] + total / runs,
            sd=sd / runs,
            scatter=scatter(total / runs, squares / runs, runs),
            bias=bias / known if known else None,
        )
    return SummaryEstimate(runs=runs, at_bound=column["at_bound"], failed=column["failed"], **values)


def plain_overall(column: RowMapping | None) -> OverallEstimate | None:
    if column is None:
        return None
    runs = column["runs"]
    values = {}
    for quantity in SUMMED:
        sd, bias, squares, known = (column[f"{quantity}_{part}"] for part in ("sd", "bias", "bias2", "bias_runs"))
        values[quantity] = OverallValue(
            bias=bias / known if known else None,
            bias_scatter=scatter(bias / known, squares / known, known) if known else None,
            sd=sd / runs,
        )
    return OverallEstimate(runs=runs, **values)


def by_name(rows: Sequence[RowMapping]) -> dict[tuple[str, str], RowMapping]:
    return {(row["estimator"], row["index_prior"]): row for row in rows}


def plainly(database: Database, grid: GridView, limit: int, offset: int, following: str | None) -> bytes:
    """The answer by way of the models, number by number."""
    order = [input_group.c[name] for name in GROUP_COLUMNS]
    with database.read() as connection:
        rows = connection.execute(select(input_group).where(input_group.c.grid_id == grid.id).order_by(*order)).all()
        whole = connection.execute(select(grid_moments).where(grid_moments.c.grid_id == grid.id)).mappings().all()
        found = connection.execute(select(input_moments)).mappings().all()
    overall = by_name(whole)
    of_input = {row.id: by_name([one for one in found if one["input_id"] == row.id]) for row in rows}
    summary = Summary(
        grid_id=grid.id,
        state=grid.state,
        n_runs=grid.n_runs,
        n_stored=sum(row.runs for row in rows),
        rows=[
            SummaryRow(
                input={name: row._mapping[name] for name in GROUP_COLUMNS},
                n_runs=row.runs,
                precision=None,
                estimates={
                    name: plain_estimate(row._mapping, of_input[row.id].get(estimator_and_prior(name)))
                    for name in ESTIMATES
                },
            )
            for row in rows[offset : offset + limit]
        ],
        overall={name: plain_overall(overall.get(estimator_and_prior(name))) for name in ESTIMATES} if rows else {},
        next=following,
    )
    return summary.model_dump_json().encode()


def test_a_summary_is_to_the_byte_what_its_models_write(url: str, database: Database, tmp_path: Path) -> None:
    grid = store_some(database)
    address = f"/v1/grids/{grid.id}/summary"
    with TestClient(create_app(Settings(database_url=url, data_dir=tmp_path))) as api:
        everything = api.get(address)
        assert everything.content == plainly(database, grid, 100, 0, None)
        assert everything.headers["content-type"] == "application/json"
        assert "link" not in everything.headers
        page = api.get(f"{address}?limit=2&cursor=1")
        following = f"{address}?limit=2&cursor=3"
        assert page.content == plainly(database, grid, 2, 1, following)
        assert page.headers["link"] == f'<{following}>; rel="next"'
    found = Summary.model_validate_json(everything.content)
    # What is easily written otherwise is there: one run alone, no estimate here or anywhere, no true value.
    assert sorted(row.n_runs for row in found.rows) == [1, 3, 3, 3, 3, 3]
    assert sorted(row.estimates["paper_wide"] is None for row in found.rows) == [False] * 5 + [True]
    wide = [row.estimates["image_wide"] for row in found.rows]
    assert sorted(estimate is not None and estimate.n.scatter is None for estimate in wide) == [False] * 5 + [True]
    assert sorted(estimate is not None and estimate.n.bias is None for estimate in wide) == [False] * 5 + [True]
    assert found.overall["image_fixed"] is None


def test_a_summary_without_results_is_what_its_models_write(url: str, database: Database, tmp_path: Path) -> None:
    request = GridRequest.model_validate(REQUEST)
    grid = GridStore(database).create(request.canonical(), lambda: plan(request, 1000)).grid
    with TestClient(create_app(Settings(database_url=url, data_dir=tmp_path))) as api:
        answer = api.get(f"/v1/grids/{grid.id}/summary").content
    assert answer == plainly(database, grid, 100, 0, None)
