"""Stored results of simulations as what predictions learn from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy import Connection, select

from engine import PREDICTED, SimulatedRun, realization_from_dict, spec_digest, traits_of
from service.store.tables import estimate, result, run

MOST_RUNS = 5000
"""Of all grids together, the newest: more would take a minute to fit."""
_NOT_THE_LENS = ("exposures", "camera", "priors")


def simulated_runs(connection: Connection, grids: Sequence[str]) -> list[SimulatedRun]:
    """The newest results of these grids, with the answers of all estimators that have a truth."""
    columns = (result.c.run_id, result.c.arc_magnitude, result.c.cpu_s, run.c.spec)
    newest = (
        select(*columns)
        .join_from(result, run, run.c.id == result.c.run_id)
        .where(result.c.grid_id.in_(grids), result.c.system.is_not(None))
        .order_by(result.c.run_id.desc())
        .limit(MOST_RUNS)
    )
    rows = connection.execute(newest).all()
    answers = _answers(connection, grids)
    return [
        SimulatedRun(
            run_id=row.run_id,
            lens=_lens(row.spec),
            traits=traits_of(realization_from_dict(row.spec), row.arc_magnitude),
            found=answers.get(row.run_id, {}),
            cpu_s=row.cpu_s,
        )
        for row in rows
    ]


def _answers(connection: Connection, grids: Sequence[str]) -> dict[str, dict[str, dict[str, tuple[float, float]]]]:
    """By run, estimator with its prior, and quantity: bias and stated deviation."""
    parts = [estimate.c[f"{name}_{part}"] for name in PREDICTED for part in ("bias", "sd")]
    wanted = (
        select(estimate.c.run_id, estimate.c.estimator, estimate.c.index_prior, *parts)
        .join_from(estimate, result, result.c.run_id == estimate.c.run_id)
        .where(result.c.grid_id.in_(grids))
    )
    found: dict[str, dict[str, dict[str, tuple[float, float]]]] = {}
    for row in connection.execute(wanted):
        values: Any = row._mapping
        mine = {
            name: (values[f"{name}_bias"], values[f"{name}_sd"])
            for name in PREDICTED
            if values[f"{name}_bias"] is not None
        }
        found.setdefault(row.run_id, {})[f"{row.estimator}_{row.index_prior}"] = mine
    return found


def _lens(spec: dict[str, Any]) -> str:
    """A system of the catalogue by its name; one's own also by what it is, since two may have one name."""
    system = spec["system"]
    if isinstance(system, str):
        return system
    digest = spec_digest({name: value for name, value in system.items() if name not in _NOT_THE_LENS})
    return f"{system['name']} {digest[:8]}"
