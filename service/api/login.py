"""/login and /logout: a token as a cookie, for the pages."""

from __future__ import annotations

import html
from typing import Annotated
from urllib.parse import parse_qs, urlsplit

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse

from service.api.context import Service
from service.api.gate import COOKIE, LOGIN, LOGOUT
from service.api.problems import InvalidRequestError, UnsupportedBodyError, problem
from service.api.threads import QUICK, run_in

router = APIRouter(include_in_schema=False)
_FORM = "application/x-www-form-urlencoded"
_PRIVATE = {"Cache-Control": "no-store", "Content-Security-Policy": "default-src 'self'; form-action 'self'"}
_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>hostlens: log in</title><link rel="stylesheet" href="/static/style.css"></head>
<body><main><h1>hostlens</h1>{said}
<form method="post" action="/login"><input type="hidden" name="next" value="{next}">
<p><label>Token <input name="token" type="password" required autocomplete="current-password"></label>
<button>Log in</button></p></form>
<p>Whoever runs this service makes tokens: <code>hostlens token create</code>.</p></main></body></html>
"""
Next = Annotated[str, Query(max_length=2000, description="Where to go on")]


@router.get(LOGIN)
async def ask(next: Next = "/") -> Response:  # noqa: A002 - the parameter's name, as browsers bring it
    """The page that asks for a token."""
    return _page(next)


@router.post(LOGIN)
async def log_in(request: Request, service: Service) -> Response:
    """Keep a valid token in a cookie that no script can read and no other site can use."""
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != _FORM:
        raise UnsupportedBodyError("content-type", kind, _FORM, {"Accept-Post": _FORM})
    try:
        fields = parse_qs((await request.body()).decode("utf-8", "replace"), max_num_fields=10)
    except ValueError as error:
        raise InvalidRequestError("body", "", "more than ten fields; allowed are token and next") from error
    given = fields.get("token", [""])[-1].strip()
    wanted = fields.get("next", ["/"])[-1]
    if await run_in(QUICK, service.tokens.caller, given) is None:
        if "text/html" in request.headers.get("accept", ""):
            return _page(wanted, "<p role='alert'>This token is not valid.</p>", 401)
        return problem(request, 401, "the token is not valid", headers={"WWW-Authenticate": 'Bearer realm="hostlens"'})
    answer = RedirectResponse(_own(wanted), 303, {"Cache-Control": "no-store"})
    answer.set_cookie(COOKIE, given, httponly=True, samesite="strict", secure=request.url.scheme == "https", path="/")
    return answer


@router.post(LOGOUT)
async def log_out(request: Request) -> Response:
    """Forget the token."""
    answer = RedirectResponse(LOGIN, 303, {"Cache-Control": "no-store"})
    secure = request.url.scheme == "https"
    answer.delete_cookie(COOKIE, httponly=True, samesite="strict", secure=secure, path="/")
    return answer


def _own(address: str) -> str:
    """An address of this service, whatever a link that somebody else made says."""
    parts = urlsplit(address.replace("\\", "/"))
    is_path = not parts.scheme and not parts.netloc and parts.path.startswith("/") and not parts.path.startswith("//")
    return address if is_path and address.isprintable() and "\\" not in address else "/"


def _page(wanted: str, said: str = "", status: int = 200) -> Response:
    text = _PAGE.format(next=html.escape(_own(wanted)), said=said)
    return HTMLResponse(
        text, status, _PRIVATE | ({"WWW-Authenticate": 'Bearer realm="hostlens"'} if status == 401 else {})
    )
