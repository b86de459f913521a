"""Sums that are kept with every result give the answer of the straightforward query over all results."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest
from rich.console import Console
from sqlalchemy import Table, func, select, text

from service.cli.formatting import summary_table
from service.domain.payload import ESTIMATES, estimator_and_prior
from service.domain.requests import GridRequest, plan
from service.domain.views import Summary
from service.store.database import Database
from service.store.faults import MigrationError
from service.store.grids import GridStore
from service.store.leadership import Leadership
from service.store.migrate import downgrade, upgrade
from service.store.queue import RunQueue
from service.store.tables import GROUP_COLUMNS, SUMMED, WORK, estimate, grid_moments, input_group, input_moments, result
from tests.service.plans import result_of, submit

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


def answers(*columns: Any, grid_id: str, name: str) -> Any:
    """Columns of the answers of one estimator in a grid, each beside its result."""
    estimator, prior = estimator_and_prior(name)
    joined = select(*columns).join_from(result, estimate)
    return joined.where(result.c.grid_id == grid_id, estimate.c.estimator == estimator, estimate.c.index_prior == prior)


def straightforward(database: Database, grid_id: str, name: str, quantity: str) -> list[tuple[Any, ...]]:
    """Input, runs, mean, sd and bias by the database's own averages over the results."""
    columns = [result.c[name] for name in GROUP_COLUMNS]
    values = [func.avg(estimate.c[f"{quantity}_{part}"]) for part in ("mean", "sd", "bias")]
    mine = answers(*columns, func.count(), *values, grid_id=grid_id, name=name)
    with database.read() as connection:
        return [tuple(row) for row in connection.execute(mine.group_by(*columns).order_by(*columns))]


def scatter(database: Database, grid_id: str, name: str, quantity: str) -> dict[tuple[Any, ...], float]:
    from statistics import stdev

    columns = [result.c[name] for name in GROUP_COLUMNS]
    found: dict[tuple[Any, ...], list[float]] = {}
    with database.read() as connection:
        wanted = answers(*columns, estimate.c[f"{quantity}_mean"], grid_id=grid_id, name=name)
        for *place, mean in connection.execute(wanted):
            found.setdefault(tuple(place), []).append(mean)
    return {place: stdev(means) for place, means in found.items()}


OLD = ("paper_free", "paper_fixed", "projected_free", "projected_fixed")
"""The estimates of revisions before 0004."""


def check(database: Database, grid_id: str, estimates: Sequence[str] = ESTIMATES) -> None:
    summary = Summary.model_validate(GridStore(database).summary(grid_id, 1000))
    assert summary.n_stored == summary.n_runs == 3 * len(summary.rows)
    for name in estimates:
        for quantity in SUMMED:
            spread = scatter(database, grid_id, name, quantity)
            rows = straightforward(database, grid_id, name, quantity)
            for row, (*place, runs, mean, sd, bias) in zip(summary.rows, rows, strict=True):
                value = getattr(row.estimates[name], quantity)
                assert tuple(row.input.values()) == tuple(place)
                assert row.n_runs == runs
                # Sums in another order: rounding, nothing else.
                assert (value.mean, value.sd, value.bias) == pytest.approx((mean, sd, bias), rel=1e-12, abs=1e-12)
                assert value.scatter == pytest.approx(spread[tuple(place)], rel=1e-9)
            overall = getattr(summary.overall[name], quantity)
            with database.read() as connection:
                averages = [func.avg(estimate.c[f"{quantity}_{part}"]) for part in ("bias", "sd")]
                wanted = connection.execute(answers(*averages, grid_id=grid_id, name=name)).one()
            assert (overall.bias, overall.sd) == pytest.approx(tuple(wanted), rel=1e-12, abs=1e-12)


def test_sums_give_the_straightforward_answer(database: Database) -> None:
    grid_id = stored(database)
    check(database, grid_id)


def test_a_migration_adds_up_what_was_stored_before(database: Database, url: str) -> None:
    grid_id = stored(database)
    with database.read() as connection:
        before = len(connection.execute(select(input_group)).all())
    database.close()
    downgrade(url, "0002")
    upgrade(url)
    check(database, grid_id, OLD)
    summary = Summary.model_validate(GridStore(database).summary(grid_id, 1000))
    for row in summary.rows:
        assert {name for name, found in row.estimates.items() if found is not None} == set(OLD)
    assert {name for name, found in summary.overall.items() if found is not None} == set(OLD)
    with database.read() as connection:
        after = len(connection.execute(select(input_group)).all())
    assert before == after
    assert GridStore(database).grid(grid_id).counts.done == 3 * after


