"""/ and /grids/{id}: all grids; one grid with its progress, figures, biases, and what may be done to it."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Annotated, Any, Literal
from urllib.parse import urlencode

from fastapi import APIRouter, Query, Response
from fastapi.responses import RedirectResponse

from engine import GROUPINGS
from service.api.context import Context, GridId, Service
from service.api.gate import Asking, require_owner
from service.api.site.questions import (
    DEFAULT_ESTIMATE,
    SHOWN_AXES,
    AxisName,
    EstimateChoice,
    QuantityName,
    of_grid,
    summary_rows,
)
from service.api.threads import Route, patient
from service.domain.identifiers import GRID_PATTERN
from service.domain.payload import ESTIMATES, QUANTITIES, estimator_and_prior
from service.domain.states import RunState
from service.domain.views import GridKind, GridView
from service.figures.question import FigureKind
from service.store.map_rows import map_runs, systems_of
from service.store.result_rows import QUANTITY_UNITS
from service.web.biases_map import bias_map
from service.web.rendering import page

router = APIRouter(include_in_schema=False, route_class=Route)
_ON_A_PAGE = 50
_MOST_CELLS = 1000
_MOST_FAILURES = 20
_MOST_ROWS = 60
_MOST_AT_ONCE = 20_000
"""Results that are summarised with the page; of more only when it has been shown."""
_KINDS = (
    "grid", "grid_cancelled", "grid_paused", "grid_resumed", "grid_revived", "run_started", "run_done", "run_failed",
    "run_quarantined", "run_cancelled", "run_requeued", "point_reached",
)  # fmt: skip
_FORMAT_NAMES = {"csv": "CSV", "ecsv": "ECSV", "parquet": "Parquet", "vot": "VOTable", "fits": "FITS"}
"""Files of results, by what the address ends with."""
_FIGURES: tuple[tuple[FigureKind, str, str], ...] = (
    ("bias", "Biases", "Biases of magnitude, radius and index by serial number, and their means"),
    ("sample", "Sample", "Bias of the magnitude against arc, contrast and surface brightness"),
    ("trends", "Trends", "Mean bias in bins of arc magnitude, contrast and surface brightness"),
    ("coverage", "Coverage", "Share of runs with the truth inside the stated interval"),
    ("pull", "Pulls", "Biases in units of the stated standard deviation"),
    ("montage", "Montage", "Observation, model and source of each run"),
)


@router.get("/")
def all_grids(
    service: Service,
    cursor: Annotated[str | None, Query(pattern=GRID_PATTERN)] = None,
    kind: GridKind = "simulation",
) -> Response:
    """Grids, newest first; those that measure uploaded images where they are asked for."""
    found = service.grids.grids(_ON_A_PAGE, cursor, kind=kind)
    asked = {} if kind == "simulation" else {"kind": kind}
    here = asked | ({} if cursor is None else {"cursor": cursor})
    return page(
        "grids.html",
        here="/",
        own=f"/?{urlencode(here)}" if here else "/",
        kind=kind,
        grids=found.items,
        next=found.next and f"/?{urlencode(asked | {'cursor': found.next})}",
        is_open=any(grid.finished_at is None for grid in found.items),
    )


@router.get("/grids/{grid_id}")
@patient
def one_grid(
    grid_id: GridId,
    service: Service,
    figure: FigureKind = "bias",
    system: Annotated[str, Query(max_length=64)] = "",
    group_by: AxisName = "system",
    quantity: QuantityName = "magnitude",
    estimate: EstimateChoice = DEFAULT_ESTIMATE,
    summary: Literal["", "full"] = "",
) -> Response:
    """One grid."""
    grid = service.grids.grid(grid_id)
    shown = {
        "figure": figure, "system": system, "group_by": group_by, "quantity": quantity, "estimate": estimate,
    }  # fmt: skip
    with service.database.read() as connection:
        systems = systems_of(connection, grid_id)
    if not shown["system"] and systems:
        shown["system"] = systems[0]
    rows, cut = None, False
    if grid.counts.done <= _MOST_AT_ONCE or summary:
        rows, cut = summary_rows(service.database, of_grid(grid_id), group_by, quantity, estimate, _MOST_ROWS)
    failures = []
    for state in (RunState.FAILED, RunState.QUARANTINED):
        if getattr(grid.counts, state):
            failures += service.grids.runs(grid_id, _MOST_FAILURES, state=state).items
    return page(
        "grid.html",
        here="",
        **_progress(service, grid),
        actions=_actions(grid),
        kinds=" ".join(_KINDS),
        failures=failures[:_MOST_FAILURES],
        kinds_of_figure=[(kind, name) for kind, name, _ in _FIGURES],
        systems=systems,
        shown=shown,
        kept=lambda **changes: urlencode({**shown, **changes}),
        **_figure(grid, shown),
        rows=rows,
        cut=cut,
        unit=QUANTITY_UNITS[quantity],
        axes=SHOWN_AXES,
        quantities=QUANTITIES,
        estimates=ESTIMATES,
        recommended=DEFAULT_ESTIMATE,
        downloads=_downloads(grid_id),
        request_text=json.dumps(grid.request, indent=1, ensure_ascii=False),
    )


@router.get("/grids/{grid_id}/progress")
def progress(grid_id: GridId, service: Service) -> Response:
    """The part of a grid's page that changes while it runs."""
    return page("progress.html", **_progress(service, service.grids.grid(grid_id)))


