"""Bodies as they must be sent: UTF-8 JSON without a coding, each field of a table once."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from email.message import Message
from typing import Any

from fastapi import Request, Response
from fastapi.concurrency import run_in_threadpool

from engine import read_json
from service.api.problems import InvalidRequestError, UnsupportedBodyError
from service.api.threads import Route

_CHARSETS = frozenset({"utf-8", "utf8"})


class _ReadRequest(Request):
    """A request whose body has been read."""

    def __init__(self, request: Request, body: bytes, document: Any) -> None:
        super().__init__(request.scope, request.receive)
        self._read = body, document

    async def body(self) -> bytes:
        """The bytes as they were sent."""
        return self._read[0]

    async def json(self) -> Any:
        """What they say."""
        return self._read[1]


class JsonRoute(Route):
    """A route that takes a body only as JSON, and none at all where it need not have one."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """FastAPI's own handler behind the reading of the body."""
        handle = super().get_route_handler()
        if self.body_field is None:
            return handle
        is_required = self.body_field.field_info.is_required()

        async def read_and_handle(request: Request) -> Response:
            if not is_required and not await request.body():
                return await handle(_ReadRequest(request, b"", None))
            _require_json(request)
            body = await request.body()
            # Not here: a body of the largest size takes tenths of a second, in which nobody else would be served.
            # And not in FastAPI, which makes 400 without a place of whatever is raised while it reads.
            document = await run_in_threadpool(_read, body)
            return await handle(_ReadRequest(request, body, document))

        return read_and_handle


def _require_json(request: Request) -> None:
    for name in ("content-type", "content-encoding"):
        if len(request.headers.getlist(name)) > 1:
            raise InvalidRequestError("header", name, "given more than once")
    coding = request.headers.get("content-encoding", "identity").strip().lower()
    if coding != "identity":
        raise UnsupportedBodyError("content-encoding", coding, "none, or identity", {"Accept-Encoding": "identity"})
    given = request.headers.get("content-type", "")
    header = Message()
    header["content-type"] = given
    charset = header.get_param("charset", "utf-8")
    kind = given.partition(";")[0].strip().lower()
    if kind != "application/json" or str(charset).lower() not in _CHARSETS:
        raise UnsupportedBodyError("content-type", given, "application/json, in UTF-8", {"Accept": "application/json"})


def _read(body: bytes) -> Any:
    if not body:
        raise InvalidRequestError("body", "", "empty; allowed is a JSON object")
    try:
        text = body.decode("utf-8")
    except UnicodeDecodeError as error:
        raise InvalidRequestError("body", "", f"not UTF-8 at byte {error.start}") from error
    if text.startswith("\ufeff"):
        raise InvalidRequestError("body", "", "begins with a byte order mark; allowed is JSON alone")
    return read_json(text)
