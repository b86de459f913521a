"""Small grids for the tests."""

from __future__ import annotations

from functools import cache
from typing import Any

from service.domain.payload import ResultPayload, read_payload
from service.domain.plan import PlannedRun
from service.domain.precision import Until
from service.domain.requests import GridRequest, plan
from service.store.grids import GridStore
from service.store.leases import Lease
from tests.service.tasks import synthetic_payload

BODY = {"preset": "h0licow-vi/HE0435", "n": [2], "magnitude": [20.5], "l_eta": [1.0], "r_eff": [0.39]}


def body(runs: int, seed: int = 0) -> dict[str, object]:
    """A request for ``runs`` runs of one input."""
    return {**BODY, "replicates": runs, "seed": seed}


@cache
def planned(runs: int, seed: int = 0) -> tuple[PlannedRun, ...]:
    return tuple(plan(GridRequest.model_validate(body(runs, seed)), 100_000))


def until(error: float, at_most: int, at_least: int = 3) -> Until:
    return Until(error=error, at_most=at_most, at_least=at_least)


def body_until(points: int, rule: Until) -> dict[str, object]:
    """A request for replicates of one or two inputs, until the rule ends them."""
    return {**BODY, "n": [2, 4][:points], "until": rule.model_dump()}


@cache
def planned_until(points: int, rule: Until) -> tuple[PlannedRun, ...]:
    return tuple(plan(GridRequest.model_validate(body_until(points, rule)), 100_000))


def submit_until(grids: GridStore, points: int, rule: Until, **more: Any) -> str:
    """Store a grid whose replicates end; its id."""
    return grids.create(body_until(points, rule), lambda: planned_until(points, rule), until=rule, **more).grid.id


def submit(grids: GridStore, runs: int, seed: int = 0) -> str:
    """Store a grid; its id."""
    return grids.create(body(runs, seed), lambda: planned(runs, seed)).grid.id


def result_of(lease: Lease) -> ResultPayload:
    return read_payload(synthetic_payload(lease.spec))
