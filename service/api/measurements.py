"""/v1/measurements: files in, measured by a worker, and what was found."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response
from starlette.datastructures import FormData, UploadFile
from starlette.requests import ClientDisconnect
from starlette.types import Message

from engine import engine_digest
from service.api.context import GridId, Limit, Service
from service.api.downloads import artefact
from service.api.freshness import NOT_MODIFIED, IfNoneMatch
from service.api.gate import Asking
from service.api.grids import IdempotencyKey, accepted
from service.api.links import link_measurement
from service.api.pages import next_link
from service.api.problems import InvalidRequestError, UnsupportedBodyError, problem
from service.api.threads import PATIENT, Route, patient, run_in
from service.domain.identifiers import GRID_PATTERN
from service.domain.measurements import (
    FILES,
    MeasurementOptions,
    OptionError,
    planned_measurement,
    require_consistent,
)
from service.domain.views import MeasurementPage, MeasurementView
from service.store.artefacts import ArtefactStore
from service.store.runs import NotFoundError

ADDRESS = "/v1/measurements"
router = APIRouter(prefix="/v1", tags=["measurements"], route_class=Route)
_MULTIPART = "multipart/form-data"
_MAX_FIELDS = 64
_MAX_FIELD_BYTES = 10_000
_CARD, _BLOCK = 80, 2880
_MAX_HEADER_BYTES = 2**21
_AT_ONCE = asyncio.Semaphore(2)
"""Files that a process sends to the artefact store at a time: a bucket's driver has them in memory meanwhile."""
_FILE = {"type": "string", "format": "binary"}
_OPTIONS = MeasurementOptions.model_json_schema()["properties"] | {
    "positions": {"type": "array", "items": {"type": "string"}, "description": "x,y of an AGN image, once for each"},
    "centre": {"type": "string", "description": "x,y of the deflector"},
}
_BODY = {
    "requestBody": {
        "required": True,
        "content": {
            _MULTIPART: {
                "schema": {
                    "type": "object",
                    "required": ["image"],
                    "additionalProperties": False,
                    "properties": {**dict.fromkeys(FILES, _FILE), **_OPTIONS},
                }
            }
        },
    }
}
_PNG: dict[int | str, dict[str, Any]] = {
    200: {"content": {"image/png": {"schema": {"type": "string", "format": "binary"}}}}
}


class UploadTooLargeError(ValueError):
    """A body is larger than a setting allows."""


@router.post("/measurements", status_code=202, response_model=MeasurementView, openapi_extra=_BODY)
async def submit(
    request: Request, service: Service, caller: Asking, idempotency_key: IdempotencyKey = None
) -> Response:
    """Measure the host galaxy in an uploaded image: a run as any other, with the options of ``hostlens measure``.

    Files are streamed to disk and on to the artefact store; here only their size and their header are looked at, and
    a worker parses them. The answer is a grid of one run: its events, cancel and retry are those of a grid.
    """
    try:
        async with _limited(request, service.settings.max_upload_bytes).form(
            max_files=len(FILES), max_fields=_MAX_FIELDS, max_part_size=_MAX_FIELD_BYTES
        ) as form:
            options, files = _taken_apart(form)
            keywords = {name: await run_in(PATIENT, _header, name, file) for name, file in files.items()}
            try:
                require_consistent(options, set(files), is_own="HOSTLENS" in keywords["image"])
            except OptionError as error:
                raise InvalidRequestError("body", f"/{error.field}", str(error)) from error
            uploads = {}
            for name, file in files.items():
                async with _AT_ONCE:
                    uploads[name] = await run_in(PATIENT, _put, service.artefacts, file)
    except UploadTooLargeError as error:
        return problem(request, 413, str(error), headers={"Connection": "close"})
    except ClientDisconnect:
        return problem(request, 400, "the body did not come to its end")
    planned = planned_measurement(options, uploads)
    asked = {"measurement": {"name": options.name, **planned.spec}}
    made = await run_in(
        PATIENT, service.grids.create, asked, lambda: (planned,), options.name, idempotency_key, engine_digest(),
        caller.name,
    )  # fmt: skip
    return accepted(made, link_measurement(await run_in(PATIENT, service.measurements.one, made.grid.id)))


