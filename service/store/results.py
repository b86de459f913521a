"""One row of the result table from a payload."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from service.payload import QUANTITIES, ResultPayload
from service.store.leases import Lease
from service.store.tables import INPUT_COLUMNS


def result_row(lease: Lease, inputs: dict[str, Any], payload: ResultPayload, now: datetime) -> dict[str, Any]:
    """Typed columns of a result; ``inputs`` are those of the run."""
    row: dict[str, Any] = {"run_id": lease.run_id, "grid_id": lease.grid_id, "stored_at": now}
    row |= {name: inputs[name] for name in INPUT_COLUMNS}
    for estimate, found in payload.estimates.items():
        for quantity in QUANTITIES:
            value = getattr(found, quantity)
            prefix = f"{estimate}_{quantity}"
            row |= {f"{prefix}_mean": value.mean, f"{prefix}_sd": value.sd, f"{prefix}_bias": value.bias}
        row |= {f"{estimate}_{part}": getattr(found, part) for part in ("draws", "at_bound", "failed")}
    for name, value in payload.lens.items():
        prefix = f"lens_{name.lower()}"
        row |= {f"{prefix}_mean": value.mean, f"{prefix}_sd": value.sd, f"{prefix}_truth": value.truth}
    chain = payload.chain.model_dump()
    row |= {"chain_status": chain.pop("status"), **chain}
    plain = (
        "ln_evidence", "chi2", "degrees_of_freedom", "condition_number",
        "arc_magnitude", "agn_contrast", "surface_brightness", "wall_s", "cpu_s", "engine_digest",
    )  # fmt: skip
    row |= {name: getattr(payload, name) for name in plain}
    row |= {
        "noise_treatment": payload.noise_treatment,
        "stages": [stage.model_dump() for stage in payload.stages],
        "payload_digest": payload.digest,
        "versions": payload.versions,
        "warnings": list(payload.warnings),
        "figure": payload.figure and payload.figure.key,
        "figure_digest": payload.figure and payload.figure.digest,
        "products": payload.products and payload.products.key,
        "products_digest": payload.products and payload.products.digest,
    }
    return row
