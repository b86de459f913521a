"""/v1/summary, /v1/trends, /v1/comparison and /v1/results: answers over results of one, several or all grids."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args
from urllib.parse import urlencode

from fastapi import APIRouter, Query, Request, Response
from pydantic import BaseModel, ConfigDict, Field, StringConstraints, create_model
from pydantic_core import to_json

from service.api.answer_views import bias_view, difference_view, six
from service.api.context import Service
from service.api.freshness import NOT_MODIFIED, REVALIDATED, IfNoneMatch, is_known, not_modified, weak_tag
from service.api.pages import next_link
from service.api.problems import InvalidRequestError
from service.api.threads import Route, patient
from service.domain.answers import ComparisonAnswer, ResultPage, SummaryAnswer, TrendAnswer
from service.domain.identifiers import RUN_PATTERN
from service.domain.payload import ESTIMATES, QUANTITIES, RECOMMENDED, EstimateName, estimator_and_prior
from service.store.answers import (
    ANALYSES,
    TRENDS,
    Question,
    biases_by_group,
    compare,
    failures_by_group,
    failures_digest,
    first_runs,
    grouped,
    trend,
)
from service.store.bias_rows import content
from service.store.result_filter import AXES, NONE, FilterError, ResultFilter
from service.store.result_rows import QUANTITY_UNITS, result_columns, result_rows

router = APIRouter(prefix="/v1", tags=["answers"], route_class=Route)
ESTIMATORS = tuple(dict.fromkeys(estimator_and_prior(name)[0] for name in ESTIMATES))
PRIORS = tuple(dict.fromkeys(estimator_and_prior(name)[1] for name in ESTIMATES))
RECOMMENDED_PARTS = estimator_and_prior(RECOMMENDED)
_Text = Annotated[str, StringConstraints(min_length=1, max_length=200, pattern=r"^[^\x00]*$")]
_Values = Annotated[list[_Text], Field(max_length=1000)]
_CONFIG = ConfigDict(extra="forbid")

_filters: dict[str, Any] = {
    name: (_Values, Field(default=[], description=f"{axis.description}; repeated: any of them"
                          + ("; a range as 20..22" if axis.is_number else "")))
    for name, axis in AXES.items()
}  # fmt: skip
FilterQuery = create_model("FilterQuery", __config__=_CONFIG, **_filters)
if TYPE_CHECKING:
    FilterBody = BaseModel
else:
    FilterBody = FilterQuery


class AnswerQuery(FilterBody):
    """Which results, which quantity, by which estimator."""

    quantity: Literal[QUANTITIES] = "magnitude"  # type: ignore[valid-type]
    estimator: Literal[ESTIMATORS] = RECOMMENDED_PARTS[0]  # type: ignore[valid-type]
    index_prior: Literal[PRIORS] = RECOMMENDED_PARTS[1]  # type: ignore[valid-type]
    group_by: str = Field(default="", max_length=200, description=f"Comma-separated, of {', '.join(AXES)}")


class SummaryQuery(AnswerQuery):
    """What /v1/summary is asked."""

    group_by: str = Field(default="system", max_length=200, description=f"Comma-separated, of {', '.join(AXES)}")
    limit: int = Field(default=100, ge=1, le=1000)
    cursor: int = Field(default=0, ge=0, le=10_000_000, description="From Link or next")


class TrendQuery(AnswerQuery):
    """What /v1/trends is asked."""

    against: Literal[tuple(TRENDS)]  # type: ignore[valid-type]
    bins: int = Field(default=10, ge=1, le=100)


class ComparisonQuery(AnswerQuery):
    """What /v1/comparison is asked: the analyses differ in ``compare``, which is ``left`` or ``right``."""

    compare: Literal[ANALYSES]  # type: ignore[valid-type]
    left: _Text
    right: _Text


class RowsQuery(FilterBody):
    """Which results, with the answers of which estimator."""

    estimator: Literal[(*ESTIMATORS, "all")] = RECOMMENDED_PARTS[0]  # type: ignore[valid-type]
    index_prior: Literal[PRIORS] = RECOMMENDED_PARTS[1]  # type: ignore[valid-type]


class ResultQuery(RowsQuery):
    """What /v1/results is asked."""

    limit: int = Field(default=100, ge=1, le=1000)
    cursor: str | None = Field(default=None, pattern=RUN_PATTERN, description="From Link or next")


@router.get("/summary", response_model=SummaryAnswer, responses=NOT_MODIFIED)
@patient
def summary(
    request: Request,
    response: Response,
    service: Service,
    query: Annotated[SummaryQuery, Query()],
    if_none_match: IfNoneMatch = None,
) -> Response:
    """Biases by group over one, several or all grids: how large, how sure, how far the stated errors hold."""
    question, axes = _question(query), _axes(query.group_by)
    with service.database.read() as connection:
        # Failed runs are counted beside the results.
        tag = weak_tag(request, content(connection, question.where), failures_digest(connection))
        if is_known(tag, if_none_match):
            return not_modified(tag)
        groups = grouped(connection, question.where, axes)
        biases, answered = biases_by_group(connection, question, groups)
        failed, elsewhere = failures_by_group(connection, question.where, groups)
        page = range(query.cursor, min(query.cursor + query.limit, len(groups.values)))
        firsts = [first_runs(connection, groups.inputs[place]) for place in page]
    rows = [
        {
            "group": dict(zip(axes, groups.values[place], strict=True)),
            "stored": int(groups.runs[place]),
            "answered": int(answered[place]),
            "failed": int(failed[place]),
            "cpu_s": six(groups.cpu_s[place]),
            "bias": bias_view(biases, place),
            "run_ids": first,
            "links": {"results": _results_link(query, axes, groups.values[place])},
        }
        for place, first in zip(page, firsts, strict=True)
    ]
    following = str(page.stop) if page.stop < len(groups.values) else None
    answer = {
        "question": _asked(query, axes),
        "rows": rows,
        "failed_elsewhere": elsewhere,
        "next": next_link(request, response, following),
    }
    return _written(answer, tag, response)


@router.get("/trends", response_model=TrendAnswer, responses=NOT_MODIFIED)
@patient
def trends(
    request: Request,
    service: Service,
    query: Annotated[TrendQuery, Query()],
    if_none_match: IfNoneMatch = None,
) -> Response:
    """Biases against a property of the observation, as binned series: one for each group."""
    question, axes = _question(query), _axes(query.group_by)
    with service.database.read() as connection:
        tag = weak_tag(request, content(connection, question.where))
        if is_known(tag, if_none_match):
            return not_modified(tag)
        groups = grouped(connection, question.where, axes)
        found = trend(connection, question, groups, query.against, query.bins)
    series = []
    for place, values in enumerate(groups.values):
        cells = range(place * query.bins, (place + 1) * query.bins)
        bins = [
            {
                "low": six(found.edges[number]),
                "high": six(found.edges[number + 1]),
                "centre": six(found.centre[cell]),
                "bias": bias_view(found.biases, cell),
            }
            for number, cell in enumerate(cells)
            if found.biases.bias.number[cell]
        ]
        links = {"results": _results_link(query, axes, values)}
        series.append({"group": dict(zip(axes, values, strict=True)), "bins": bins, "links": links})
    answer = {
        "question": _asked(query, axes),
        "against": query.against,
        "against_unit": TRENDS[query.against][1],
        "series": series,
    }
    return _written(answer, tag)


@router.get("/comparison", response_model=ComparisonAnswer, responses=NOT_MODIFIED)
@patient
def comparison(
    request: Request,
    service: Service,
    query: Annotated[ComparisonQuery, Query()],
    if_none_match: IfNoneMatch = None,
) -> Response:
    """Two analyses of the same observations: the mean difference with its own error, which their scatter is not in."""
    question, axes = _question(query), _axes(query.group_by)
    left, right = (_side(query, name) for name in ("left", "right"))
    with service.database.read() as connection:
        tag = weak_tag(request, content(connection, question.where))
        if is_known(tag, if_none_match):
            return not_modified(tag)
        groups, found = compare(connection, question, query.compare, left, right, axes)
    rows = [
        {
            "group": dict(zip(axes, values, strict=True)),
            **difference_view(found, place),
            "links": {"results": _results_link(query, axes, values)},
        }
        for place, values in enumerate(groups.values)
        if found.difference.number[place]
    ]
    asked = {"compare": query.compare, "left": query.left, "right": query.right}
    return _written({"question": _asked(query, axes), **asked, "rows": rows}, tag)


@router.get("/results", response_model=ResultPage, responses=NOT_MODIFIED)
@patient
def results(
    request: Request,
    response: Response,
    service: Service,
    query: Annotated[ResultQuery, Query()],
    if_none_match: IfNoneMatch = None,
) -> Response:
    """Results as flat rows: what was put in, what one estimator (or each) recovered, and how the run went."""
    names = wanted_estimates(query)
    columns = result_columns(names)
    keys = [column.name for column in columns]
    where = read_filter(query)
    with service.database.read() as connection:
        tag = weak_tag(request, content(connection, where))
        if is_known(tag, if_none_match):
            return not_modified(tag)
        found = result_rows(connection, where, names, columns, after=query.cursor, limit=query.limit + 1)
        rows = [dict(zip(keys, row, strict=True)) for row in found]
    following = rows[query.limit - 1]["run_id"] if len(rows) > query.limit else None
    answer = {
        "columns": {column.name: {"unit": column.unit, "description": column.description} for column in columns},
        "items": rows[: query.limit],
        "next": next_link(request, response, following),
    }
    return _written(answer, tag, response)


def _written(answer: dict[str, Any], tag: str, response: Response | None = None) -> Response:
    headers = {} if response is None else dict(response.headers)
    return Response(to_json(answer), media_type="application/json", headers={**headers, "ETag": tag, **REVALIDATED})


def given_filter(query: BaseModel) -> dict[str, list[str]]:
    """Values of the filter by axis, those alone that were given."""
    return {name: getattr(query, name) for name in AXES if getattr(query, name)}


def read_filter(query: BaseModel) -> ResultFilter:
    """The results that a query means; an InvalidRequestError at the parameter that cannot be read."""
    try:
        return ResultFilter.read(given_filter(query))
    except FilterError as error:
        raise InvalidRequestError("query", error.parameter, str(error)) from error


def _question(query: AnswerQuery) -> Question:
    return Question(read_filter(query), query.quantity, query.estimator, query.index_prior)


def _axes(group_by: str) -> tuple[str, ...]:
    axes = tuple(group_by.split(",")) if group_by else ()
    for axis in axes:
        if axis not in AXES:
            raise InvalidRequestError("query", "group_by", f"group_by: got {axis!r}, allowed are {', '.join(AXES)}")
    if len(set(axes)) != len(axes):
        raise InvalidRequestError("query", "group_by", f"group_by: got {group_by!r}, allowed is each once")
    return axes


def _asked(query: AnswerQuery, axes: tuple[str, ...]) -> dict[str, Any]:
    return {
        "quantity": query.quantity,
        "unit": QUANTITY_UNITS[query.quantity],
        "estimator": query.estimator,
        "index_prior": query.index_prior,
        "recommended": (query.estimator, query.index_prior) == RECOMMENDED_PARTS,
        "group_by": list(axes),
        "filter": given_filter(query),
    }


def _side(query: ComparisonQuery, name: str) -> str | None:
    """A value of the analysis that is compared; None is the value that is not there."""
    value: str = getattr(query, name)
    allowed = {"estimator": ESTIMATORS, "index_prior": PRIORS}.get(query.compare)
    if allowed is not None and value not in allowed:
        raise InvalidRequestError("query", name, f"{name}: got {value!r}, allowed is one of {', '.join(allowed)}")
    if query.compare in AXES and getattr(query, query.compare):
        raise InvalidRequestError("query", query.compare, f"{query.compare} is what is compared, and no filter")
    return None if value == NONE and allowed is None else value


def wanted_estimates(query: RowsQuery) -> tuple[EstimateName, ...]:
    """The estimates whose answers the rows hold."""
    if query.estimator == "all":
        return ESTIMATES
    wanted = (query.estimator, query.index_prior)
    return tuple(name for name in get_args(EstimateName) if estimator_and_prior(name) == wanted)


def _results_link(query: AnswerQuery, axes: tuple[str, ...], values: tuple[Any, ...]) -> str:
    """The results behind one group's numbers."""
    wanted = given_filter(query) | {
        axis: [NONE if value is None else repr(value) if isinstance(value, float) else str(value)]
        for axis, value in zip(axes, values, strict=True)
    }
    answer = {"estimator": query.estimator, "index_prior": query.index_prior}
    return f"/v1/results?{urlencode({**wanted, **answer}, doseq=True)}"
