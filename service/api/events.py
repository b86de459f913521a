"""/v1/grids/{id}/events: pages, a long poll, and a stream of server-sent events."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from typing import Annotated

from fastapi import APIRouter, Header, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import StreamingResponse
from fastapi.sse import KEEPALIVE_COMMENT, format_sse_event

from service.api.context import Context, GridId, Limit, Service
from service.api.pages import next_link
from service.schemas import EventPage

router = APIRouter(prefix="/v1", tags=["grids"])
_LOOK_S = 0.5
_KEEP_ALIVE_S = 15.0
_BATCH = 1000
_STREAM = "text/event-stream"
_MAX_NUMBER = 2**62
Number = Annotated[int, Query(ge=0, le=_MAX_NUMBER, description="Number of the last event that was seen")]
Wait = Annotated[float, Query(ge=0.0, le=30.0, description="Seconds to wait for an event where there is none yet")]
LastEventId = Annotated[
    int | None, Header(ge=0, le=_MAX_NUMBER, description="As a browser sends it to resume a stream")
]
_ANSWERS = {
    200: {"content": {_STREAM: {"schema": {"type": "string"}}}},
    204: {"description": "A stream was asked for and nothing more will come: the grid has ended"},
}


@router.get("/grids/{grid_id}/events", response_model=EventPage, responses=_ANSWERS)  # type: ignore[arg-type]
async def list_events(
    request: Request,
    response: Response,
    grid_id: GridId,
    service: Service,
    limit: Limit = 100,
    cursor: Number = 0,
    wait: Wait = 0.0,
    last_event_id: LastEventId = None,
) -> EventPage | Response:
    """What has happened to a grid, oldest first.

    With ``wait`` an answer without events is held back until there is one or the grid has ended. With ``Accept:
    text/event-stream`` a stream: first an event ``grid`` with the whole state (unless Last-Event-ID resumes an earlier
    stream), then each event under its kind, to the end of the grid.
    """
    if _STREAM in request.headers.get("accept", ""):
        return await _stream(service, grid_id, last_event_id)
    page = await _await_events(service, grid_id, cursor, limit, wait)
    return page.model_copy(update={"next": next_link(request, response, page.next)})


async def _await_events(service: Context, grid_id: str, after: int, limit: int, wait: float) -> EventPage:
    until = time.monotonic() + wait
    while True:
        # The waiting is done here and not in a thread: there are few of those, and they serve everybody else.
        page = await run_in_threadpool(service.events.page, grid_id, after, limit)
        left = until - time.monotonic()
        if page.items or page.ended or left <= 0:
            return page
        await asyncio.sleep(min(_LOOK_S, left))


async def _stream(service: Context, grid_id: str, after: int | None) -> Response:
    first = []
    if after is None:
        # The number before the state: what comes between the two is told twice and not lost.
        after = await run_in_threadpool(service.events.latest, grid_id)
        grid = await run_in_threadpool(service.grids.grid, grid_id)
        first = [format_sse_event(event="grid", id=str(after), data_str=grid.model_dump_json())]
    page = await run_in_threadpool(service.events.page, grid_id, after, _BATCH)
    if page.ended and not page.items and not first:
        return Response(status_code=204)
    chunks = _chunks(service, grid_id, first, page)
    return StreamingResponse(chunks, media_type=_STREAM, headers={"Cache-Control": "no-store"})


async def _chunks(service: Context, grid_id: str, first: list[bytes], page: EventPage) -> AsyncIterator[bytes]:
    for chunk in first:
        yield chunk
    while True:
        for item in page.items:
            yield format_sse_event(event=item.kind, id=str(item.id), data_str=item.model_dump_json())
        if page.ended and not page.items:
            return
        if not page.items:
            yield KEEPALIVE_COMMENT
        page = await _await_events(service, grid_id, page.cursor, _BATCH, _KEEP_ALIVE_S)
