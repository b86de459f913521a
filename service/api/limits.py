"""What is refused before a handler sees it: large bodies, unknown query parameters."""

from __future__ import annotations

from fastapi import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.api.problems import InvalidRequestError, problem


class BodyLimit:
    """Answers 413 to a request whose body is larger than allowed, whether it says its length or not.

    The body is read here, and given on whole: a limit that strikes while a handler reads would come out as whatever
    error that handler makes of it.
    """

    def __init__(self, app: ASGIApp, max_bytes: int) -> None:
        self.app = app
        self.max_bytes = max_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http" or scope["method"] in {"GET", "HEAD", "OPTIONS"}:
            await self.app(scope, receive, send)
            return
        body = await self._body(scope, receive)
        if body is None:
            answer = problem(Request(scope), 413, f"a body may have {self.max_bytes} bytes")
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
            body += message.get("body", b"")
            if len(body) > self.max_bytes:
                return None
            if message["type"] == "http.disconnect" or not message.get("more_body", False):
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


def known_parameters(request: Request) -> None:
    """Refuse query parameters that the endpoint does not document, and ones given twice.

    A misspelt filter that is ignored would answer with everything, which looks like an answer.
    """
    route = request.scope["route"]
    operation = request.app.openapi()["paths"][route.path][request.method.lower()]
    known = {found["name"] for found in operation.get("parameters", ()) if found["in"] == "query"}
    seen = set()
    for name, _ in request.query_params.multi_items():
        if name not in known:
            raise InvalidRequestError("query", name, f"unknown parameter; known are {sorted(known)}")
        if name in seen:
            raise InvalidRequestError("query", name, "given more than once")
        seen.add(name)
