"""Forms are only taken from pages of this service: a browser sends them on behalf of whatever page it shows."""

from __future__ import annotations

from typing import Annotated
from urllib.parse import urlsplit

from fastapi import Depends, HTTPException, Request


async def _own_page(request: Request) -> None:
    site = request.headers.get("sec-fetch-site")
    origin = request.headers.get("origin")
    is_own = site in {"same-origin", "none"} if site is not None else _is_here(origin, request)
    if not is_own:
        raise HTTPException(403, "the form comes from a page of another site")


def _is_here(origin: str | None, request: Request) -> bool:
    return origin is None or urlsplit(origin).netloc.lower() == request.headers.get("host", "").lower()


OwnPage = Annotated[None, Depends(_own_page)]
"""For a handler that changes something."""
