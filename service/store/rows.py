"""Rows as the domain's views."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import datetime
from typing import Any

from sqlalchemy import Row, RowMapping

from service.domain.payload import (
    COUNTS,
    ERROR_PARTS,
    ERRORS,
    ESTIMATES,
    LENS_PARAMETERS,
    QUANTITIES,
    WORK,
    ChainPayload,
    estimator_and_prior,
)
from service.domain.states import GridState, RunState
from service.domain.views import (
    UWS_PHASES,
    AttemptView,
    GridView,
    ResultView,
    RunCounts,
    RunError,
    RunItem,
    RunView,
    UntilView,
)
from service.store.pace import Recent
from service.store.points import Progress
from service.store.tables import attempt, estimate, run

RUN_COLUMNS = tuple(
    run.c[name]
    for name in (
        "id", "grid_id", "ordinal", "label", "paper_run", "state", "inputs",
        "attempt", "suspect", "error_code", "error_detail", "finished_at",
    )
)  # fmt: skip


_ATTEMPT = tuple(AttemptView.model_fields)
ATTEMPT_COLUMNS = tuple(attempt.c[name] for name in _ATTEMPT)
# In the order in which _estimate takes them apart.
ESTIMATE_COLUMNS = (
    estimate.c.estimator,
    estimate.c.index_prior,
    *(estimate.c[f"{quantity}_{part}"] for quantity in QUANTITIES for part in ("mean", "sd", "bias")),
    *(estimate.c[part] for part in COUNTS),
    *(estimate.c[name] for name in ERRORS),
)
_ESTIMATES = {name: estimator_and_prior(name) for name in ESTIMATES}
_LENS = {name: tuple(f"lens_{name.lower()}_{part}" for part in ("mean", "sd", "truth")) for name in LENS_PARAMETERS}
_CHAIN = {name: "chain_status" if name == "status" else name for name in ChainPayload.model_fields}
_GATHERED = ("estimates", "aperture", "regularisation", "profile", "lens", "chain", "work")
_PLAIN = tuple(name for name in ResultView.model_fields if name not in _GATHERED)


def ended_grid_view(row: Row[Any]) -> GridView:
    """A grid none of whose runs is open, from what was written down at its end."""
    ending = row.ending
    until = until_view(row, ending.get("reached", 0))
    return _grid_view(row, RunCounts(**ending["counts"]), GridState(row.state), until, ending["rate_per_s"], 0.0)


def until_view(row: Row[Any], reached: int) -> UntilView | None:
    """The rule of a grid, and how many of its points it has ended; None where it has none."""
    return None if row.until is None else UntilView(**row.until, points=row.points, reached=reached)


def grid_view(
    row: Row[Any],
    counts: dict[str, int],
    recent: Recent | None,
    now: datetime,
    workers: int = 0,
    progress: Progress | None = None,
) -> GridView:
    """A grid with its progress; an unfinished one that is not paused is running once a run has been started.

    ``workers`` that there are now: before the first run has ended the time left is that of stored runs of its kind.
    ``progress`` of its points, where it has a rule that ends replicates.
    """
    runs = RunCounts(**counts)
    state = GridState(row.state)
    if state is GridState.QUEUED and row.paused_at is not None:
        state = GridState.PAUSED
    elif state is GridState.QUEUED and (runs.leased or runs.ended):
        state = GridState.RUNNING
    remaining = runs.queued + runs.paused + runs.leased
    if progress is not None:
        # What the rule should let come, and what is running at least.
        remaining = min(remaining, max(progress.left, runs.leased))
    rate, left = _pace(recent, remaining, now)
    if left is None and workers and row.expected_wall_s is not None:
        left = row.expected_wall_s * remaining / row.n_runs / max(min(workers, remaining), 1)
    if state is GridState.PAUSED:
        left = None
    until = until_view(row, 0 if progress is None else progress.reached)
    return _grid_view(row, runs, state, until, rate, left)


def _grid_view(
    row: Row[Any],
    runs: RunCounts,
    state: GridState,
    until: UntilView | None,
    rate: float | None,
    left: float | None,
) -> GridView:
    return GridView(
        id=row.id,
        name=row.name,
        state=state,
        uws_phase=UWS_PHASES[state],
        n_runs=row.n_runs,
        counts=runs,
        until=until,
        progress=runs.ended / row.n_runs,
        rate_per_s=rate,
        eta_seconds=left,
        created_at=row.created_at,
        finished_at=row.finished_at,
        cancelled_at=row.cancelled_at,
        paused_at=row.paused_at,
        engine_digest=row.engine_digest,
        owner=row.owner,
        request=row._mapping.get("request", {}),
        links={},
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


def run_item(row: Row[*tuple[Any, ...]]) -> RunItem:
    """A run in short, with the keys of its artefacts in the place of their addresses."""
    artefacts = {name: getattr(row, name) for name in ("figure", "products")}
    names = [name for name in RunItem.model_fields if name != "links"]
    kept = {name: key for name, key in artefacts.items() if key is not None}
    return RunItem(**{name: getattr(row, name) for name in names}, links=kept)


def run_view(row: Row[Any]) -> RunView:
    """A run as lists show it."""
    return RunView(**_run_fields(row))


def run_document(
    row: Row[Any], found: Row[Any] | None, estimates: Sequence[Row[Any]], attempts: Sequence[Row[Any]]
) -> dict[str, Any]:
    """A run with all that belongs to it: a :class:`service.domain.views.RunDetail` as plain data, in its order.

    A result has four hundred numbers; to check each of them again takes longer than to read them.
    """
    return {
        **_run_fields(row),
        "spec": row.spec,
        "digest": row.digest,
        "result": None if found is None else _result(found, estimates),
        "attempts": [dict(zip(_ATTEMPT, ended, strict=True)) for ended in attempts],
    }


def _result(row: Row[Any], estimates: Sequence[Row[Any]]) -> dict[str, Any]:
    """A result, its columns gathered by estimator and lens parameter: a :class:`service.domain.views.ResultView`."""
    column = row._mapping
    lens = {}
    for name, (mean, sd, truth) in _LENS.items():
        if column[mean] is not None:
            lens[name] = {"mean": column[mean], "sd": column[sd], "truth": column[truth]}
    answers = {(one.estimator, one.index_prior): _estimate(one) for one in estimates}
    return {
        "estimates": {name: answers.get(parts) for name, parts in _ESTIMATES.items()},
        "aperture": _aperture(column),
        "regularisation": row.regularisation,
        "profile": row.profile,
        "lens": lens,
        "chain": None if row.chain_status is None else {name: column[place] for name, place in _CHAIN.items()},
        "work": _work(column),
        **{name: column[name] for name in _PLAIN},
    }


def _estimate(row: Row[Any]) -> dict[str, Any]:
    """A :class:`service.domain.views.EstimateView`; a quantity that is younger than the result is None."""
    values: Iterator[Any] = iter(tuple(row)[2:])
    found: dict[str, Any] = {}
    for quantity in QUANTITIES:
        mean, sd, bias = next(values), next(values), next(values)
        found[quantity] = None if mean is None else {"mean": mean, "sd": sd, "bias": bias}
    for part in COUNTS:
        found[part] = next(values)
    errors = {name: next(values) for name in ERRORS}
    found["budget"] = None
    if errors["magnitude_error"] is not None:
        found["budget"] = {
            quantity: {"total": errors[whole], **{stage: errors[column] for stage, column in stages}}
            for quantity, whole, stages in ERROR_PARTS
        }
    return found


def _work(column: RowMapping) -> dict[str, Any] | None:
    if column["rays_traced"] is None:
        return None
    return {**{name: column[name] for name in WORK}, "evidence_evaluations": column["evaluations"] or 0}


def _aperture(column: RowMapping) -> dict[str, Any] | None:
    mean = column["aperture_magnitude_mean"]
    if mean is None:
        return None
    return {
        "radius": column["aperture_radius"],
        "magnitude": {
            "mean": mean,
            "sd": column["aperture_magnitude_sd"],
            "bias": column["aperture_magnitude_bias"],
        },
        "coverage": column["aperture_coverage"],
        "draws": column["aperture_draws"],
        "failed": column["aperture_failed"],
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
        "links": {},
    }
