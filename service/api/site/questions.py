"""What pages ask of stored results: as the API's own answers do, with values as texts."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from service.api.answer_views import bias_view
from service.domain.payload import ESTIMATES, QUANTITIES, RECOMMENDED, estimator_and_prior
from service.store.answers import Question, biases_by_group, grouped
from service.store.database import Database
from service.store.result_filter import AXES, ResultFilter

if TYPE_CHECKING:
    AxisName: TypeAlias = str
    QuantityName: TypeAlias = str
    EstimateChoice: TypeAlias = str
else:
    AxisName, QuantityName, EstimateChoice = Literal[tuple(AXES)], Literal[QUANTITIES], Literal[ESTIMATES]
SHOWN_AXES = tuple(name for name in AXES if name != "grid")
DEFAULT_ESTIMATE = RECOMMENDED


def of_grid(grid_id: str) -> ResultFilter:
    """The results of one grid."""
    return ResultFilter.read({"grid": [grid_id]})


def question(where: ResultFilter, quantity: str, estimate: str) -> Question:
    """A question by the name of an estimate."""
    estimator, prior = estimator_and_prior(estimate)
    return Question(where, quantity, estimator, prior)


def group_name(value: Any) -> str:
    """A value of an axis, as a row's heading."""
    if value is None:
        return "none"
    return f"{value:g}" if isinstance(value, float) else str(value)


def summary_rows(
    database: Database, where: ResultFilter, axis: str, quantity: str, estimate: str, most: int
) -> tuple[list[dict[str, Any]], bool]:
    """Biases by the values of one axis, and whether there are more than ``most``."""
    with database.read() as connection:
        groups = grouped(connection, where, (axis,))
        biases, _ = biases_by_group(connection, question(where, quantity, estimate), groups)
    rows = [
        {"group": group_name(value), "bias": bias_view(biases, place)}
        for place, (value,) in enumerate(groups.values[:most])
    ]
    return rows, len(groups.values) > most
