"""/v1/figures and /v1/grids/{id}/figures: figures of biases, drawn from what is stored, as SVG and PNG."""

from __future__ import annotations

import hashlib
from dataclasses import astuple, dataclass
from typing import Annotated, Any, Literal, get_args

from fastapi import APIRouter, FastAPI, Header, Path, Query, Request, Response
from pydantic import Field

from engine import GROUPINGS, HOST_QUANTITIES, FigureError, NothingToShowError, engine_digest
from service import VERSION
from service.api.context import Context, GridId, Service
from service.api.problems import InvalidRequestError, problem
from service.api.results import FilterBody, read_filter
from service.api.threads import Route, patient
from service.domain.payload import RECOMMENDED, estimator_and_prior
from service.figures.apart import DrawingProcess
from service.figures.drawing import drawn
from service.figures.montage import montage, read_arrays
from service.figures.question import FIGURE_KINDS, FigureFormat, FigureKind, FigureQuestion, OfPoints, Prior
from service.store.bias_rows import TooManyPointsError, bias_points, content, montage_runs
from service.store.result_filter import ResultFilter
from service.store.runs import NotFoundError

router = APIRouter(prefix="/v1", tags=["figures"], route_class=Route)
_DRAWING = DrawingProcess()
_ESTIMATOR, _PRIOR = estimator_and_prior(RECOMMENDED)
_MEDIA: dict[str, str] = {"svg": "image/svg+xml", "png": "image/png"}
_MOST_POINTS = 50_000
_MOST_THUMBNAILS = 60
_PICTURE: dict[int | str, dict[str, Any]] = {
    200: {"content": {media: {"schema": {"type": "string", "format": "binary"}} for media in _MEDIA.values()}},
    304: {"description": "The client has it"},
}
IfNoneMatch = Annotated[str | None, Header()]
_KIND = "What to show: " + ", ".join(FIGURE_KINDS)


class FigureQuery(FilterBody):
    """Which results a figure shows, and how it is laid out."""

    estimator: Literal["image", "projected", "covariance", "paper"] = _ESTIMATOR  # type: ignore[assignment]
    index_prior: Literal[get_args(Prior)] = Field(  # type: ignore[valid-type]
        default=_PRIOR, description="Prior of n; bias and sample show n fixed beside it"
    )
    quantity: Literal[HOST_QUANTITIES] = Field(  # type: ignore[valid-type]
        default="magnitude", description="For coverage, pull and trends"
    )
    by: Literal[GROUPINGS] = Field(  # type: ignore[valid-type]
        default="system", description="What coverage, pull and trends group by; eight groups at most"
    )
    columns: int = Field(default=2, ge=1, le=8, description="Panels beside one another: 1 for a phone")
    limits: Literal["bands", "data"] = Field(default="bands", description="Magnitudes: the whole bands, or the points")


@dataclass(frozen=True)
class _Wanted:
    """A figure that is asked for: its question, its results, what stands above it."""

    question: FigureQuestion
    where: ResultFilter
    heading: str
    kind: FigureFormat
    grid_id: str | None = None


@router.get("/figures/{figure}.{kind}", response_class=Response, responses=_PICTURE)
@patient
def across_grids(
    figure: Annotated[OfPoints, Path(description=_KIND)],
    kind: FigureFormat,
    service: Service,
    query: Annotated[FigureQuery, Query()],
    if_none_match: IfNoneMatch = None,
) -> Response:
    """A figure over several grids, or all: ``bias`` needs a system. 404 where there is no result to show."""
    return _answer(service, _Wanted(_question(figure, query), read_filter(query), "", kind), if_none_match)


@router.get("/grids/{grid_id}/figures/{figure}.{kind}", response_class=Response, responses=_PICTURE)
@patient
def of_grid(
    grid_id: GridId,
    figure: Annotated[FigureKind, Path(description=_KIND)],
    kind: FigureFormat,
    service: Service,
    query: Annotated[FigureQuery, Query()],
    if_none_match: IfNoneMatch = None,
) -> Response:
    """A figure of one grid: ``bias`` needs a system where there are several. 404 where there is no result to show."""
    if query.grid:  # type: ignore[attr-defined]  # made of the axes
        raise InvalidRequestError("query", "grid", "grid: the address names one already")
    grid = service.grids.grid(grid_id)
    where = read_filter(query.model_copy(update={"grid": [grid_id]}))
    return _answer(service, _Wanted(_question(figure, query), where, grid.name or "", kind, grid_id), if_none_match)


def install(app: FastAPI) -> None:
    """Answer what cannot be drawn with a problem."""
    app.add_exception_handler(FigureError, _undrawable)
    app.add_exception_handler(TooManyPointsError, _undrawable)


def _undrawable(request: Request, error: Exception) -> Response:
    if isinstance(error, NothingToShowError):
        return problem(request, 404, "there is no result yet that this figure could show")
    return problem(request, 422, str(error))


def _question(figure: FigureKind, query: FigureQuery) -> FigureQuestion:
    return FigureQuestion(
        figure, query.estimator, query.index_prior, query.quantity, query.by, query.columns, query.limits
    )


def _answer(service: Context, wanted: _Wanted, if_none_match: str | None) -> Response:
    with service.database.read() as connection:
        state = content(connection, wanted.where)
    parts = (*astuple(wanted.question), repr(wanted.where), wanted.heading, wanted.kind, state)
    key = hashlib.sha256("\n".join(map(str, (VERSION, engine_digest(), *parts))).encode()).hexdigest()[:40]
    headers = {"ETag": f'"{key}"', "Cache-Control": "no-cache"}
    if if_none_match is not None and key in if_none_match:
        return Response(status_code=304, headers=headers)
    data = service.figures.get(key, lambda: _drawn(service, wanted))
    # Shown by itself an SVG is a document, and could run what it holds.
    headers["Content-Security-Policy"] = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
    return Response(data, media_type=_MEDIA[wanted.kind], headers=headers)


def _drawn(service: Context, wanted: _Wanted) -> bytes:
    question = wanted.question
    if question.kind == "montage":
        if wanted.grid_id is None:
            raise NotFoundError("a montage is of one grid")
        with service.database.read() as connection:
            runs = montage_runs(connection, wanted.where, question.estimator, question.free, _MOST_THUMBNAILS)
        arrays = read_arrays(runs, service.artefacts)
        return _DRAWING.call(montage, runs, arrays, wanted.heading, question.columns, wanted.kind)
    with service.database.read() as connection:
        points = bias_points(
            connection, wanted.where, question.estimator, question.priors, question.quantities, _MOST_POINTS
        )
    return _DRAWING.call(drawn, question, points, wanted.heading, wanted.kind)
