"""/v1/grids and /v1/runs."""

from __future__ import annotations

import logging
from functools import cache, partial
from itertools import islice
from typing import Annotated, Any

from fastapi import APIRouter, Header, HTTPException, Query, Request, Response
from fastapi.responses import JSONResponse
from pydantic_core import to_json

from engine import engine_digest
from service.api.bodies import JsonRoute
from service.api.context import Context, GridId, Limit, RunId, Service
from service.api.downloads import artefact
from service.api.freshness import NOT_MODIFIED, REVALIDATED, IfNoneMatch, is_known, not_modified, weak_tag
from service.api.gate import Asking, require_owner
from service.api.hub import FullError
from service.api.links import compact_grids, link_document, link_grid, link_grids, link_run_items, link_runs
from service.api.pages import next_link
from service.api.retries import RetryRequest
from service.api.threads import patient
from service.api.waiting import GridWait, await_grid
from service.domain.identifiers import GRID_PATTERN
from service.domain.requests import GridRequest, plan
from service.domain.states import RunState
from service.domain.views import (
    CompactGridPage,
    CompactRunPage,
    DryRun,
    GridKind,
    GridPage,
    GridView,
    MeasurementView,
    RetriedGrid,
    RunDetail,
    RunPage,
    Summary,
)
from service.store.grids import Created
from service.store.runs import NotFoundError

router = APIRouter(prefix="/v1", tags=["grids"], route_class=JsonRoute)
_LOG = logging.getLogger(__name__)
IdempotencyKey = Annotated[
    str | None,
    Header(min_length=1, max_length=255, pattern=r"^[\x21-\x7e]+$", description="Same key, same grid"),
]
Compact = Annotated[bool, Query(description="Each item in short, with its addresses")]
Ordinal = Annotated[int, Query(ge=0, le=10_000_000, description="From Link or next")]
_PNG = {200: {"content": {"image/png": {"schema": {"type": "string", "format": "binary"}}}}}
_SHOWN_LABELS = 100


@router.post(
    "/grids",
    status_code=202,
    response_model=GridView,
    responses={200: {"model": DryRun, "description": "What a dry run would start"}},
)
def submit(
    body: GridRequest, service: Service, caller: Asking, dry_run: bool = False, idempotency_key: IdempotencyKey = None
) -> JSONResponse:
    """Accept a grid: once this answers 202 its runs are in the database.

    ``dry_run`` only checks, and tells what the grid should cost: CPU and wall seconds with an interval, by stored runs
    of the same cameras, configurations and profile.
    """
    if dry_run:
        runs = plan(body, service.settings.max_grid_runs)
        labels = [run.label for run in islice(runs, _SHOWN_LABELS)]
        cost = service.costs.cost(runs.kinds())
        found = DryRun(n_runs=len(runs), least_runs=runs.least, labels=labels, cost=cost)
        return JSONResponse(found.model_dump(mode="json"))
    planned = cache(lambda: plan(body, service.settings.max_grid_runs))
    made = service.grids.create(
        body.canonical(),
        planned,
        body.name,
        idempotency_key,
        engine_digest(),
        caller.name,
        lambda: service.costs.expected_wall_s(planned().kinds()),
        body.until,
    )
    return accepted(made, link_grid(made.grid))


def accepted(made: Created, document: GridView | MeasurementView) -> JSONResponse:
    """The answer to who asked for work: what it has become, and where that is."""
    _LOG.info("replayed" if made.replayed else "accepted", extra={"grid": made.grid.id, "runs": made.grid.n_runs})
    headers = {"Location": document.links["self"], "Idempotency-Replayed": str(made.replayed).lower()}
    return JSONResponse(document.model_dump(mode="json"), status_code=202, headers=headers)


@router.get("/grids")
def list_grids(
    request: Request,
    response: Response,
    service: Service,
    limit: Limit = 100,
    cursor: Annotated[str | None, Query(pattern=GRID_PATTERN, description="From Link or next")] = None,
    compact: Compact = False,
    kind: Annotated[GridKind, Query(description="measurement: of uploaded images, one run each")] = "simulation",
) -> GridPage | CompactGridPage:
    """Grids, newest first; those that measure uploaded images where they are asked for."""
    page = service.grids.grids(limit, cursor, with_requests=not compact, kind=kind)
    if compact:
        return CompactGridPage(items=compact_grids(page.items), next=next_link(request, response, page.next))
    return GridPage(items=link_grids(page.items), next=next_link(request, response, page.next))


@router.get("/grids/{grid_id}", response_model=GridView, responses=NOT_MODIFIED)
async def show_grid(
    request: Request, grid_id: GridId, service: Service, wait: GridWait = 0.0, if_none_match: IfNoneMatch = None
) -> Response:
    """One grid: its runs by state, rate and time left.

    With ``wait`` the answer is held back until the grid has ended, or, where If-None-Match names an earlier answer,
    until the grid differs from that; at most for so many seconds. As many may wait as a setting says; others are
    answered 429.
    """
    try:
        grid = await await_grid(service, grid_id, wait, partial(_is_awaited, request, if_none_match))
    except FullError as error:
        raise HTTPException(429, str(error), headers={"Retry-After": "5"}) from error
    tag = _grid_tag(request, grid)
    if is_known(tag, if_none_match):
        return not_modified(tag)
    return _written(link_grid(grid), {"ETag": tag, **REVALIDATED})


