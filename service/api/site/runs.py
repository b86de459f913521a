"""/runs/{id}: what was put in, what came out, and how to compute it once more."""

from __future__ import annotations

import json
from typing import Any

from fastapi import APIRouter, Request, Response

from service.api.context import RunId, Service
from service.api.threads import Route
from service.domain.payload import ERROR_STAGES, ESTIMATES, RECOMMENDED
from service.web.rendering import page

router = APIRouter(include_in_schema=False, route_class=Route)


@router.get("/runs/{run_id}")
def one_run(request: Request, run_id: RunId, service: Service) -> Response:
    """One run."""
    _, run = service.grids.run_document(run_id)
    grid = service.grids.grid(run["grid_id"])
    result = run["result"]
    names = sorted(ESTIMATES, key=lambda name: name != RECOMMENDED)
    found = {} if result is None else result["estimates"]
    # An image that somebody has measured has no inputs.
    seed = run["inputs"].get("seed")
    provenance = [("Realization", run["digest"]), *([] if seed is None else [("Seed", str(seed))])]
    if run["paper_run"] is not None:
        provenance.insert(0, ("Serial number in Table 3", str(run["paper_run"])))
    if result is not None:
        provenance += [
            ("Result", result["payload_digest"]),
            ("Engine", result["engine_digest"]),
            ("Profile", result["profile"] or "made by hand"),
        ]
    record = f"{request.url.scheme}://{request.url.netloc}/v1/runs/{run_id}/record"
    return page(
        "run.html",
        here="",
        run=run,
        result=result,
        grid_name=grid.name or grid.id,
        figure=f"/v1/runs/{run_id}/figure" if result is not None and result["figure"] else None,
        estimates=[(name, found[name]) for name in names if found.get(name)],
        budgets=[(name, found[name]["budget"]) for name in names if found.get(name) and found[name]["budget"]],
        error_stages=ERROR_STAGES,
        recommended=RECOMMENDED,
        provenance=provenance,
        downloads=_downloads(run_id, result),
        spec_text=json.dumps(run["spec"], indent=1, ensure_ascii=False),
        replay=result and f"curl -s {record} > run.json\nhostlens replay run.json",
    )


def _downloads(run_id: str, result: dict[str, Any] | None) -> list[tuple[str, str]]:
    if result is None:
        return []
    own = f"/v1/runs/{run_id}"
    arrays = [] if result["products"] is None else [("Arrays (npz)", f"{own}/products"), ("FITS", f"{own}/fits")]
    chain = [("Chain (NetCDF)", f"{own}/chain.nc")] if arrays and result["chain"] is not None else []
    return [("Record (JSON)", f"{own}/record"), *arrays, *chain]
