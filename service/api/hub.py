"""The events of grids for everybody who waits for them: the database is asked once for all that follow a grid."""

from __future__ import annotations

import asyncio
import bisect
import logging
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import Context
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

from fastapi.sse import format_sse_event
from sqlalchemy.exc import DBAPIError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError

from service.api.threads import EVENTS, run_in
from service.domain.views import EventPage, EventView
from service.store.database import AWAY
from service.store.outbox import EventStore
from service.store.runs import NotFoundError

T = TypeVar("T")
_LOG = logging.getLogger(__name__)
_LOOK_S = 0.5
_PAGE = 500
_KEPT = 1000
"""Events of a grid that are kept; who is further behind reads them from the database, at his own pace."""


class FullError(RuntimeError):
    """As many as may are following already."""


class Told(NamedTuple):
    """An event as it is told: ``frame`` is its server-sent form, made once however many are told."""

    number: int
    view: EventView
    frame: bytes

    @classmethod
    def of(cls, view: EventView) -> Told:
        """Encode an event."""
        return cls(view.id, view, format_sse_event(event=view.kind, id=str(view.id), data_str=view.model_dump_json()))


@dataclass(frozen=True)
class News:
    """What came, in order; ``ended`` where nothing will follow."""

    told: Sequence[Told]
    ended: bool


class Feed:
    """The newest events of one grid, read while somebody follows it.

    Followers hold nothing but the number of the last event that they were told: a slow one costs no memory, and one
    that has fallen behind what is kept here misses nothing. Numbers of a grid are committed in their order (see
    ``EventStore``), so what was read once up to a number is complete.
    """

    def __init__(self, events: EventStore, grid_id: str) -> None:
        self._events = events
        self._grid_id = grid_id
        self._kept: deque[Told] = deque(maxlen=_KEPT)
        self._floor: int | None = None
        """All events above this number, up to the last look, are kept."""
        self._ended = False
        self._changed = asyncio.Event()
        self.closed = False
        self.followers = 0
        # In a context of its own: what is logged here is of no single request.
        self._task = asyncio.create_task(self._read_on(), context=Context())
        self._task.add_done_callback(self._is_done)

    @property
    def is_over(self) -> bool:
        """Whether nothing is read any more, so that a new follower needs another feed."""
        return self._task.done()

    async def next(self, after: int, limit: int, wait_s: float) -> News:
        """Up to ``limit`` events above a number: at once where there are any, else as soon as there are, or none."""
        until = time.monotonic() + wait_s
        while True:
            changed = self._changed
            if self._floor is not None:
                if after < self._floor:
                    page = await self._page(after, limit)
                    if page is None:
                        if time.monotonic() > until:
                            return News((), ended=False)
                        await asyncio.sleep(_LOOK_S)
                        continue
                    if page.items:
                        return News([Told.of(view) for view in page.items], ended=False)
                    after = self._floor
                told = self._above(after, limit)
                if told or self._ended:
                    return News(told, self._ended and (not told or told[-1] is self._kept[-1]))
            if self.closed:
                return News((), ended=False)
            try:
                async with asyncio.timeout(until - time.monotonic()):
                    await changed.wait()
            except TimeoutError:
                return News((), ended=False)

    def close(self) -> None:
        """Let everybody go who waits."""
        self.closed = True
        self._tell()

    def stop(self) -> None:
        """Read no further."""
        self._task.cancel()

    def _above(self, after: int, limit: int) -> list[Told]:
        first = bisect.bisect_right(self._kept, after, key=lambda told: told.number)
        return [self._kept[place] for place in range(first, min(first + limit, len(self._kept)))]

    def _tell(self) -> None:
        self._changed.set()
        self._changed = asyncio.Event()

    def _is_done(self, task: asyncio.Task[None]) -> None:
        if not task.cancelled() and (error := task.exception()) is not None:
            _LOG.error("events of %s cannot be read", self._grid_id, exc_info=error)
            self.close()

    async def _read_on(self) -> None:
        """Read on until the grid has ended; a database that is away is asked again."""
        after = 0
        while not self._ended:
            if self._floor is None and (latest := await self._look(self._events.latest)) is not None:
                after = self._floor = latest
                self._tell()
            page = None if self._floor is None else await self._page(after, _PAGE)
            if page is not None:
                self._take(page)
                after = page.cursor
            if page is None or page.next is None:
                await asyncio.sleep(_LOOK_S)

    async def _page(self, after: int, limit: int) -> EventPage | None:
        """Events of the database above a number, the end where the grid is no more; None while it is away."""
        try:
            return await self._look(self._events.page, after, limit)
        except NotFoundError:
            return EventPage(items=[], cursor=after, ended=True, next=None)

    async def _look(self, ask: Callable[..., T], *arguments: int) -> T | None:
        """What the database answers of this grid; None while it is away, so that whoever follows waits for it."""
        try:
            return await run_in(EVENTS, ask, self._grid_id, *arguments)
        except (DBAPIError, PoolTimeoutError) as error:
            if isinstance(error, DBAPIError) and not isinstance(error, AWAY):
                raise
            _LOG.warning("events of %s are not known now: %s", self._grid_id, error)
            return None

    def _take(self, page: EventPage) -> None:
        for view in page.items:
            if len(self._kept) == _KEPT:
                self._floor = self._kept[0].number
            self._kept.append(Told.of(view))
        self._ended = page.ended and page.next is None
        if page.items or self._ended:
            self._tell()


class Hub:
    """The feeds of one process; each lasts as long as somebody follows it."""

    def __init__(self, events: EventStore, most: int) -> None:
        self._events = events
        self._most = most
        self._followers = 0
        self._feeds: dict[str, Feed] = {}
        self._closed = False

    @contextmanager
    def follow(self, grid_id: str) -> Iterator[Feed]:
        """Be told of a grid.

        Raises
        ------
        FullError
            There are as many followers as there may be.
        """
        if self._followers >= self._most:
            raise FullError(f"{self._most} streams and long polls are waiting for events already")
        feed = self._feeds.get(grid_id)
        if feed is None or feed.is_over:
            feed = self._feeds[grid_id] = Feed(self._events, grid_id)
            if self._closed:
                feed.close()
        feed.followers += 1
        self._followers += 1
        try:
            yield feed
        finally:
            self._followers -= 1
            feed.followers -= 1
            if not feed.followers:
                feed.stop()
                if self._feeds.get(grid_id) is feed:
                    del self._feeds[grid_id]

    def close(self) -> None:
        """Let everybody go who follows a grid, now and from now on."""
        self._closed = True
        for feed in self._feeds.values():
            feed.close()
