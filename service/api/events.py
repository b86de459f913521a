"""/v1/grids/{id}/events: pages, a long poll, and a stream of server-sent events."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import ExitStack
from typing import Annotated

from fastapi import APIRouter, Header, HTTPException, Query, Request, Response
from fastapi.responses import StreamingResponse
from fastapi.sse import KEEPALIVE_COMMENT, format_sse_event
from starlette.types import Receive, Scope, Send

from service.api.context import Context, GridId, Limit, Service
from service.api.hub import Feed, FullError
from service.api.links import link_grid
from service.api.pages import next_link
from service.api.threads import QUICK, Route, run_in
from service.domain.views import EventPage

router = APIRouter(prefix="/v1", tags=["grids"], route_class=Route)
_KEEP_ALIVE_S = 15.0
_BATCH = 100
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
    stream, nothing of which has been pruned since), then each event under its kind, to the end of the grid. As many
    streams and long polls may wait as a setting says; others are answered 429.
    """
    try:
        if _STREAM in request.headers.get("accept", ""):
            return await _stream(service, grid_id, last_event_id)
        page = await _await_events(service, grid_id, cursor, limit, wait)
    except FullError as error:
        raise HTTPException(429, str(error), headers={"Retry-After": "5"}) from error
    return page.model_copy(update={"next": next_link(request, response, page.next)})


async def _await_events(service: Context, grid_id: str, after: int, limit: int, wait: float) -> EventPage:
    page = await run_in(QUICK, service.events.page, grid_id, after, limit)
    if page.items or page.ended or not wait:
        return page
    with service.hub.follow(grid_id) as feed:
        news = await feed.next(after, limit, wait)
    cursor = news.told[-1].number if news.told else after
    # Where a page is full there may be more, which costs who asks an empty answer at worst.
    more = str(cursor) if len(news.told) == limit and not news.ended else None
    return EventPage(items=[told.view for told in news.told], cursor=cursor, ended=news.ended, next=more)


async def _stream(service: Context, grid_id: str, after: int | None) -> Response:
    with ExitStack() as stack:
        feed = stack.enter_context(service.hub.follow(grid_id))
        first = []
        # What came after the last event that was seen may have been pruned: then the whole state, as to a newcomer.
        if after is None or await run_in(QUICK, service.events.lacks, grid_id, after):
            # The number before the state: what comes between the two is told twice and not lost.
            after = await run_in(QUICK, service.events.latest, grid_id)
            grid = link_grid(await run_in(QUICK, service.grids.grid, grid_id))
            first = [format_sse_event(event="grid", id=str(after), data_str=grid.model_dump_json())]
        else:
            page = await run_in(QUICK, service.events.page, grid_id, after, 1)
            if page.ended and not page.items:
                return Response(status_code=204)
        return _EventStream(_chunks(feed, after, first), stack.pop_all())


class _EventStream(StreamingResponse):
    """A stream that leaves its place among the followers whatever becomes of the connection."""

    def __init__(self, chunks: AsyncIterator[bytes], place: ExitStack) -> None:
        super().__init__(chunks, media_type=_STREAM, headers={"Cache-Control": "no-store"})
        self._place = place

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send it to its end."""
        with self._place:
            await super().__call__(scope, receive, send)


async def _chunks(feed: Feed, after: int, first: list[bytes]) -> AsyncIterator[bytes]:
    for chunk in first:
        yield chunk
    while True:
        news = await feed.next(after, _BATCH, _KEEP_ALIVE_S)
        if news.told:
            after = news.told[-1].number
            yield b"".join(told.frame for told in news.told)
        if news.ended or feed.closed:
            return
        if not news.told:
            yield KEEPALIVE_COMMENT
