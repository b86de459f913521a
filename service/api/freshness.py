"""ETag, If-None-Match and Cache-Control: who has an answer already is told so, and sent nothing."""

from __future__ import annotations

import hashlib
import json
from typing import Annotated, Any

from fastapi import Header, Request
from starlette.responses import Response

from service import VERSION

IfNoneMatch = Annotated[str | None, Header(max_length=4096, description="ETags of answers that are there already")]
REVALIDATED = {"Cache-Control": "private, no-cache"}
"""Kept by who asked alone, and asked for again each time."""
NOT_MODIFIED: dict[int | str, dict[str, Any]] = {304: {"description": "The client has this answer already"}}


def weak_tag(request: Request, *state: Any) -> str:
    """The ETag of an answer that is made of ``state``: weak, since what follows from the clock may differ."""
    # Whatever else the answer depends on: what was asked, and the code that answers.
    asked = sorted(item for item in request.query_params.multi_items() if item[0] != "wait")
    said = json.dumps([VERSION, request.scope["path"], asked, *state], default=str)
    return f'W/"{hashlib.sha256(said.encode()).hexdigest()[:32]}"'


def is_known(tag: str, if_none_match: str | None) -> bool:
    """Whether the client has it, by the weak comparison of RFC 9110, 13.1.2."""
    known = [given.strip().removeprefix("W/") for given in (if_none_match or "").split(",")]
    return tag.removeprefix("W/") in known or known == ["*"]


def not_modified(tag: str) -> Response:
    """The answer to who has it."""
    return Response(status_code=304, headers={"ETag": tag, **REVALIDATED})
