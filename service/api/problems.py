"""Every error as RFC 9457 problem+json, with the list of places; never a traceback."""

from __future__ import annotations

import json
import logging
from http import HTTPStatus
from typing import Any, Literal
from urllib.parse import quote

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from pydantic import ValidationError
from sqlalchemy.exc import DBAPIError, SQLAlchemyError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError
from starlette.exceptions import HTTPException

from engine import SpecError, complaint, field_path, path_steps, spec_error
from service.api.methods import allowed_methods, options
from service.domain.access import ForbiddenError
from service.domain.requests import TooManyRunsError
from service.domain.views import Place, Problem
from service.store.database import AWAY
from service.store.faults import AccessRefusedError, SchemaMismatchError, StatementTooLongError
from service.store.grids import KeyReusedError
from service.store.runs import NotFoundError
from service.store.submission import SubmissionLostError
from service.web.rendering import page, wants_page

MEDIA_TYPE = "application/problem+json"
_LOG = logging.getLogger(__name__)
_SOURCES: dict[str, Literal["body", "query", "path", "header"]] = {
    "body": "body",
    "query": "query",
    "path": "path",
    "header": "header",
}


class InvalidRequestError(ValueError):
    """A request is not acceptable at one place."""

    def __init__(self, source: Literal["body", "query", "path", "header"], pointer: str, message: str) -> None:
        super().__init__(message)
        self.place = Place.model_validate({"in": source, "pointer": pointer, "message": message})


class UnsupportedBodyError(ValueError):
    """A body comes in a form that is not read here: which header says so, and what it may be."""

    def __init__(self, header: str, value: str, allowed: str, accepted: dict[str, str]) -> None:
        super().__init__(str(SpecError(header, value, allowed)))
        self.place = Place.model_validate({"in": "header", "pointer": header, "message": str(self)})
        self.accepted = accepted
        """The header by which the answer says what is read (RFC 9110, 15.5.16)."""


def problem(
    request: Request | None,
    status: int,
    detail: str | None = None,
    errors: list[Place] | None = None,
    headers: dict[str, str] | None = None,
    artefact: str | None = None,
) -> Response:
    """The answer to a request that failed."""
    body = Problem(
        title=HTTPStatus(status).phrase,
        status=status,
        detail=detail and _printable(detail),
        instance=None if request is None else _instance(request),
        artefact=artefact,
        errors=errors or [],
    )
    if request is not None and wants_page(request):
        return page("problem.html", status, headers, here="", problem=body)
    document = body.model_dump(mode="json", by_alias=True, exclude_none=True)
    # In ASCII, with everything else escaped: what a client sent comes back in it, whatever it does to a terminal.
    return Response(json.dumps(document), status_code=status, headers=headers, media_type=MEDIA_TYPE)


def install(app: FastAPI) -> None:
    """Answer every exception of an app with a problem."""
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_exception_handler(InvalidRequestError, _invalid_place)
    app.add_exception_handler(UnsupportedBodyError, _unsupported)
    app.add_exception_handler(SpecError, _bad_spec)
    app.add_exception_handler(ValidationError, _bad_model)
    app.add_exception_handler(TooManyRunsError, _too_many)
    app.add_exception_handler(NotFoundError, _not_found)
    app.add_exception_handler(KeyReusedError, _key_reused)
    app.add_exception_handler(ForbiddenError, forbidden)
    app.add_exception_handler(SubmissionLostError, _lost)
    app.add_exception_handler(HTTPException, _http)
    app.add_exception_handler(DBAPIError, database_fault)
    app.add_exception_handler(PoolTimeoutError, database_fault)
    app.add_exception_handler(SQLAlchemyError, _unexpected)
    app.add_exception_handler(Exception, _unexpected)


def _printable(text: str) -> str:
    """Text that UTF-8 can carry: a client may send lone surrogates, and be told of them."""
    return text.encode("utf-8", "replace").decode("utf-8")[:2000]


def _instance(request: Request) -> str:
    """The address as it was sent: percent-encoded, so in ASCII."""
    raw: bytes = request.scope.get("raw_path") or quote(request.scope["path"]).encode()
    return raw.decode("ascii", "replace")[:2000]


