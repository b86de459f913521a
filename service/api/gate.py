"""Who may come in: asked before anything of a request is read but its head."""

from __future__ import annotations

import ipaddress
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from typing import Annotated
from urllib.parse import quote, urlsplit

from fastapi import Depends, Request
from sqlalchemy.exc import DBAPIError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError
from starlette.datastructures import Headers
from starlette.responses import RedirectResponse, Response
from starlette.types import ASGIApp, Receive, Scope, Send

from service.api.problems import database_fault, forbidden, problem
from service.api.threads import QUICK, run_in
from service.domain.access import ANYBODY, Caller, ForbiddenError
from service.domain.access import Scope as Allowed
from service.store.grids import GridStore
from service.store.tokens import TokenStore

COOKIE = "hostlens_token"
LOGIN, LOGOUT = "/login", "/logout"
OPEN = frozenset({"/healthz", "/readyz", LOGIN, LOGOUT})
"""What answers whoever asks."""
_STATIC = "/static/"
_SAFE = frozenset({"GET", "HEAD", "OPTIONS"})
_CALLER = "hostlens.caller"


class Gate:
    """Answers 401 to whom no token lets in and 403 to whom it does not let so far; asks nobody without ``tokens``.

    A token comes in the header Authorization, or from a browser in a cookie. A browser sends its cookies, and reaches a
    service that asks for no token, on behalf of whatever page it shows: what changes anything is only taken from pages
    of this service. Where ``hosts`` are given, a request has to call the service by one of them, a name of loopback or
    one without a dot, else it is 421: another site's name may be made to lead here (DNS rebinding), and its pages would
    be taken for ours.
    """

    def __init__(self, app: ASGIApp, tokens: TokenStore | None, hosts: frozenset[str] | None = None) -> None:
        self.app = app
        self._tokens = tokens
        self._hosts = hosts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        request = Request(scope)
        try:
            refusal = await self._refusal(request)
        except ForbiddenError as error:
            refusal = forbidden(request, error)
        except (DBAPIError, PoolTimeoutError) as error:
            refusal = database_fault(request, error)
        if refusal is not None:
            if request.method not in _SAFE:
                # Its body is not wanted, however long it is.
                refusal.headers["Connection"] = "close"
            await refusal(scope, receive, send)
            return
        await self.app(scope, receive, send)

    async def _refusal(self, request: Request) -> Response | None:
        """The answer that ends it here, or None, with who asks on the request."""
        called = request.headers.get("host")
        if self._hosts is not None and called is not None and not _is_called(called, self._hosts):
            detail = f"the service is not called {called[:100]}; HOSTLENS_ALLOWED_HOSTS says what it is called"
            return problem(request, HTTPStatus.MISDIRECTED_REQUEST, detail)
        given, is_ambient = _given(request)
        if request.method not in _SAFE and is_ambient and not _is_own(request.headers):
            return problem(request, 403, "the request comes from a page of another site")
        path = request.scope["path"]
        if self._tokens is None:
            request.scope[_CALLER] = ANYBODY
            return None
        if path in OPEN or path.startswith(_STATIC) or request.method == "OPTIONS":
            return None
        caller = None if given is None else await run_in(QUICK, self._tokens.caller, given)
        if caller is None:
            return _unauthorised(request, is_wrong=given is not None)
        caller.require(Allowed.READ if request.method in _SAFE else Allowed.SUBMIT)
        request.scope[_CALLER] = caller
        return None


def _given(request: Request) -> tuple[str | None, bool]:
    """The token, and whether a browser sent it, or none, of its own accord."""
    headers = request.headers.getlist("authorization")
    if headers:
        kind, _, value = headers[0].partition(" ")
        return (value.strip() if len(headers) == 1 and kind.lower() == "bearer" else ""), False
    return _cookie(request.headers), True


def _cookie(headers: Headers) -> str | None:
    cookies: SimpleCookie = SimpleCookie()
    try:
        for header in headers.getlist("cookie"):
            cookies.load(header)
    except CookieError:
        return None
    return cookies[COOKIE].value if COOKIE in cookies else None


def _is_called(called: str, hosts: frozenset[str]) -> bool:
    """Whether the header Host names one of the hosts, or what nobody elsewhere can make lead here.

    That is loopback, and any name without a dot: it is of this machine or its network, never of somebody's site.
    """
    try:
        name = urlsplit(f"//{called}").hostname or ""
        if name in hosts or name.endswith(".localhost") or not {".", ":"} & set(name):
            return True
        return ipaddress.ip_address(name).is_loopback
    except ValueError:
        return False


def _is_own(headers: Headers) -> bool:
    """Whether a request comes from no page, or from one of this service."""
    site = headers.get("sec-fetch-site")
    if site is not None:
        return site in {"same-origin", "none"}
    origin = headers.get("origin")
    return origin is None or urlsplit(origin).netloc.lower() == headers.get("host", "").lower()


def _unauthorised(request: Request, *, is_wrong: bool) -> Response:
    if _is_for_a_reader(request):
        # Where to go on afterwards: an address of this service, as it was asked for.
        wanted = request.url.path + (f"?{request.url.query}" if request.url.query else "")
        return RedirectResponse(f"{LOGIN}?next={quote(wanted, safe='/')}", 303, {"Cache-Control": "no-store"})
    detail = "the token is not valid" if is_wrong else "a token is needed: Authorization: Bearer ..."
    challenge = 'Bearer realm="hostlens"' + (', error="invalid_token"' if is_wrong else "")
    return problem(request, 401, detail, headers={"WWW-Authenticate": challenge})


def _is_for_a_reader(request: Request) -> bool:
    """Whether a browser asks for a page."""
    return request.method in {"GET", "HEAD"} and "text/html" in request.headers.get("accept", "")


async def _caller(request: Request) -> Caller:
    caller = request.scope.get(_CALLER)
    if not isinstance(caller, Caller):
        raise TypeError(f"nobody asked who is at {request.scope['path']}")
    return caller


Asking = Annotated[Caller, Depends(_caller)]
"""Who asks, for a handler."""


def require_owner(caller: Caller, grids: GridStore, grid_id: str) -> None:
    """Let the owner of a grid pass, the administrator, and anybody where nobody is asked.

    Raises
    ------
    ForbiddenError, service.store.grids.NotFoundError
        It belongs to somebody else; there is none.
    """
    if caller is not ANYBODY:
        caller.require_owner(grids.owner(grid_id), f"grid {grid_id}")
