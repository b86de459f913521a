"""/v1/results.csv, .ecsv, .parquet, .vot and .fits: the rows of /v1/results as one file, from one picture."""

from __future__ import annotations

import logging
import re
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime
from functools import partial
from threading import BoundedSemaphore
from typing import Annotated, Any, BinaryIO

from fastapi import APIRouter, HTTPException, Query, Response
from fastapi.responses import StreamingResponse
from pydantic import Field
from starlette.types import Receive, Scope, Send

from service.api.context import Service
from service.api.results import RowsQuery, given_filter, read_filter, wanted_estimates
from service.api.threads import Route
from service.domain.identifiers import GRID_PATTERN, utc_now
from service.exports.contents import Question, pieces, survey
from service.exports.formats import FORMATS, Format
from service.exports.spool import Spool, SpoolEndedError
from service.store.database import Database

router = APIRouter(prefix="/v1", tags=["answers"], route_class=Route)
_LOG = logging.getLogger(__name__)
_AT_A_TIME = 4
"""Exports that one process writes at a time; each has a connection of the pool of readers."""
_LONGEST_S = 600.0
"""A picture of the database is held no longer, since SQLite's log and PostgreSQL's dead rows grow meanwhile."""
_EXPORTS = ThreadPoolExecutor(_AT_A_TIME, "exports")
_places = BoundedSemaphore(_AT_A_TIME)


class ExportQuery(RowsQuery):
    """What an export is asked: the filters of /v1/results."""

    specs: bool = Field(default=False, description="With each run's specification, which hostlens replay reads")


class _SpooledFile(StreamingResponse):
    """What is being written, sent as it comes; the writer ends when the client does."""

    def __init__(self, spool: Spool, media_type: str, name: str) -> None:
        headers = {"Content-Disposition": f'attachment; filename="{name}"', "Cache-Control": "no-store"}
        super().__init__(_told(spool), media_type=media_type, headers=headers)
        self._spool = spool

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send it to its end."""
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._spool.abandon()


def _route(suffix: str, form: Format) -> Callable[..., Any]:
    async def export(service: Service, query: Annotated[ExportQuery, Query()]) -> Response:
        where, now = read_filter(query), utc_now()
        question = Question(where, given_filter(query), wanted_estimates(query), query.specs)
        places = _places
        if not places.acquire(blocking=False):
            raise HTTPException(503, f"{_AT_A_TIME} exports are being written already", headers={"Retry-After": "5"})
        spool = Spool(_LONGEST_S)
        writing = _EXPORTS.submit(spool.fill, partial(_write, service.database, question, form, now))
        writing.add_done_callback(lambda _: places.release())
        try:
            await spool.begun()
        except BaseException:
            spool.abandon()
            raise
        return _SpooledFile(spool, form.media_type, _name(question, suffix, now))

    export.__doc__ = (
        f"Results as {form.description}; all of them are of one picture of the database.\n\n"
        "Units, descriptions, engines, the filter and the time of the picture are in the file, where its format has "
        f"a place for them. Beyond {_AT_A_TIME} exports at a time in a process 503; what goes wrong after the first "
        "byte ends the connection, so that half a file is not taken for a whole one."
    )
    export.__name__ = f"export_{suffix}"
    return export


for _suffix, _form in FORMATS.items():
    _media = _form.media_type.partition(";")[0]
    router.add_api_route(
        f"/results.{_suffix}",
        _route(_suffix, _form),
        response_class=Response,
        responses={200: {"content": {_media: {"schema": {"type": "string", "format": "binary"}}}}},
    )


def _write(database: Database, question: Question, form: Format, now: datetime, sink: BinaryIO) -> None:
    with database.read() as connection:
        contents = survey(connection, question, now)
        form.write(pieces(connection, question, contents.columns), contents, sink)


async def _told(spool: Spool) -> AsyncIterator[bytes]:
    try:
        async for data in spool.read_all():
            yield data
    except SpoolEndedError as error:
        _LOG.error("an export was given up: %s", error)
        raise


def _name(question: Question, suffix: str, now: datetime) -> str:
    """A name that tells exports apart: the grid, where it is one, and the time of the picture."""
    grids = question.asked.get("grid", ())
    what = grids[0] if len(grids) == 1 and re.match(GRID_PATTERN, grids[0]) else "results"
    return f"hostlens-{what}-{now:%Y%m%dT%H%M%SZ}.{suffix}"
