"""Pages: the cursor of the next one as an address, in the body and as a Link header."""

from __future__ import annotations

from urllib.parse import urlencode

from fastapi import Request, Response


def next_link(request: Request, response: Response, cursor: str | None) -> str | None:
    """Address of the page that begins after ``cursor``; also set as the header Link, relation next (RFC 8288)."""
    if cursor is None:
        return None
    query = [(name, value) for name, value in request.query_params.multi_items() if name != "cursor"]
    address = f"{request.url.path}?{urlencode([*query, ('cursor', cursor)])}"
    response.headers["Link"] = f'<{address}>; rel="next"'
    return address
