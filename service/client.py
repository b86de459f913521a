"""A thin client of the API."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any, Self

import httpx

from service.schemas import EventPage, GridPage, GridView, Readiness, RunDetail, RunPage, RunView, Summary

_TIMEOUT_S = 60.0


class ApiError(RuntimeError):
    """The API refused a request; ``problem`` is its answer."""

    def __init__(self, status: int, problem: dict[str, Any]) -> None:
        lines = [problem.get("detail") or problem.get("title") or f"status {status}"]
        lines += [f"  {place.get('pointer')}: {place.get('message')}" for place in problem.get("errors", ())]
        super().__init__("\n".join(lines))
        self.status = status
        self.problem = problem


class Client:
    """Speaks to one service; a context manager that closes its connections.

    Every method makes one request (``runs`` one for each page, ``wait`` one for each look) and raises
    :class:`ApiError` where the service refuses, ``httpx.TransportError`` where there is none.
    """

    def __init__(self, url: str, transport: httpx.BaseTransport | None = None) -> None:
        self._http = httpx.Client(base_url=url, timeout=_TIMEOUT_S, transport=transport, trust_env=False)

    def __enter__(self) -> Self:
        """Use as a context."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the connections."""
        self._http.close()

    def submit(self, request: dict[str, Any], key: str | None = None) -> GridView:
        """Submit a grid; with ``key`` a repetition gives back the grid of the first time."""
        headers = {} if key is None else {"Idempotency-Key": key}
        return GridView.model_validate(self._call("POST", "/v1/grids", json=request, headers=headers))

    def status(self, grid_id: str) -> GridView:
        """How far a grid is."""
        return GridView.model_validate(self._call("GET", f"/v1/grids/{grid_id}"))

    def grids(self, limit: int = 20) -> GridPage:
        """The newest grids."""
        return GridPage.model_validate(self._call("GET", "/v1/grids", params={"limit": limit}))

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
        address: str | None = f"/v1/grids/{grid_id}/runs?limit=1000"
        while address is not None:
            page = RunPage.model_validate(self._call("GET", address))
            yield from page.items
            address = page.next

    def run(self, run_id: str) -> RunDetail:
        """One run with its result."""
        return RunDetail.model_validate(self._call("GET", f"/v1/runs/{run_id}"))

    def summary(self, grid_id: str) -> Summary:
        """Biases of a grid (the first thousand inputs)."""
        return Summary.model_validate(self._call("GET", f"/v1/grids/{grid_id}/summary", params={"limit": 1000}))

    def events(self, grid_id: str, after: int = 0, wait_s: float = 0.0) -> EventPage:
        """Events after number ``after``, oldest first; waits up to ``wait_s`` (30 at most) where there is none yet."""
        params = {"cursor": after, "wait": wait_s, "limit": 1000}
        return EventPage.model_validate(self._call("GET", f"/v1/grids/{grid_id}/events", params=params))

    def cancel(self, grid_id: str) -> GridView:
        """Cancel a grid."""
        return GridView.model_validate(self._call("POST", f"/v1/grids/{grid_id}/cancel"))

    def pause(self, grid_id: str) -> GridView:
        """Start no further run of a grid for now."""
        return GridView.model_validate(self._call("POST", f"/v1/grids/{grid_id}/pause"))

    def resume(self, grid_id: str) -> GridView:
        """Go on with a paused grid."""
        return GridView.model_validate(self._call("POST", f"/v1/grids/{grid_id}/resume"))

    def retry(self, grid_id: str) -> GridView:
        """Queue again what failed, was quarantined or was cancelled."""
        return GridView.model_validate(self._call("POST", f"/v1/grids/{grid_id}/retry"))

    def readiness(self) -> Readiness:
        """Whether the service can compute."""
        return Readiness.model_validate(self._call("GET", "/readyz"))

    def _call(self, method: str, address: str, **options: Any) -> Any:
        answer = self._http.request(method, address, **options)
        if answer.is_error:
            is_json = answer.headers.get("content-type", "").startswith("application/problem+json")
            raise ApiError(answer.status_code, answer.json() if is_json else {"title": answer.reason_phrase})
        return answer.json()