def rows_of(database: Database, *tables: Table) -> list[list[tuple[Any, ...]]]:
    with database.read() as connection:
        return [
            [tuple(row) for row in connection.execute(select(table).order_by(*table.primary_key))] for table in tables
        ]


def test_estimates_inputs_and_sums_go_through_the_wide_columns_and_back(database: Database, url: str) -> None:
    stored(database)
    exactly = rows_of(database, result, estimate)
    about = rows_of(database, input_moments, grid_moments)
    inputs = rows_of(database, input_group)
    database.close()
    downgrade(url, "0007")
    with database.read() as connection:
        wide = "select count(paper_free_magnitude_bias), count(paper_free_n_bias), sum(image_fixed_draws) from result"
        counted = connection.execute(text(wide)).one()
        kept = connection.execute(text("select sum(runs), sum(image_wide_runs) from input_sum")).one()
        whole = connection.execute(text("select runs, image_wide_runs from grid_sum")).one()
    runs = len(exactly[0])
    unknown = sum(row[result.c.keys().index("seed")] == 1 for row in exactly[0])
    assert tuple(counted) == (runs, runs - unknown, 30 * runs)
    assert tuple(kept) == tuple(whole) == (runs, runs)
    database.close()
    upgrade(url)
    # The database numbers inputs anew; everything else is as it was, sums but for rounding.
    again = rows_of(database, input_group)
    assert sorted(row[1:-2] for row in again[0]) == sorted(row[1:-2] for row in inputs[0])
    digests = [{row[0]: row[2] for row in found[0]} for found in (inputs, again)]
    for before, after in zip(exactly, rows_of(database, result, estimate), strict=True):
        names = (estimate if before is exactly[1] else result).c.keys()
        place = names.index("input_id")
        # What came with later revisions has no place in the wide columns: it is lost on the way, and absent.
        later = {place, *(k for k, name in enumerate(names) if name in WORK or "_error" in name)}
        for old, new in zip(before, after, strict=True):
            assert digests[0][old[place]] == digests[1][new[place]]
            kept = [k for k in range(len(names)) if k not in later]
            assert [old[k] for k in kept] == [new[k] for k in kept]
            assert {new[k] for k in later - {place}} == {None}
    for before, after in zip(about, rows_of(database, input_moments, grid_moments), strict=True):
        names = [digests[0].get(row[0], row[0]) for row in before], [digests[1].get(row[0], row[0]) for row in after]
        ordered = [
            dict(zip(zip(keys, (row[1:3] for row in rows), strict=True), (row[3:] for row in rows), strict=True))
            for keys, rows in zip(names, (before, after), strict=True)
        ]
        assert ordered[0].keys() == ordered[1].keys()
        for key, values in ordered[0].items():
            assert values == pytest.approx(ordered[1][key], rel=1e-9, abs=1e-12)


def test_a_run_without_a_chain_is_stored_and_shown(database: Database, url: str) -> None:
    submit(GridStore(database), 1)
    generation = Leadership(database).take("test")
    assert generation is not None
    (lease,) = RunQueue(database).claim(generation, 1)
    payload = result_of(lease)
    only = {name: found if name.startswith("image") else None for name, found in payload.estimates.items()}
    none = dict.fromkeys(("chain", "ln_evidence", "chi2", "degrees_of_freedom", "condition_number", "aperture"))
    RunQueue(database).store(lease, payload.model_copy(update={"estimates": only, **none, "lens": {}}))
    shown = GridStore(database).run(lease.run_id).result
    assert shown is not None
    assert (shown.chain, shown.ln_evidence, shown.chi2, shown.lens) == (None, None, None, {})
    assert [name for name, found in shown.estimates.items() if found is not None] == [
        "image_wide",
        "image_free",
        "image_fixed",
    ]
    summary = Summary.model_validate(GridStore(database).summary(lease.grid_id, 10))
    assert summary.overall["paper_wide"] is None
    assert summary.overall["image_wide"] is not None
    database.close()
    with pytest.raises(MigrationError, match="1 results have no chain"):
        downgrade(url, "0007")


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
