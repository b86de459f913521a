"""/runs/{id}: what was put in, what came out, and how to compute it once more."""

from __future__ import annotations

import json

from fastapi import APIRouter, Request, Response

from service.api.context import RunId, Service
from service.api.threads import Route
from service.domain.payload import ESTIMATES, RECOMMENDED
from service.web.rendering import page

router = APIRouter(include_in_schema=False, route_class=Route)


@router.get("/runs/{run_id}")
def one_run(request: Request, run_id: RunId, service: Service) -> Response:
    """One run."""
    run = service.grids.run_document(run_id)
    grid = service.grids.grid(run["grid_id"])
    result = run["result"]
    names = sorted(ESTIMATES, key=lambda name: name != RECOMMENDED)
    found = {} if result is None else result["estimates"]
    provenance = [("Realization", run["digest"]), ("Seed", str(run["inputs"]["seed"]))]
    if run["paper_run"] is not None:
        provenance.insert(0, ("Serial number in Table 3", str(run["paper_run"])))
    if result is not None:
        provenance += [
            ("Result", result["payload_digest"]),
            ("Engine", result["engine_digest"]),
            ("Profile", result["profile"] or "made by hand"),
        ]
    record = f"{request.url.scheme}://{request.url.netloc}/v1/runs/{run_id}"
    return page(
        "run.html",
        here="",
        run=run,
        result=result,
        grid_name=grid.name or grid.id,
        figure=f"/v1/runs/{run_id}/figure" if result is not None and result["figure"] else None,
        estimates=[(name, found[name]) for name in names if found.get(name)],
        recommended=RECOMMENDED,
        provenance=provenance,
        spec_text=json.dumps(run["spec"], indent=1, ensure_ascii=False),
        replay=result and f"curl -s {record} > run.json\nhostlens replay run.json",
    )
