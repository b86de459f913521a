"""A thin client of the API."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Iterator
from typing import Any, Self, TypeVar
from urllib.parse import quote

import httpx
from pydantic import BaseModel, ValidationError

from service.domain.views import EventPage, GridPage, GridView, Readiness, RunDetail, RunPage, RunView, Summary

_TIMEOUT_S = 60.0


T = TypeVar("T", bound=BaseModel)


class ClientError(RuntimeError):
    """The service did not do what it was asked for."""


class ApiError(ClientError):
    """The API refused a request; ``problem`` is its answer."""

    def __init__(self, status: int, problem: dict[str, Any]) -> None:
        # The places say what the detail says as a whole.
        places = [f"{place.get('pointer') or place.get('in')}: {place.get('message')}" for place in _places(problem)]
        super().__init__("; ".join(places) or str(problem.get("detail") or problem.get("title") or f"status {status}"))
        self.status = status
        self.problem = problem


class AnswerError(ClientError):
    """Whatever answers there is no hostlens, or one that this client does not know."""


class RequestError(ClientError, ValueError):
    """The request cannot be sent: the address, the key or a value is not one."""


class Client:
    """Speaks to one service; a context manager that closes its connections.

    Every method makes one request (``runs`` one for each page, ``wait`` one for each look) and raises
    :class:`ApiError` where the service refuses, :class:`AnswerError` where it is something else, ``httpx.RequestError``
    where there is none, and :class:`RequestError` where there was nothing that could be sent.
    """

    def __init__(self, url: str, transport: httpx.BaseTransport | None = None) -> None:
        _require_address(url)
        self._url = _without_password(url)
        self._http = httpx.Client(base_url=url, timeout=_TIMEOUT_S, transport=transport, trust_env=False)

    def __enter__(self) -> Self:
        """Use as a context."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the connections."""
        self._http.close()

    def submit(self, request: dict[str, Any], key: str | None = None) -> GridView:
        """Submit a grid; with ``key`` a repetition gives back the grid of the first time."""
        headers = {"Content-Type": "application/json"}
        if key is not None:
            if not (key.isascii() and key.isprintable()):
                raise RequestError(f"the idempotency key is {key!r}, allowed are printable ASCII characters")
            headers["Idempotency-Key"] = key
        return self._call(GridView, "POST", "/v1/grids", content=_as_json(request), headers=headers)

    def status(self, grid_id: str) -> GridView:
        """How far a grid is."""
        return self._call(GridView, "GET", f"/v1/grids/{_part(grid_id)}")

    def grids(self, limit: int = 20) -> GridPage:
        """The newest grids."""
        return self._call(GridPage, "GET", "/v1/grids", params={"limit": limit})

    def wait(
        self,
        grid_id: str,
        seen: Callable[[GridView], None] = lambda _: None,
        every_s: float = 0.5,
        timeout_s: float | None = None,
    ) -> GridView:
        """Wait for the end of a grid, showing each look to ``seen``; TimeoutError where it takes too long."""
        until = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            grid = self.status(grid_id)
            seen(grid)
            if grid.finished_at is not None:
                return grid
            if until is not None and time.monotonic() > until:
                raise TimeoutError(f"grid {grid_id} is not done after {timeout_s} s")
            time.sleep(every_s)

    def runs(self, grid_id: str) -> Iterator[RunView]:
        """All runs of a grid, page by page."""
        address: str | None = f"/v1/grids/{_part(grid_id)}/runs?limit=1000"
        while address is not None:
            page = self._call(RunPage, "GET", address)
            yield from page.items
            address = page.next

    def run(self, run_id: str) -> RunDetail:
        """One run with its result."""
        return self._call(RunDetail, "GET", f"/v1/runs/{_part(run_id)}")

    def summary(self, grid_id: str) -> Summary:
        """Biases of a grid (the first thousand inputs)."""
        return self._call(Summary, "GET", f"/v1/grids/{_part(grid_id)}/summary", params={"limit": 1000})

    def events(self, grid_id: str, after: int = 0, wait_s: float = 0.0) -> EventPage:
        """Events after number ``after``, oldest first; waits up to ``wait_s`` (30 at most) where there is none yet."""
        params = {"cursor": after, "wait": wait_s, "limit": 1000}
        return self._call(EventPage, "GET", f"/v1/grids/{_part(grid_id)}/events", params=params)

    def cancel(self, grid_id: str) -> GridView:
        """Cancel a grid."""
        return self._call(GridView, "POST", f"/v1/grids/{_part(grid_id)}/cancel")

    def pause(self, grid_id: str) -> GridView:
        """Start no further run of a grid for now."""
        return self._call(GridView, "POST", f"/v1/grids/{_part(grid_id)}/pause")

    def resume(self, grid_id: str) -> GridView:
        """Go on with a paused grid."""
        return self._call(GridView, "POST", f"/v1/grids/{_part(grid_id)}/resume")

    def retry(self, grid_id: str) -> GridView:
        """Queue again what failed, was quarantined or was cancelled."""
        return self._call(GridView, "POST", f"/v1/grids/{_part(grid_id)}/retry")

    def readiness(self) -> Readiness:
        """Whether the service can compute."""
        return self._call(Readiness, "GET", "/readyz")

    def _call(self, kind: type[T], method: str, address: str, **options: Any) -> T:
        answer = self._http.request(method, address, **options)
        if answer.is_error:
            raise ApiError(answer.status_code, _problem(answer))
        try:
            return kind.model_validate_json(answer.content)
        except ValidationError:
            said = f"status {answer.status_code}, {answer.headers.get('content-type', 'no content type')}"
            raise AnswerError(f"what answers at {self._url} is not hostlens as this client knows it: {said}") from None


def _require_address(url: str) -> None:
    try:
        parsed = httpx.URL(url)
        acceptable = parsed.scheme in {"http", "https"} and bool(parsed.host) and (parsed.port or 1) < 65536
    except (httpx.InvalidURL, ValueError, TypeError):
        acceptable = False
    if not acceptable:
        raise RequestError(
            f"the address of the service is {_without_password(url)!r}, allowed is one as http://127.0.0.1:8421"
        )


def _without_password(url: str) -> str:
    return re.sub(r"//[^/]*@", "//***@", url)


def _part(identifier: str) -> str:
    """An identifier as a part of a path, whatever is in it."""
    try:
        return quote(identifier, safe="")
    except UnicodeEncodeError:
        raise RequestError(f"{identifier!r} is not an identifier") from None


def _as_json(request: dict[str, Any]) -> bytes:
    try:
        return json.dumps(request, ensure_ascii=False, allow_nan=False).encode()
    except UnicodeEncodeError:
        raise RequestError("the request holds text that is not Unicode") from None
    except (ValueError, RecursionError):
        raise RequestError("the request holds a number that is not finite, or is nested too deeply") from None


def _problem(answer: httpx.Response) -> dict[str, Any]:
    """What the API says of an error; where something else answers, the words of its status."""
    plain = {"title": f"status {answer.status_code} {answer.reason_phrase}".strip()}
    if not answer.headers.get("content-type", "").startswith("application/problem+json"):
        return plain
    try:
        said = answer.json()
    except (ValueError, RecursionError):
        return plain
    return said if isinstance(said, dict) else plain


def _places(problem: dict[str, Any]) -> list[dict[str, Any]]:
    places = problem.get("errors")
    return [place for place in places if isinstance(place, dict)] if isinstance(places, list) else []
