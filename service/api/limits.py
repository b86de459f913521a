"""What is refused before a handler sees it: large bodies, unknown query parameters."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any, Literal

from fastapi import Request
from fastapi.openapi.utils import get_openapi
from fastapi.routing import APIRoute
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from engine import SpecError
from service.api.problems import InvalidRequestError, problem

# As JSON writes them.
_PLAIN = {
    "integer": (re.compile(r"-?(0|[1-9][0-9]*)"), "a whole number in plain digits"),
    "boolean": (re.compile(r"true|false"), "true or false"),
    "number": (re.compile(r"-?(0|[1-9][0-9]*)(\.[0-9]+)?([eE][-+]?[0-9]+)?"), "a number in plain digits"),
}
_Schemas = dict[str, dict[str, Any]]
_DOCUMENTED: dict[tuple[Callable[..., Any], str], tuple[_Schemas, _Schemas]] = {}
"""What each route that was asked for documents, by its handler and address."""


class BodyLimit:
    """Answers 413 to a request whose body is larger than allowed, whether it says its length or not.

    One whose body does not come to its announced end is dropped: half a body may well be a whole document.

    The body is read here, and given on whole: a limit that strikes while a handler reads would come out as whatever
    error that handler makes of it. What is sent to a path of ``streamed`` has a handler that limits it itself.
    """

    def __init__(self, app: ASGIApp, max_bytes: int, streamed: frozenset[str] = frozenset()) -> None:
        self.app = app
        self.max_bytes = max_bytes
        self._streamed = streamed

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http" or scope["method"] in {"GET", "HEAD", "OPTIONS"} or scope["path"] in self._streamed:
            await self.app(scope, receive, send)
            return
        try:
            body = await self._body(scope, receive)
        except ClientDisconnect:
            # What came is not what was announced: no request, and nobody to be told.
            return
        if body is None:
            # Nobody reads on to where another request could begin.
            headers = {"Connection": "close"}
            answer = problem(Request(scope), 413, f"a body may have {self.max_bytes} bytes", headers=headers)
            await answer(scope, receive, send)
            return
        await self.app(scope, _replay(body, receive), send)

    async def _body(self, scope: Scope, receive: Receive) -> bytes | None:
        length = dict(scope["headers"]).get(b"content-length", b"0")
        if length.isdigit() and int(length[:20]) > self.max_bytes:
            return None
        body = bytearray()
        while True:
            message = await receive()
            if message["type"] == "http.disconnect":
                raise ClientDisconnect
            body += message.get("body", b"")
            if len(body) > self.max_bytes:
                return None
            if not message.get("more_body", False):
                return bytes(body)


def _replay(body: bytes, receive: Receive) -> Receive:
    sent = False

    async def replayed() -> Message:
        nonlocal sent
        if sent:
            return await receive()
        sent = True
        return {"type": "http.request", "body": body, "more_body": False}

    return replayed


async def known_parameters(request: Request) -> None:
    """Refuse query parameters that the endpoint does not document, and what is given twice or not as JSON writes it.

    A misspelt filter that is ignored would answer with everything, which looks like an answer. Of a header that is
    given twice FastAPI would take the first, of numbers also ``1_0``, `` 10`` and the digits of any script, and ``yes``
    for true.
    """
    route = request.scope["route"]
    key = (route.endpoint, route.path)
    if key not in _DOCUMENTED:
        _DOCUMENTED[key] = _documented(route)
    known, headers = _DOCUMENTED[key]
    for name in request.query_params:
        if name not in known:
            raise InvalidRequestError("query", name, f"unknown parameter; known are {sorted(known)}")
        _require_one("query", name, request.query_params.getlist(name), known[name])
    for name, schema in headers.items():
        _require_one("header", name, request.headers.getlist(name), schema)


def _documented(route: APIRoute) -> tuple[_Schemas, _Schemas]:
    """Schemas of the parameters in the query and in the headers, by name, as the document has them.

    Of this route alone: the whole document would be a fifth of what a process takes to answer its first request.
    """
    if not route.include_in_schema:
        # A page: it has parameters, and they are in no document.
        return {field.alias: {} for field in route.dependant.query_params}, {}
    (operations,) = get_openapi(title="", version="", routes=[route])["paths"].values()
    schemas: dict[str, _Schemas] = {"query": {}, "header": {}, "path": {}, "cookie": {}}
    for operation in operations.values():
        for found in operation.get("parameters", ()):
            schemas[found["in"]][found["name"]] = found["schema"]
    return schemas["query"], schemas["header"]


def _require_one(source: Literal["query", "header"], name: str, values: list[str], schema: dict[str, Any]) -> None:
    if len(values) > 1 and schema.get("type") != "array":
        raise InvalidRequestError(source, name, "given more than once")
    kinds = {kind.get("type") for kind in (schema, *schema.get("anyOf", ()))}
    for kind, (pattern, allowed) in _PLAIN.items():
        if kind in kinds and any(not pattern.fullmatch(value) for value in values):
            raise InvalidRequestError(source, name, str(SpecError(name, values[0], allowed)))
