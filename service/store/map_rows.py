"""Runs of a grid with their biases, as the page of a grid shows them."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import Connection, and_, select

from service.store.result_filter import AXES
from service.store.tables import estimate, input_group, run


@dataclass(frozen=True)
class MapRow:
    """A run; ``bias`` of the magnitude by one estimator, None without an answer of it."""

    run_id: str
    label: str
    system: str
    state: str
    bias: float | None


def map_runs(connection: Connection, grid_id: str, estimator: str, prior: str, most: int) -> list[MapRow]:
    """The first ``most`` runs of a grid in its order."""
    mine = and_(estimate.c.run_id == run.c.id, estimate.c.estimator == estimator, estimate.c.index_prior == prior)
    wanted = (
        select(run.c.id, run.c.label, run.c.inputs["system"].as_string(), run.c.state, estimate.c.magnitude_bias)
        .select_from(run.outerjoin(estimate, mine))
        .where(run.c.grid_id == grid_id)
        .order_by(run.c.ordinal)
        .limit(most)
    )
    return [MapRow(*row) for row in connection.execute(wanted)]


def systems_of(connection: Connection, grid_id: str) -> list[str]:
    """Lens systems of which a grid has results."""
    wanted = select(input_group.c.system).where(input_group.c.grid_id == grid_id).distinct()
    return list(connection.scalars(wanted.order_by(input_group.c.system)))


def values_of(connection: Connection, axis: str) -> list[str]:
    """Values of an axis that results have, at most a hundred."""
    column = AXES[axis].column
    return list(connection.scalars(select(column).where(column.is_not(None)).distinct().order_by(column).limit(100)))