@router.post("/grids/{grid_id}/{action}")
def act(
    grid_id: GridId,
    action: Literal["cancel", "pause", "resume", "retry"],
    service: Service,
    caller: Asking,
) -> Response:
    """Do something to a grid and show it again."""
    require_owner(caller, service.grids, grid_id)
    actions: dict[str, Callable[[str], object]] = {
        "cancel": service.grids.cancel,
        "pause": service.grids.pause,
        "resume": service.grids.resume,
        "retry": service.grids.revive,
    }
    actions[action](grid_id)
    return RedirectResponse(f"/grids/{grid_id}", 303, {"Cache-Control": "no-store"})


def _progress(service: Context, grid: GridView) -> dict[str, Any]:
    estimator, prior = estimator_and_prior(DEFAULT_ESTIMATE)
    with service.database.read() as connection:
        cells = map_runs(connection, grid.id, estimator, prior, _MOST_CELLS + 1)
    names = {"leased": "running", "not_needed": "not needed"}
    counts = [(names.get(name, name), count) for name, count in grid.counts.model_dump().items()]
    return {"grid": grid, "counts": counts, "map": bias_map(cells, _MOST_CELLS)}


def _actions(grid: GridView) -> list[tuple[str, str, str]]:
    """What may be done to a grid as it stands."""
    found = []
    counts = grid.counts
    if grid.finished_at is None and grid.cancelled_at is None:
        found.append(("resume", "Resume", "main") if grid.paused_at else ("pause", "Pause", ""))
        found.append(("cancel", "Cancel", "danger"))
    if counts.failed + counts.quarantined + counts.cancelled:
        found.append(("retry", "Try again what has no result", ""))
    return found


def _figure(grid: GridView, shown: dict[str, str]) -> dict[str, Any]:
    estimator, prior = estimator_and_prior(shown["estimate"])
    asked = {"estimator": estimator, "index_prior": prior}
    kind = shown["figure"]
    if kind == "bias":
        asked["system"] = shown["system"]
    if kind in ("coverage", "pull", "trends"):
        asked["quantity"] = shown["quantity"]
        asked["by"] = shown["group_by"] if shown["group_by"] in GROUPINGS else "system"
    address = f"/v1/grids/{grid.id}/figures/{kind}"
    query = urlencode(asked)
    found = {"svg": f"{address}.svg?{query}", "png": f"{address}.png?{query}"}
    told = next(text for name, _, text in _FIGURES if name == kind)
    # Hundreds of pictures are larger as text than as pixels.
    return {
        **{f"figure_{name}": value for name, value in found.items()},
        "figure_address": found["png" if kind == "montage" else "svg"],
        "figure_alt": f"{told}: {grid.name or grid.id}",
    }


def _downloads(grid_id: str) -> list[tuple[str, str]]:
    files = [(_FORMAT_NAMES[kind], f"/v1/results.{kind}?grid={grid_id}") for kind in _FORMAT_NAMES]
    return [
        *files,
        ("Results (JSON)", f"/v1/results?grid={grid_id}"),
        ("Biases (JSON)", f"/v1/summary?grid={grid_id}"),
        ("Runs (JSON)", f"/v1/grids/{grid_id}/runs"),
    ]
