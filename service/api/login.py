"""/login and /logout: a token as a cookie, for the pages."""

from __future__ import annotations

from typing import Annotated
from urllib.parse import parse_qs, urlsplit

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import RedirectResponse

from service.api.context import Service
from service.api.gate import COOKIE, LOGIN, LOGOUT
from service.api.problems import InvalidRequestError, UnsupportedBodyError, problem
from service.api.threads import QUICK, run_in
from service.web.rendering import page

router = APIRouter(include_in_schema=False)
_FORM = "application/x-www-form-urlencoded"
_PRIVATE = {"Cache-Control": "no-store"}
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
            return _page(wanted, 401)
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


def _page(wanted: str, status: int = 200) -> Response:
    is_wrong = status == 401
    headers = _PRIVATE | ({"WWW-Authenticate": 'Bearer realm="hostlens"'} if is_wrong else {})
    return page("login.html", status, headers, here="", next=_own(wanted), is_wrong=is_wrong)