def _pointer(parts: tuple[Any, ...]) -> str:
    steps = (str(part).replace("~", "~0").replace("/", "~1") for part in parts)
    return _printable("".join(f"/{step}" for step in steps))


def _place(error: dict[str, Any]) -> Place:
    (source, *steps), value, allowed = complaint(error)
    where = _SOURCES.get(str(source), "body")
    pointer = _pointer(tuple(steps)) if where == "body" else _printable(".".join(map(str, steps)))
    message = str(SpecError(field_path(steps) if where == "body" else pointer, value, allowed))
    return Place.model_validate({"in": where, "pointer": pointer, "message": _printable(message)})


def _invalid(request: Request, error: Exception) -> Response:
    places = [_place(found) for found in getattr(error, "errors", list)()]
    return problem(request, 422, "the request is not acceptable; see errors", places[:100])


def _invalid_place(request: Request, error: Exception) -> Response:
    place: Place | None = getattr(error, "place", None)
    return problem(request, 422, str(error), [place] if place else [])


def _unsupported(request: Request, error: Exception) -> Response:
    if not isinstance(error, UnsupportedBodyError):  # pragma: no cover - registered for this type alone
        raise error
    return problem(request, 415, str(error), [error.place], error.accepted)


def _bad_spec(request: Request, error: Exception) -> Response:
    pointer = _pointer(path_steps(str(getattr(error, "field", ""))))
    place = Place.model_validate({"in": "body", "pointer": pointer, "message": _printable(str(error))})
    return problem(request, 422, str(error), [place])


def _bad_model(request: Request, error: Exception) -> Response:
    if not isinstance(error, ValidationError):  # pragma: no cover - registered for this type alone
        raise error
    return _bad_spec(request, spec_error(error))


def _too_many(request: Request, error: Exception) -> Response:
    place = Place.model_validate({"in": "body", "pointer": "/replicates", "message": str(error)})
    return problem(request, 422, str(error), [place])


def _not_found(request: Request, error: Exception) -> Response:
    return problem(request, 404, str(error))


def forbidden(request: Request, error: Exception) -> Response:
    """The answer to somebody who is known and may not do this."""
    if not isinstance(error, ForbiddenError):  # pragma: no cover - registered for this type alone
        raise error
    challenge = f'Bearer realm="hostlens", error="insufficient_scope", scope="{error.scope}"'
    return problem(request, 403, str(error), headers={"WWW-Authenticate": challenge})


def _key_reused(request: Request, _: Exception) -> Response:
    message = "this Idempotency-Key was used for another request"
    place = Place.model_validate({"in": "header", "pointer": "idempotency-key", "message": message})
    return problem(request, 422, message, [place])


def _lost(request: Request, error: Exception) -> Response:
    return problem(request, 503, str(error), headers={"Retry-After": "1"})


def _http(request: Request, error: Exception) -> Response:
    if not isinstance(error, HTTPException):  # pragma: no cover - registered for this type alone
        raise error
    headers = dict(error.headers or {})
    if error.status_code == 405:
        allowed = allowed_methods(request)
        if request.method == "OPTIONS":
            return options(allowed)
        headers["Allow"] = ", ".join(allowed)
    return problem(request, error.status_code, error.detail, headers=headers)


def database_fault(request: Request, error: Exception) -> Response:
    """The answer where the database raised an error."""
    # Programming errors and broken constraints are ours; everything else means that the database cannot serve now.
    if not isinstance(error, (*AWAY, PoolTimeoutError)):
        return _unexpected(request, error)
    status, detail = _database_told(error)
    _LOG.error("%s: %s", detail, error)
    return problem(request, status, detail, headers={"Retry-After": "5"})


def _database_told(error: Exception) -> tuple[int, str]:
    """Status and words for a database that cannot serve: which user or file it was is for the log alone."""
    if isinstance(error, StatementTooLongError):
        return 504, "the database did not come to an answer within the time that it allows for a statement"
    if isinstance(error, SchemaMismatchError):
        return 503, str(error)
    if isinstance(error, AccessRefusedError):
        return 503, "the database does not let this service in: user, password, name of the database or permissions"
    return 503, "the database is not available"


def _unexpected(request: Request, error: Exception) -> Response:
    _LOG.error("unexpected error at %s", request.url.path, exc_info=error)
    return problem(request, 500, "an unexpected error, which has been logged")