def _is_awaited(request: Request, if_none_match: str | None, grid: GridView) -> bool:
    """Whether who waits is to be told of this state of a grid."""
    if grid.finished_at is not None or if_none_match is None:
        return grid.finished_at is not None
    return not is_known(_grid_tag(request, grid), if_none_match)


def _grid_tag(request: Request, grid: GridView) -> str:
    marks = (grid.finished_at, grid.cancelled_at, grid.paused_at)
    return weak_tag(request, grid.state, grid.counts.model_dump(), *marks)


@router.get("/grids/{grid_id}/runs")
def list_runs(
    request: Request,
    response: Response,
    grid_id: GridId,
    service: Service,
    limit: Limit = 100,
    cursor: Ordinal | None = None,
    state: RunState | None = None,
    compact: Compact = False,
) -> RunPage | CompactRunPage:
    """A grid's runs in its order."""
    if compact:
        short = service.grids.run_items(grid_id, limit, -1 if cursor is None else cursor, state)
        return CompactRunPage(items=link_run_items(short.items), next=next_link(request, response, short.next))
    page = service.grids.runs(grid_id, limit, -1 if cursor is None else cursor, state)
    return RunPage(items=link_runs(page.items), next=next_link(request, response, page.next))


@router.get("/grids/{grid_id}/summary", response_model=Summary, responses=NOT_MODIFIED)
def summary(
    request: Request,
    response: Response,
    grid_id: GridId,
    service: Service,
    limit: Limit = 100,
    cursor: Ordinal = 0,
    if_none_match: IfNoneMatch = None,
) -> Response:
    """Recovered values and biases by input, and over the whole grid."""
    if if_none_match is not None:
        grid = service.grids.grid(grid_id)
        tag = weak_tag(request, grid.state, grid.counts.done)
        if is_known(tag, if_none_match):
            return not_modified(tag)
    found = service.grids.summary(grid_id, limit, cursor)
    found["next"] = next_link(request, response, found["next"])
    tag = weak_tag(request, found["state"], found["n_stored"])
    return _written(found, {**response.headers, "ETag": tag, **REVALIDATED})


def _written(document: Any, headers: dict[str, str] | None = None) -> Response:
    """Plain data, written at once: by way of its model every number would be checked before."""
    return Response(to_json(document), media_type="application/json", headers=headers)


@router.post("/grids/{grid_id}/cancel")
def cancel(grid_id: GridId, service: Service, caller: Asking) -> GridView:
    """Cancel a grid: queued runs at once, running ones as soon as the dispatcher sees it."""
    require_owner(caller, service.grids, grid_id)
    return link_grid(service.grids.cancel(grid_id))


@router.post("/grids/{grid_id}/pause")
def pause(grid_id: GridId, service: Service, caller: Asking) -> GridView:
    """Pause a grid: no queued run is started any more; running ones end as they would."""
    require_owner(caller, service.grids, grid_id)
    return link_grid(service.grids.pause(grid_id))


@router.post("/grids/{grid_id}/resume")
def resume(grid_id: GridId, service: Service, caller: Asking) -> GridView:
    """Resume a paused grid."""
    require_owner(caller, service.grids, grid_id)
    return link_grid(service.grids.resume(grid_id))


@router.post("/grids/{grid_id}/retry")
def retry(grid_id: GridId, service: Service, caller: Asking, body: RetryRequest | None = None) -> RetriedGrid:
    """Queue again every run that failed, was quarantined or was cancelled, with a fresh count of attempts.

    Or, with a body, those of them that it picks.
    """
    require_owner(caller, service.grids, grid_id)
    retried = service.grids.revive(grid_id, None if body is None else body.wanted())
    grid = link_grid(service.grids.grid(grid_id))
    return RetriedGrid(**dict(grid), retried=retried)


@router.get("/runs/{run_id}", response_model=RunDetail, responses=NOT_MODIFIED)
async def show_run(request: Request, run_id: RunId, service: Service, if_none_match: IfNoneMatch = None) -> Response:
    """One run: specification, state, result, attempts."""
    if if_none_match is not None:
        tag = weak_tag(request, *await service.reads.ask(service.grids.run_version, run_id))
        if is_known(tag, if_none_match):
            return not_modified(tag)
    version, body = await service.reads.ask(_run_body, service, run_id)
    return Response(body, media_type="application/json", headers={"ETag": weak_tag(request, *version), **REVALIDATED})


def _run_body(service: Context, run_id: str) -> tuple[tuple[Any, ...], bytes]:
    """What the document of a run changes with, and the document as it is sent: four hundred numbers, written once."""
    version = service.grids.run_version(run_id)
    body = service.runs.find((run_id, *version))
    if body is None:
        version, document = service.grids.run_document(run_id)
        body = to_json(link_document(document))
        service.runs.keep((run_id, *version), body)
    return version, body


@router.get("/runs/{run_id}/figure", response_class=Response, responses=_PNG)  # type: ignore[arg-type]
@patient
def figure(run_id: RunId, service: Service, if_none_match: Annotated[str | None, Header()] = None) -> Response:
    """Observation, model, normalised residual, source against truth, as PNG; 410 or 500 where it is gone or damaged."""
    found = service.grids.run(run_id).result
    if found is None or found.figure is None:
        raise NotFoundError(f"run {run_id} has no figure")
    return artefact(service.artefacts, found.figure, "image/png", if_none_match)
