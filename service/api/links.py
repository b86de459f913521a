"""Addresses: what the store and the domain answer is given its links here, and nowhere else."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

from service.domain.views import GridItem, GridView, Links, MeasurementView, RunItem, RunView, SystemItem

_ACTIONS = ("cancel", "pause", "resume", "retry")
_PARTS = ("figure", "products")
"""What a run has addresses for where there is it."""
_SystemT = TypeVar("_SystemT", bound=SystemItem)


def link_grid(grid: GridView) -> GridView:
    """A grid with the addresses of its parts and of what may be done to it."""
    own = f"/v1/grids/{grid.id}"
    parts = {name: f"{own}/{name}" for name in ("runs", "summary", "events", *_ACTIONS)}
    return grid.model_copy(update={"links": {"self": own, "page": f"/grids/{grid.id}", **parts}})


def link_grids(grids: Sequence[GridView]) -> list[GridView]:
    """Each as :func:`link_grid`."""
    return [link_grid(grid) for grid in grids]


def link_runs(runs: Sequence[RunView]) -> list[RunView]:
    """Each with its own address and that of its grid."""
    return [run.model_copy(update={"links": _run_links(run.id, run.grid_id)}) for run in runs]


def compact_grids(grids: Sequence[GridView]) -> list[GridItem]:
    """Each in short."""
    names = [name for name in GridItem.model_fields if name != "links"]
    return [GridItem(**{name: getattr(one, name) for name in names}, links=link_grid(one).links) for one in grids]


def link_run_items(runs: Sequence[RunItem]) -> list[RunItem]:
    """Each with the addresses of what there is of it: the store says by a key in its place."""
    return [
        run.model_copy(
            update={
                "links": {"self": f"/v1/runs/{run.id}", "page": f"/runs/{run.id}"}
                | {part: f"/v1/runs/{run.id}/{part}" for part in _PARTS if part in run.links}
            }
        )
        for run in runs
    ]


def link_document(document: dict[str, Any]) -> dict[str, Any]:
    """A run as plain data, with these addresses and those of the files that it has."""
    links = _run_links(document["id"], document["grid_id"])
    result, own = document["result"], links["self"]
    if result is not None:
        links["record"] = f"{own}/record"
        links |= {"figure": f"{own}/figure"} if result["figure"] is not None else {}
        links |= {"products": f"{own}/products", "fits": f"{own}/fits"} if result["products"] is not None else {}
        links |= {"chain": f"{own}/chain.nc"} if result["products"] is not None and result["chain"] else {}
    return document | {"links": links}


def _run_links(run_id: str, grid_id: str) -> Links:
    return {"self": f"/v1/runs/{run_id}", "page": f"/runs/{run_id}", "grid": f"/v1/grids/{grid_id}"}


def link_measurement(found: MeasurementView) -> MeasurementView:
    """A measurement with its addresses, those of its grid and run, and of its figure where the store names one."""
    own, grid = f"/v1/measurements/{found.id}", f"/v1/grids/{found.id}"
    links = {"self": own, "grid": grid, "run": f"/v1/runs/{found.run_id}"}
    links |= {name: f"{grid}/{name}" for name in ("events", *_ACTIONS)}
    if "figure" in found.links:
        links["figure"] = f"{own}/figure"
    return found.model_copy(update={"links": links})


def link_system(system: _SystemT) -> _SystemT:
    """A lens system of the catalogue with its own address."""
    return system.model_copy(update={"links": {"self": f"/v1/systems/{system.name}"}})
