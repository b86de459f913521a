"""HEAD, OPTIONS and Allow: what every address answers beside the methods that it was written for."""

from __future__ import annotations

from fastapi import Request
from starlette.responses import Response
from starlette.routing import Match
from starlette.types import ASGIApp, Message, Receive, Scope, Send

_METHODS = ("DELETE", "GET", "PATCH", "POST", "PUT")


class Head:
    """Answers HEAD as GET is answered, without the body: a stream or long poll is asked for its head alone, too."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self.app(scope, receive, send)
            return
        inner = {**scope, "method": "GET"}
        answered = False

        async def send_head(message: Message) -> None:
            nonlocal answered
            if message["type"] == "http.response.start":
                await send(message)
                await send({"type": "http.response.body", "body": b"", "more_body": False})
                answered = True

        async def receive_until_answered() -> Message:
            # What goes on sending, as a stream does, takes this for a client that has gone.
            return {"type": "http.disconnect"} if answered else await receive()

        try:
            await self.app(inner, receive_until_answered, send_head)
        finally:
            scope["route"] = inner.get("route")


def allowed_methods(request: Request) -> list[str]:
    """The methods that this address has, over all routes: one route knows only its own."""
    scope = {"type": "http", "path": request.scope["path"], "root_path": request.scope.get("root_path", "")}
    found = {
        method
        for method in _METHODS
        if any(route.matches({**scope, "method": method})[0] is Match.FULL for route in request.app.routes)
    }
    return sorted(found | {"OPTIONS"} | ({"HEAD"} if "GET" in found else set()))


def options(allowed: list[str]) -> Response:
    """The answer to OPTIONS."""
    return Response(status_code=204, headers={"Allow": ", ".join(allowed)})
