"""Addresses: what the store and the domain answer is given its links here, and nowhere else."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

from service.domain.views import GridView, RunDetail, RunView, SystemItem

_ACTIONS = ("cancel", "pause", "resume", "retry")
_RunT = TypeVar("_RunT", bound=RunView)
_SystemT = TypeVar("_SystemT", bound=SystemItem)


def link_grid(grid: GridView) -> GridView:
    """A grid with the addresses of its parts and of what may be done to it."""
    own = f"/v1/grids/{grid.id}"
    parts = {name: f"{own}/{name}" for name in ("runs", "summary", "events", *_ACTIONS)}
    return grid.model_copy(update={"links": {"self": own, **parts}})


def link_grids(grids: Sequence[GridView]) -> list[GridView]:
    """Each as :func:`link_grid`."""
    return [link_grid(grid) for grid in grids]


def link_run(run: _RunT) -> _RunT:
    """A run with the addresses of its grid and, where there is one, of its figure."""
    links = {"self": f"/v1/runs/{run.id}", "grid": f"/v1/grids/{run.grid_id}"}
    if isinstance(run, RunDetail) and run.result is not None and run.result.figure is not None:
        links["figure"] = f"/v1/runs/{run.id}/figure"
    return run.model_copy(update={"links": links})


def link_runs(runs: Sequence[_RunT]) -> list[_RunT]:
    """Each as :func:`link_run`."""
    return [link_run(run) for run in runs]


def link_system(system: _SystemT) -> _SystemT:
    """A lens system of the catalogue with its own address."""
    return system.model_copy(update={"links": {"self": f"/v1/systems/{system.name}"}})
