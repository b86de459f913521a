"""A client of the API, for Python and for the command line."""

from __future__ import annotations

import io
import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Self, TypeVar
from urllib.parse import quote

import httpx
from pydantic import BaseModel

from service.connection import AnswerError, ApiError, ClientError, Connection, RequestError, as_json, printable
from service.domain.answers import ComparisonAnswer, FrontierAnswer, ResultPage, SummaryAnswer, TrendAnswer
from service.domain.prediction_views import PredictionAnswer
from service.domain.views import (
    DryRun,
    EngineView,
    EventPage,
    GridPage,
    GridView,
    Readiness,
    RetriedGrid,
    RunDetail,
    RunPage,
    RunView,
    Summary,
)

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd
    from astropy.table import QTable
    from numpy.typing import NDArray

__all__ = ["AnswerError", "ApiError", "Client", "ClientError", "Filter", "RequestError"]
_TOO_MANY = 429
_LONGEST_WAIT_S = 30.0
_PAGE = 1000

T = TypeVar("T", bound=BaseModel)
Filter = str | float | Sequence[str | float]
"""One value of an axis or several, any of which will do; numbers also as a range, ``"20..22"``."""


class Client:
    """Speaks to one service; a context manager that closes its connections.

    Every method makes one request (``runs``, ``summary``, ``results``, ``table`` and ``to_pandas`` one for each page,
    ``wait`` one for each look) and raises :class:`ApiError` where the service refuses, :class:`AnswerError` where it is
    something else, ``httpx.RequestError`` where there is none, and :class:`RequestError` where there was nothing that
    could be sent.

    Parameters
    ----------
    url
        Address of the service, as ``http://127.0.0.1:8421``.
    token
        Sent with each request, where the service asks who comes.
    retries
        How often a request is repeated whose connection failed, with growing pauses from 0.1 s: those alone that may be
        carried out twice, which is all but ``submit`` without a key and ``retry``.
    transport
        What carries the requests, instead of connections.
    """

    def __init__(
        self,
        url: str,
        transport: httpx.BaseTransport | None = None,
        *,
        token: str | None = None,
        retries: int = 3,
    ) -> None:
        self._connection = Connection(url, transport, token, retries)

    @property
    def url(self) -> str:
        """Address of the service; a password in it is not shown."""
        return self._connection.url

    def __enter__(self) -> Self:
        """Use as a context."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the connections."""
        self._connection.close()

    def submit(self, request: Mapping[str, Any] | None = None, /, *, key: str | None = None, **fields: Any) -> GridView:
        """Submit a grid: the body of POST /v1/grids as a mapping, as keywords, or both, of which keywords count.

        ``until={"quantity": "magnitude", "error": 0.01, "at_most": 100}`` in the place of ``replicates`` ends the
        realizations of each point once its mean bias is known so well. With ``key`` a repetition gives back the grid
        of the first time, and a request that fails on its way is repeated.
        """
        headers = {"Content-Type": "application/json"}
        if key is not None:
            headers["Idempotency-Key"] = printable("idempotency key", key)
        content = as_json({**(request or {}), **fields})
        repeatable = key is not None
        return self._connection.call(GridView, "POST", "/v1/grids", repeatable, content=content, headers=headers)

    def dry_run(self, request: Mapping[str, Any] | None = None, /, **fields: Any) -> DryRun:
        """What :meth:`submit` would start; the service checks it in the same way."""
        content = as_json({**(request or {}), **fields})
        headers = {"Content-Type": "application/json"}
        return self._connection.call(
            DryRun, "POST", "/v1/grids", params={"dry_run": "true"}, content=content, headers=headers
        )

    def status(self, grid_id: str, wait_s: float = 0.0) -> GridView:
        """How far a grid is; waits up to ``wait_s`` (30 at most) for its end."""
        params = {"wait": wait_s} if wait_s else None
        return self._connection.call(GridView, "GET", f"/v1/grids/{_part(grid_id)}", params=params)

    def grids(self, limit: int = 20) -> GridPage:
        """The newest grids."""
        return self._connection.call(GridPage, "GET", "/v1/grids", params={"limit": limit})

    def wait(
        self,
        grid_id: str,
        seen: Callable[[GridView], None] = lambda _: None,
        every_s: float = 0.5,
        timeout_s: float | None = None,
    ) -> GridView:
        """Wait for the end of a grid, showing each look to ``seen``; TimeoutError where it takes too long."""
        return self.wait_all([grid_id], seen, every_s, timeout_s)[0]

    def wait_all(
        self,
        grid_ids: Iterable[str],
        seen: Callable[[GridView], None] = lambda _: None,
        every_s: float = 0.5,
        timeout_s: float | None = None,
    ) -> list[GridView]:
        """Wait for the end of several grids, which are given back in this order; as :meth:`wait`."""
        until = None if timeout_s is None else time.monotonic() + timeout_s
        return [self._ended(grid_id, seen, every_s, until) for grid_id in grid_ids]

    def _ended(self, grid_id: str, seen: Callable[[GridView], None], every_s: float, until: float | None) -> GridView:
        wait_s = 0.0
        while True:
            try:
                grid = self.status(grid_id, wait_s)
            except ApiError as error:
                if not wait_s or error.status != _TOO_MANY:
                    raise
                # As many as may are waiting: this one looks again by itself.
                time.sleep(every_s)
                grid = self.status(grid_id)
            seen(grid)
            if grid.finished_at is not None:
                return grid
            if until is not None and time.monotonic() > until:
                raise TimeoutError(
                    f"grid {grid_id} is not done in time: {grid.counts.ended} of {grid.n_runs} have ended"
                )
            wait_s = min(every_s, _LONGEST_WAIT_S)

    def runs(self, grid_id: str, state: str | None = None) -> Iterator[RunView]:
        """All runs of a grid, or those in a state, page by page."""
        only = "" if state is None else f"&state={_part(state)}"
        for page in self._pages(RunPage, f"/v1/grids/{_part(grid_id)}/runs?limit={_PAGE}{only}"):
            yield from page.items

    def run(self, run_id: str) -> RunDetail:
        """One run with its result."""
        return self._connection.call(RunDetail, "GET", f"/v1/runs/{_part(run_id)}")

    def grid_summary(self, grid_id: str) -> Summary:
        """Each input of a grid (the first thousand) with what all estimators recovered."""
        return self._connection.call(Summary, "GET", f"/v1/grids/{_part(grid_id)}/summary", params={"limit": _PAGE})

    def summary(self, *grid_ids: str, group_by: str | Sequence[str] = "system", **asked: Filter) -> SummaryAnswer:
        """Biases by group, over some grids or, without one, over all.

        ``group_by`` names axes, as ``"system,n"`` or ``["system", "n"]``; what else is ``asked`` are ``quantity``,
        ``estimator``, ``index_prior`` and filters by axis, as ``system="HE0435"``, ``n=[2, 4]``,
        ``magnitude="20..22"``.
        """
        asked = {**asked, "group_by": _joined(group_by), "limit": _PAGE}
        first, *further = self._pages(SummaryAnswer, _address("/v1/summary", grid_ids, asked))
        rows = [row for page in (first, *further) for row in page.rows]
        return first.model_copy(update={"rows": rows, "next": None})

    def trends(self, *grid_ids: str, against: str, group_by: str | Sequence[str] = "", **asked: Filter) -> TrendAnswer:
        """Biases in ``bins`` of a property of the observation, as ``arc_magnitude``; else as :meth:`summary`."""
        asked = {**asked, "against": against, "group_by": _joined(group_by)}
        return self._connection.call(TrendAnswer, "GET", _address("/v1/trends", grid_ids, asked))

    def comparison(
        self, *grid_ids: str, compare: str, left: str, right: str, group_by: str | Sequence[str] = "", **asked: Filter
    ) -> ComparisonAnswer:
        """Two analyses of the same observations, as ``compare="estimator", left="image", right="paper"``."""
        asked = {**asked, "compare": compare, "left": left, "right": right, "group_by": _joined(group_by)}
        return self._connection.call(ComparisonAnswer, "GET", _address("/v1/comparison", grid_ids, asked))

    def frontier(self, max_error: float, quantity: str = "magnitude", **asked: Filter) -> FrontierAnswer:
        """The cheapest profile whose numerical error stays below ``max_error``, by what stored runs predict.

        ``asked`` are ``estimator`` and ``index_prior``, and values of axes, as ``system="HE0435"``.
        """
        wanted: dict[str, Filter] = {"max_error": max_error, "quantity": quantity, **asked}
        return self._connection.call(FrontierAnswer, "GET", _address("/v1/frontier", (), wanted))

    def predict(self, request: Mapping[str, Any] | None = None, /, **fields: Any) -> PredictionAnswer:
        """Bias and scatter to be expected in a lens that nobody has simulated: the body of POST /v1/predictions.

        As ``system="HE0435", host={"n": 2, "r_eff": 0.4, "magnitude": 21}``, or ``traits={...}``; ``grids`` are those
        whose runs are to predict it beside the ones that come with hostlens.
        """
        content = as_json({**(request or {}), **fields})
        headers = {"Content-Type": "application/json"}
        return self._connection.call(
            PredictionAnswer, "POST", "/v1/predictions", True, content=content, headers=headers
        )

    def results(self, *grid_ids: str, **asked: Filter) -> Iterator[dict[str, Any]]:
        """Each result as a flat row, over some grids or over all; ``asked`` as in :meth:`summary`.

        ``estimator="all"`` gives the answers of all of them. :meth:`table` says what the columns are.
        """
        for page in self._result_pages(grid_ids, asked):
            yield from page.items

    def table(self, *grid_ids: str, **asked: Filter) -> QTable:
        """The same rows as an Astropy table, with units and descriptions.

        A number that is missing is NaN where the column is one of numbers with a fraction, masked elsewhere.
        """
        from service.result_table import as_table  # noqa: PLC0415 - Astropy takes a while to load

        return as_table(*self._whole(grid_ids, asked))

    def to_pandas(self, *grid_ids: str, **asked: Filter) -> pd.DataFrame:
        """The same rows as a pandas frame, whose ``attrs["units"]`` has the units; needs the extra ``pandas``."""
        from service.result_table import as_frame  # noqa: PLC0415 - as Astropy

        return as_frame(*self._whole(grid_ids, asked))

    def export(self, kind: str, *grid_ids: str, **asked: Filter) -> bytes:
        """The same rows as a file: csv, ecsv, parquet, vot or fits; ``specs="true"`` adds what is needed to replay."""
        return self._connection.file(_address(f"/v1/results.{_part(kind)}", grid_ids, asked))

    def figure(self, grid_id: str | None, name: str = "bias", kind: str = "svg", **asked: Filter) -> bytes:
        """A figure as an SVG or PNG file: bias, sample, coverage, pull, trends, and of a grid montage.

        Of a grid, or over all where that is None; ``asked`` are filters and how it is drawn, as ``system="HE0435"``.
        """
        of = "/v1" if grid_id is None else f"/v1/grids/{_part(grid_id)}"
        return self._connection.file(_address(f"{of}/figures/{_part(name)}.{_part(kind)}", (), asked))

    def run_figure(self, run_id: str) -> bytes:
        """The figure of a run, a PNG file: observation, model, residual, source."""
        return self._connection.file(f"/v1/runs/{_part(run_id)}/figure")

    def products(self, run_id: str) -> dict[str, NDArray[np.generic]]:
        """The arrays that a run left, by name: observation, model, source, chain."""
        import numpy as np  # noqa: PLC0415 - only here

        data = self._connection.file(f"/v1/runs/{_part(run_id)}/products")
        try:
            with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
                return {name: arrays[name] for name in arrays.files}
        except (ValueError, OSError) as error:
            raise AnswerError(f"the products of run {run_id} are not arrays: {error}") from error

    def record(self, run_id: str) -> dict[str, Any]:
        """Everything that it takes to recompute a run without the service, for ``hostlens replay``."""
        data = self._connection.file(f"/v1/runs/{_part(run_id)}/record")
        try:
            found = json.loads(data)
        except (ValueError, RecursionError):
            found = None
        if not isinstance(found, dict):
            raise AnswerError(f"what answered gives no record of run {run_id}")
        return found

    def events(self, grid_id: str, after: int = 0, wait_s: float = 0.0) -> EventPage:
        """Events after number ``after``, oldest first; waits up to ``wait_s`` (30 at most) where there is none yet."""
        params = {"cursor": after, "wait": wait_s, "limit": _PAGE}
        return self._connection.call(EventPage, "GET", f"/v1/grids/{_part(grid_id)}/events", params=params)

    def cancel(self, grid_id: str) -> GridView:
        """Cancel a grid."""
        return self._connection.call(GridView, "POST", f"/v1/grids/{_part(grid_id)}/cancel", True)

    def pause(self, grid_id: str) -> GridView:
        """Start no further run of a grid for now."""
        return self._connection.call(GridView, "POST", f"/v1/grids/{_part(grid_id)}/pause", True)

    def resume(self, grid_id: str) -> GridView:
        """Go on with a paused grid."""
        return self._connection.call(GridView, "POST", f"/v1/grids/{_part(grid_id)}/resume", True)

    def retry(self, grid_id: str, **where: Filter) -> RetriedGrid:
        """Queue again what failed, was quarantined or was cancelled, or those that ``where`` picks.

        As ``state="failed"``, ``error_code="deadline"`` or ``system=["HE0435", "RXJ1131"]``.
        """
        body: dict[str, Any] = {}
        if where:
            only = {name: _texts(values) for name, values in where.items()}
            body = {"content": as_json(only), "headers": {"Content-Type": "application/json"}}
        return self._connection.call(RetriedGrid, "POST", f"/v1/grids/{_part(grid_id)}/retry", **body)

    def engine(self) -> EngineView:
        """Which engine the service carries."""
        return self._connection.call(EngineView, "GET", "/v1/engine")

    def readiness(self) -> Readiness:
        """Whether the service can compute."""
        return self._connection.call(Readiness, "GET", "/readyz")

    def _pages(self, kind: type[T], address: str) -> Iterator[T]:
        following: str | None = address
        while following is not None:
            page = self._connection.call(kind, "GET", following)
            yield page
            following = page.next  # type: ignore[attr-defined]

    def _result_pages(self, grid_ids: Sequence[str], asked: Mapping[str, Filter]) -> Iterator[ResultPage]:
        return self._pages(ResultPage, _address("/v1/results", grid_ids, {**asked, "limit": _PAGE}))

    def _whole(
        self, grid_ids: Sequence[str], asked: Mapping[str, Filter]
    ) -> tuple[dict[str, dict[str, str | None]], list[dict[str, Any]]]:
        """What the columns are, and all rows."""
        pages = list(self._result_pages(grid_ids, asked))
        return pages[0].columns, [row for page in pages for row in page.items]


def _address(path: str, grid_ids: Sequence[str], asked: Mapping[str, Filter]) -> str:
    """A path with a query; a value that is several is repeated."""
    if grid_ids and "grid" in asked:
        raise RequestError("grids are given twice, by themselves and as the filter grid")
    pairs: list[tuple[str, Any]] = [("grid", grid_id) for grid_id in grid_ids]
    pairs += [(name, text) for name, values in asked.items() for text in _texts(values)]
    try:
        return f"{path}?{httpx.QueryParams(pairs)}"
    except UnicodeEncodeError:
        raise RequestError("the question holds text that is not Unicode") from None


def _texts(values: Filter) -> list[str]:
    return [str(value) for value in ([values] if isinstance(values, str | int | float) else values)]


def _joined(names: str | Sequence[str]) -> str:
    return names if isinstance(names, str) else ",".join(names)


def _part(identifier: str) -> str:
    """An identifier as a part of a path, whatever is in it."""
    try:
        return quote(identifier, safe="")
    except UnicodeEncodeError:
        raise RequestError(f"{identifier!r} is not an identifier") from None
