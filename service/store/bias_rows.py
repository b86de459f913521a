"""Stored estimates one by one, as the engine's records of biases: what figures are drawn from."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import Connection, and_, func, select

from engine import BiasPoint, HostQuantity
from service.domain.bias_points import bias_point, point_columns
from service.store.result_filter import ResultFilter
from service.store.tables import estimate, input_group, result, run


@dataclass(frozen=True)
class MontageRun:
    """A run as its thumbnail tells of it: label, bias of the magnitude, key of its arrays."""

    label: str
    bias: float | None
    products: str | None


class TooManyPointsError(ValueError):
    """More results than a figure can show."""

    def __init__(self, allowed: int) -> None:
        super().__init__(f"results: got more than {allowed}, allowed are {allowed} in a figure; filter them")


def bias_points(
    connection: Connection,
    where: ResultFilter,
    estimator: str,
    priors: Sequence[str],
    quantities: Sequence[HostQuantity],
    most: int,
) -> list[BiasPoint]:
    """Answers of one estimator that have a truth for the first of the quantities, in no order.

    Raises
    ------
    TooManyPointsError
        There are more than ``most``.
    """
    here = {column.name: column for column in (*result.c, *estimate.c)}
    names = point_columns(quantities)
    columns = [here[name].label(name) for name in names]
    wanted = (
        select(*columns)
        .join_from(estimate, result, result.c.run_id == estimate.c.run_id)
        .where(estimate.c.estimator == estimator, estimate.c.index_prior.in_(priors))
        .where(estimate.c[f"{quantities[0]}_bias"].is_not(None))
        .limit(most + 1)
    )
    inputs = where.inputs()
    if inputs is not None:
        wanted = wanted.where(estimate.c.input_id.in_(inputs))
    points = [bias_point(dict(zip(names, row, strict=True)), quantities) for row in connection.execute(wanted)]
    if len(points) > most:
        raise TooManyPointsError(most)
    return points


def content(connection: Connection, where: ResultFilter) -> str:
    """A digest that changes with the results that are meant, without a look at each of them."""
    parts = (func.count(), func.sum(input_group.c.runs), func.max(input_group.c.id))
    sums = (func.sum(input_group.c.wall_s), func.sum(input_group.c.cpu_s))
    wanted = select(*parts, *sums)
    condition = where.conditions()
    row = connection.execute(wanted if condition is None else wanted.where(condition)).one()
    return hashlib.sha256(repr(tuple(row)).encode()).hexdigest()


def montage_runs(
    connection: Connection, where: ResultFilter, estimator: str, prior: str, most: int
) -> list[MontageRun]:
    """The first runs that are meant, in their order, with their bias by one estimator."""
    mine = and_(
        estimate.c.run_id == result.c.run_id, estimate.c.estimator == estimator, estimate.c.index_prior == prior
    )
    wanted = (
        select(run.c.label, estimate.c.magnitude_bias, result.c.products)
        .select_from(result.join(run, run.c.id == result.c.run_id).outerjoin(estimate, mine))
        .order_by(result.c.run_id)
        .limit(most)
    )
    inputs = where.inputs()
    if inputs is not None:
        wanted = wanted.where(result.c.input_id.in_(inputs))
    return [MontageRun(row.label, row.magnitude_bias, row.products) for row in connection.execute(wanted)]