@router.get("/measurements")
def list_measurements(
    request: Request,
    response: Response,
    service: Service,
    limit: Limit = 100,
    cursor: Annotated[str | None, Query(pattern=GRID_PATTERN, description="From Link or next")] = None,
) -> MeasurementPage:
    """Measurements without what they found, newest first."""
    page = service.measurements.page(limit, cursor)
    items = [link_measurement(item) for item in page.items]
    return MeasurementPage(items=items, next=next_link(request, response, page.next))


@router.get("/measurements/{grid_id}")
def show(grid_id: GridId, service: Service) -> MeasurementView:
    """One measurement; ``measurement`` is the JSON that ``hostlens measure`` writes, null before its end."""
    return link_measurement(service.measurements.one(grid_id))


@router.get(
    "/measurements/{grid_id}/figure",
    response_class=Response,
    responses={**_PNG, **NOT_MODIFIED},
)
@patient
def figure(grid_id: GridId, service: Service, if_none_match: IfNoneMatch = None) -> Response:
    """Image, model, normalised residual and source, as PNG."""
    key = service.measurements.one(grid_id).links.get("figure")
    if key is None:
        raise NotFoundError(f"measurement {grid_id} has no figure")
    return artefact(service.artefacts, key, "image/png", if_none_match)


def _limited(request: Request, most: int) -> Request:
    """The request, whose body may have so many bytes: an UploadTooLargeError once it has more."""
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != _MULTIPART:
        raise UnsupportedBodyError("content-type", kind, _MULTIPART, {"Accept": _MULTIPART})
    received = 0

    async def receive() -> Message:
        nonlocal received
        message = await request.receive()
        received += len(message.get("body", b""))
        if received > most:
            raise UploadTooLargeError(f"a body may have {most} bytes")
        return message

    return Request(request.scope, receive)


def _taken_apart(form: FormData) -> tuple[MeasurementOptions, dict[str, UploadFile]]:
    """Options and files of a form; what is not known, missing or there twice is refused."""
    files: dict[str, UploadFile] = {}
    options: dict[str, Any] = {}
    for name, value in form.multi_items():
        if isinstance(value, UploadFile) != (name in FILES):
            raise InvalidRequestError("body", f"/{name}", "a file" if isinstance(value, UploadFile) else "not a file")
        if isinstance(value, UploadFile) and name not in files:
            files[name] = value
        elif name == "positions" and isinstance(value, str):
            options.setdefault(name, []).append(value.split(","))
        elif name not in files and name not in options:
            options[name] = value
        else:
            raise InvalidRequestError("body", f"/{name}", "given more than once")
    if "image" not in files:
        raise InvalidRequestError("body", "/image", "missing; allowed is a FITS file")
    return MeasurementOptions.model_validate(options), files


def _header(name: str, upload: UploadFile) -> set[str]:
    """Keywords of a FITS file's first header; an InvalidRequestError where it is none (FITS 4.0, 3.3 and 4.4.1)."""
    upload.file.seek(0)
    keywords: set[str] = set()
    for block in iter(lambda: upload.file.read(_BLOCK), b""):
        cards = [block[at : at + _CARD] for at in range(0, len(block), _CARD)]
        if not keywords and not (cards[0].startswith(b"SIMPLE  =") and cards[0][9:30].split() == [b"T"]):
            break
        for card in cards:
            keyword = card[:8].rstrip().decode("ascii", "replace")
            if keyword == "END" and len(block) == _BLOCK:
                return keywords
            keywords.add(keyword)
        if upload.file.tell() > _MAX_HEADER_BYTES:
            break
    raise InvalidRequestError("body", f"/{name}", "not a FITS file; allowed is one that is not compressed")


def _put(store: ArtefactStore, upload: UploadFile) -> str:
    return store.put_file(upload.file, "fits").key
