"""Sums that are kept with every result give the answer of the straightforward query over all results."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest
from rich.console import Console
from sqlalchemy import func, select

from service.cli.formatting import summary_table
from service.domain.payload import ESTIMATES
from service.domain.requests import GridRequest, plan
from service.domain.views import Summary
from service.store.database import Database
from service.store.grids import GridStore
from service.store.leadership import Leadership
from service.store.migrate import downgrade, upgrade
from service.store.queue import RunQueue
from service.store.tables import GROUP_COLUMNS, SUMMED, input_sum, result
from tests.service.plans import result_of

BODY = {"preset": "h0licow-vi/HE0435", "n": [2, 4], "l_eta": [1.0], "r_eff": [0.39], "replicates": 3}


def stored(database: Database) -> str:
    """A grid of several inputs with three runs each, some of them without a true index."""
    request = GridRequest.model_validate(BODY)
    grid_id = GridStore(database).create(request.canonical(), lambda: plan(request, 1000)).grid.id
    generation = Leadership(database).take("test")
    assert generation is not None
    queue = RunQueue(database)
    for size in (1, 4, 100):
        results = [(lease, result_of(lease)) for lease in queue.claim(generation, size)]
        for place, (lease, payload) in enumerate(results):
            if lease.spec["seed"] == 1:
                free = payload.estimates["paper_free"]
                assert free is not None
                unknown = free.model_copy(update={"n": free.n.model_copy(update={"truth": None})})
                changed = {**payload.estimates, "paper_free": unknown}
                results[place] = (lease, payload.model_copy(update={"estimates": changed}))
        queue.store_all(results)
    return grid_id


def straightforward(database: Database, grid_id: str, estimate: str, quantity: str) -> list[tuple[Any, ...]]:
    """Input, runs, mean, sd and bias by the database's own averages over the results."""
    columns = [result.c[name] for name in GROUP_COLUMNS]
    values = [func.avg(result.c[f"{estimate}_{quantity}_{part}"]) for part in ("mean", "sd", "bias")]
    mine = select(*columns, func.count(), *values).where(result.c.grid_id == grid_id)
    with database.read() as connection:
        return [tuple(row) for row in connection.execute(mine.group_by(*columns).order_by(*columns))]


def scatter(database: Database, grid_id: str, estimate: str, quantity: str) -> dict[tuple[Any, ...], float]:
    from statistics import stdev

    columns = [result.c[name] for name in GROUP_COLUMNS]
    found: dict[tuple[Any, ...], list[float]] = {}
    with database.read() as connection:
        wanted = select(*columns, result.c[f"{estimate}_{quantity}_mean"]).where(result.c.grid_id == grid_id)
        for *place, mean in connection.execute(wanted):
            found.setdefault(tuple(place), []).append(mean)
    return {place: stdev(means) for place, means in found.items()}


OLD = ("paper_free", "paper_fixed", "projected_free", "projected_fixed")
"""The estimates of revisions before 0004."""


def check(database: Database, grid_id: str, estimates: Sequence[str] = ESTIMATES) -> None:
    summary = Summary.model_validate(GridStore(database).summary(grid_id, 1000))
    assert summary.n_stored == summary.n_runs == 3 * len(summary.rows)
    for estimate in estimates:
        for quantity in SUMMED:
            spread = scatter(database, grid_id, estimate, quantity)
            rows = straightforward(database, grid_id, estimate, quantity)
            for row, (*place, runs, mean, sd, bias) in zip(summary.rows, rows, strict=True):
                value = getattr(row.estimates[estimate], quantity)
                assert tuple(row.input.values()) == tuple(place)
                assert row.n_runs == runs
                # Sums in another order: rounding, nothing else.
                assert (value.mean, value.sd, value.bias) == pytest.approx((mean, sd, bias), rel=1e-12, abs=1e-12)
                assert value.scatter == pytest.approx(spread[tuple(place)], rel=1e-9)
            overall = getattr(summary.overall[estimate], quantity)
            with database.read() as connection:
                names = [result.c[f"{estimate}_{quantity}_{part}"] for part in ("bias", "sd")]
                wanted = connection.execute(select(*map(func.avg, names)).where(result.c.grid_id == grid_id)).one()
            assert (overall.bias, overall.sd) == pytest.approx(tuple(wanted), rel=1e-12, abs=1e-12)


def test_sums_give_the_straightforward_answer(database: Database) -> None:
    grid_id = stored(database)
    check(database, grid_id)


def test_a_migration_adds_up_what_was_stored_before(database: Database, url: str) -> None:
    grid_id = stored(database)
    with database.read() as connection:
        before = [tuple(row) for row in connection.execute(select(input_sum))]
    database.close()
    downgrade(url, "0002")
    upgrade(url)
    check(database, grid_id, OLD)
    summary = Summary.model_validate(GridStore(database).summary(grid_id, 1000))
    for row in summary.rows:
        assert {name for name, found in row.estimates.items() if found is not None} == set(OLD)
    assert {name for name, found in summary.overall.items() if found is not None} == set(OLD)
    with database.read() as connection:
        after = [tuple(row) for row in connection.execute(select(input_sum))]
    assert len(before) == len(after)
    assert GridStore(database).grid(grid_id).counts.done == 3 * len(after)


def test_a_run_without_an_answer_is_not_in_the_means(database: Database) -> None:
    request = GridRequest.model_validate({**BODY, "n": [2], "magnitude": [20.5]})
    grid_id = GridStore(database).create(request.canonical(), lambda: plan(request, 1000)).grid.id
    generation = Leadership(database).take("test")
    assert generation is not None
    queue, expected = RunQueue(database), []
    for lease in queue.claim(generation, 100):
        payload = result_of(lease)
        changed: dict[str, Any] = {**payload.estimates, "image_wide": None}
        if lease.spec["seed"] == 1:
            changed["paper_free"] = None
        else:
            found = payload.estimates["paper_free"]
            assert found is not None
            expected.append(found.magnitude.mean)
        queue.store(lease, payload.model_copy(update={"estimates": changed}))
    summary = Summary.model_validate(GridStore(database).summary(grid_id, 1000))
    (row,) = summary.rows
    answered = row.estimates["paper_free"]
    assert row.estimates["image_wide"] is None
    assert summary.overall["image_wide"] is None
    assert answered is not None
    assert (row.n_runs, answered.runs) == (3, 2)
    assert answered.magnitude.mean == pytest.approx(sum(expected) / 2)
    assert answered.magnitude.bias == pytest.approx(sum(expected) / 2 - 20.5)
    printed = Console(width=100, record=True)
    printed.print(summary_table(summary))
    assert "no estimate" in printed.export_text()


def test_a_grid_that_has_ended_shows_what_a_fresh_count_would(database: Database) -> None:
    grid_id = stored(database)
    grids = GridStore(database)
    kept = grids.grid(grid_id)
    downgraded = kept.model_dump(exclude={"rate_per_s"})
    from sqlalchemy import update

    from service.store.tables import grid

    with database.write() as connection:
        connection.execute(update(grid).values(ending=None))
    counted = grids.grid(grid_id)
    assert counted.model_dump(exclude={"rate_per_s"}) == downgraded
    assert counted.rate_per_s == pytest.approx(kept.rate_per_s)
