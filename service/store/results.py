"""One row of the result table from a payload."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from service.domain.payload import (
    COUNTS,
    ESTIMATES,
    LENS_PARAMETERS,
    QUANTITIES,
    AperturePayload,
    EstimateName,
    EstimatePayload,
    ResultPayload,
)
from service.store.leases import Lease
from service.store.tables import INPUT_COLUMNS


def result_row(lease: Lease, inputs: dict[str, Any], payload: ResultPayload, now: datetime) -> dict[str, Any]:
    """Typed columns of a result; ``inputs`` are those of the run."""
    row: dict[str, Any] = {"run_id": lease.run_id, "grid_id": lease.grid_id, "stored_at": now}
    row |= {name: inputs[name] for name in INPUT_COLUMNS}
    for estimate in ESTIMATES:
        row |= _estimate_columns(estimate, payload.estimates[estimate])
    row |= _aperture_columns(payload.aperture)
    # Every row names every column, or those that are written together would lack what the first of them has not.
    for name in LENS_PARAMETERS:
        value, prefix = payload.lens.get(name), f"lens_{name.lower()}"
        for part in ("mean", "sd", "truth"):
            row[f"{prefix}_{part}"] = None if value is None else getattr(value, part)
    chain = payload.chain.model_dump()
    row |= {"chain_status": chain.pop("status"), **chain}
    plain = (
        "ln_evidence", "chi2", "degrees_of_freedom", "condition_number",
        "arc_magnitude", "agn_contrast", "surface_brightness", "wall_s", "cpu_s", "engine_digest",
        "regularisation", "profile",
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


_ESTIMATE_COLUMNS = {
    estimate: (
        [(quantity, *(f"{estimate}_{quantity}_{part}" for part in ("mean", "sd", "bias"))) for quantity in QUANTITIES],
        [(part, f"{estimate}_{part}") for part in COUNTS],
    )
    for estimate in ESTIMATES
}


def _estimate_columns(estimate: EstimateName, found: EstimatePayload | None) -> dict[str, Any]:
    """Columns of one estimate, every one of them null where there is none."""
    row: dict[str, Any] = {}
    quantities, counts = _ESTIMATE_COLUMNS[estimate]
    for quantity, mean, sd, bias in quantities:
        value = None if found is None else getattr(found, quantity)
        if value is None:
            row[mean] = row[sd] = row[bias] = None
        else:
            row[mean], row[sd], row[bias] = value.mean, value.sd, value.bias
    for part, column in counts:
        row[column] = None if found is None else getattr(found, part)
    return row


def _aperture_columns(found: AperturePayload | None) -> dict[str, Any]:
    names = ("radius", "coverage", "draws", "failed")
    row = {f"aperture_{name}": None if found is None else getattr(found, name) for name in names}
    for part in ("mean", "sd", "bias"):
        row[f"aperture_magnitude_{part}"] = None if found is None else getattr(found.magnitude, part)
    return row
