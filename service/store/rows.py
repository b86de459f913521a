"""Rows as the API's models."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from typing import Any

from sqlalchemy import Row, RowMapping

from service.domain.payload import COUNTS, ESTIMATES, LENS_PARAMETERS, QUANTITIES, ChainPayload
from service.domain.states import GridState, RunState
from service.domain.views import UWS_PHASES, AttemptView, GridView, ResultView, RunCounts, RunDetail, RunError, RunView
from service.store.pace import Recent
from service.store.tables import run

RUN_COLUMNS = tuple(
    run.c[name]
    for name in (
        "id", "grid_id", "ordinal", "label", "paper_run", "state", "inputs",
        "attempt", "suspect", "error_code", "error_detail", "finished_at",
    )
)  # fmt: skip


def ended_grid_view(row: Row[Any]) -> GridView:
    """A grid none of whose runs is open, from what was written down at its end."""
    return _grid_view(row, RunCounts(**row.ending["counts"]), GridState(row.state), row.ending["rate_per_s"], 0.0)


def grid_view(row: Row[Any], counts: dict[str, int], recent: Recent | None, now: datetime) -> GridView:
    """A grid with its progress; an unfinished one that is not paused is running once a run has been started."""
    runs = RunCounts(**counts)
    state = GridState(row.state)
    if state is GridState.QUEUED and row.paused_at is not None:
        state = GridState.PAUSED
    elif state is GridState.QUEUED and (runs.leased or runs.ended):
        state = GridState.RUNNING
    remaining = runs.queued + runs.paused + runs.leased
    rate, left = _pace(recent, remaining, now)
    if state is GridState.PAUSED:
        left = None
    return _grid_view(row, runs, state, rate, left)


def _grid_view(row: Row[Any], runs: RunCounts, state: GridState, rate: float | None, left: float | None) -> GridView:
    return GridView(
        id=row.id,
        name=row.name,
        state=state,
        uws_phase=UWS_PHASES[state],
        n_runs=row.n_runs,
        counts=runs,
        progress=runs.ended / row.n_runs,
        rate_per_s=rate,
        eta_seconds=left,
        created_at=row.created_at,
        finished_at=row.finished_at,
        cancelled_at=row.cancelled_at,
        paused_at=row.paused_at,
        engine_digest=row.engine_digest,
        request=row.request,
        links={
            "self": f"/v1/grids/{row.id}",
            "runs": f"/v1/grids/{row.id}/runs",
            "summary": f"/v1/grids/{row.id}/summary",
            "events": f"/v1/grids/{row.id}/events",
            **{action: f"/v1/grids/{row.id}/{action}" for action in ("cancel", "pause", "resume", "retry")},
        },
    )


def _pace(recent: Recent | None, remaining: int, now: datetime) -> tuple[float | None, float | None]:
    """Runs per second and seconds left.

    Measured up to the last end and counted down from there, or the time left would grow while long runs are under
    way; once it is used up the wait itself is part of the measure.
    """
    if recent is None:
        return None, 0.0 if not remaining else None
    rate = recent.rate()
    left = remaining / rate - (now - recent.ended_at).total_seconds()
    if remaining and left <= 0.0:
        rate = recent.rate(now)
        left = remaining / rate
    return rate, max(left, 0.0) if remaining else 0.0


def run_view(row: Row[Any]) -> RunView:
    """A run as lists show it."""
    return RunView(**_run_fields(row))


def run_detail(row: Row[Any], found: Row[Any] | None, attempts: Sequence[Row[Any]]) -> RunDetail:
    """A run with all that belongs to it."""
    fields = _run_fields(row)
    result = None if found is None else result_view(found)
    if result is not None and result.figure is not None:
        fields["links"]["figure"] = f"/v1/runs/{row.id}/figure"
    return RunDetail(
        **fields,
        spec=row.spec,
        digest=row.digest,
        result=result,
        attempts=[
            AttemptView(**{name: getattr(ended, name) for name in AttemptView.model_fields}) for ended in attempts
        ],
    )


def result_view(row: Row[Any]) -> ResultView:
    """A result, its columns gathered by estimator and lens parameter."""
    column = row._mapping
    lens = {
        name: {part: column[f"lens_{name.lower()}_{part}"] for part in ("mean", "sd", "truth")}
        for name in LENS_PARAMETERS
        if column[f"lens_{name.lower()}_mean"] is not None
    }
    chain = {name: column[name] for name in ChainPayload.model_fields if name != "status"}
    plain = [name for name in ResultView.model_fields if name not in {"estimates", "aperture", "lens", "chain"}]
    # Checked in one go: a result has a hundred recovered values, and a model made of each takes ten times as long.
    return ResultView.model_validate(
        {
            "estimates": {name: _estimate(column, name) for name in ESTIMATES},
            "aperture": _aperture(column),
            "lens": lens,
            "chain": chain | {"status": column["chain_status"]},
            **{name: column[name] for name in plain},
        }
    )


def _recovered(column: RowMapping, prefix: str) -> dict[str, Any] | None:
    if column[f"{prefix}_mean"] is None:
        return None
    return {part: column[f"{prefix}_{part}"] for part in ("mean", "sd", "bias")}


def _estimate(column: RowMapping, name: str) -> dict[str, Any] | None:
    """An estimate; None where the result has none, which shows in its magnitude."""
    if column[f"{name}_magnitude_mean"] is None:
        return None
    quantities = {quantity: _recovered(column, f"{name}_{quantity}") for quantity in QUANTITIES}
    return quantities | {part: column[f"{name}_{part}"] for part in COUNTS}


def _aperture(column: RowMapping) -> dict[str, Any] | None:
    magnitude = _recovered(column, "aperture_magnitude")
    if magnitude is None:
        return None
    return {"magnitude": magnitude} | {
        name: column[f"aperture_{name}"] for name in ("radius", "coverage", "draws", "failed")
    }


def _run_fields(row: Row[Any]) -> dict[str, Any]:
    state = RunState(row.state)
    error = None if row.error_code is None else RunError(code=row.error_code, detail=row.error_detail)
    plain = ("id", "grid_id", "ordinal", "label", "paper_run", "inputs", "attempt", "suspect", "finished_at")
    return {
        **{name: getattr(row, name) for name in plain},
        "state": state,
        "uws_phase": UWS_PHASES[state],
        "error": error,
        "links": {"self": f"/v1/runs/{row.id}", "grid": f"/v1/grids/{row.grid_id}"},
    }
