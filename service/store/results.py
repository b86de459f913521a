"""Rows of a result from a payload: one of the table ``result``, and one of ``estimate`` for each answer."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from datetime import datetime
from typing import Any

from service.domain.payload import (
    COUNTS,
    ERROR_PARTS,
    ERRORS,
    ESTIMATES,
    LENS_PARAMETERS,
    QUANTITIES,
    WORK,
    AperturePayload,
    ChainPayload,
    ErrorBudgetPayload,
    MeasurementPayload,
    ResultPayload,
    estimator_and_prior,
)
from service.store.leases import Lease
from service.store.tables import INPUT_COLUMNS, USUAL_INPUTS

_CHAIN = {name: "chain_status" if name == "status" else name for name in ChainPayload.model_fields}
_PLAIN = (
    "ln_evidence", "chi2", "degrees_of_freedom", "condition_number",
    "arc_magnitude", "agn_contrast", "surface_brightness",
)  # fmt: skip
_TOLD = ("wall_s", "cpu_s", "engine_digest", "noise_treatment", "regularisation", "profile")
_NO_ERRORS: dict[str, float | None] = dict.fromkeys(ERRORS)
_PARTS = tuple((quantity, *(f"{quantity}_{part}" for part in ("mean", "sd", "bias"))) for quantity in QUANTITIES)


def result_row(lease: Lease, inputs: Mapping[str, Any], payload: ResultPayload, now: datetime) -> dict[str, Any]:
    """Typed columns of a result but for ``input_id``; ``inputs`` are those of the run."""
    row: dict[str, Any] = {"run_id": lease.run_id, "grid_id": lease.grid_id, "stored_at": now}
    # Runs that were queued before optics were inputs have them in their specification.
    known = {**USUAL_INPUTS, **(lease.spec.get("optics") or {}), **inputs}
    row |= {name: known[name] for name in (*INPUT_COLUMNS, "configuration")}
    row["observation_digest"] = observation_digest(lease.spec)
    row |= found_columns(payload)
    row |= {name: getattr(payload, name) for name in _TOLD}
    row |= {
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


def found_columns(payload: ResultPayload) -> dict[str, Any]:
    """Typed columns of what a run found beside its estimates: every one of them, null where there is no value."""
    row = _aperture_columns(payload.aperture)
    # Every row names every column, or those that are written together would lack what the first of them has not.
    for name in LENS_PARAMETERS:
        value, prefix = payload.lens.get(name), f"lens_{name.lower()}"
        for part in ("mean", "sd", "truth"):
            row[f"{prefix}_{part}"] = None if value is None else getattr(value, part)
    chain = payload.chain
    row |= {column: None if chain is None else getattr(chain, name) for name, column in _CHAIN.items()}
    row |= {name: None if payload.work is None else getattr(payload.work, name) for name in WORK}
    return row | {name: getattr(payload, name) for name in _PLAIN}


def observation_digest(spec: Mapping[str, Any]) -> str:
    """SHA-256 of what is observed: of a realization without its analysis."""
    observed = {name: value for name, value in spec.items() if name != "analysis"}
    return hashlib.sha256(json.dumps(observed, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def estimate_rows(run_id: str, input_id: int, payload: ResultPayload) -> list[dict[str, Any]]:
    """A row for each estimator and prior of n that has an answer."""
    rows = []
    for name in ESTIMATES:
        found = payload.estimates[name]
        if found is None:
            continue
        estimator, prior = estimator_and_prior(name)
        row: dict[str, Any] = {
            "run_id": run_id,
            "estimator": estimator,
            "index_prior": prior,
            "input_id": input_id,
        }
        for quantity, mean, sd, bias in _PARTS:
            value = getattr(found, quantity)
            row[mean], row[sd], row[bias] = value.mean, value.sd, value.bias
        for part in COUNTS:
            row[part] = getattr(found, part)
        rows.append(row | error_columns(found.budget))
    return rows


def error_columns(budget: ErrorBudgetPayload | None) -> dict[str, float | None]:
    """Columns of a budget of errors, all null without one."""
    if budget is None:
        return dict(_NO_ERRORS)
    row: dict[str, float | None] = {}
    for quantity, whole, stages in ERROR_PARTS:
        found = getattr(budget, quantity)
        row[whole] = found.total
        for stage, column in stages:
            row[column] = getattr(found, stage)
    return row


def measurement_row(lease: Lease, payload: MeasurementPayload, now: datetime) -> dict[str, Any]:
    """Typed columns of what was found."""
    return {
        "run_id": lease.run_id,
        "stored_at": now,
        "document": payload.document,
        "payload_digest": payload.digest,
        "engine_digest": payload.engine_digest,
        "wall_s": payload.wall_s,
        "cpu_s": payload.cpu_s,
        "figure": payload.figure and payload.figure.key,
        "figure_digest": payload.figure and payload.figure.digest,
    }


def _aperture_columns(found: AperturePayload | None) -> dict[str, Any]:
    names = ("radius", "coverage", "draws", "failed")
    row = {f"aperture_{name}": None if found is None else getattr(found, name) for name in names}
    for part in ("mean", "sd", "bias"):
        row[f"aperture_magnitude_{part}"] = None if found is None else getattr(found.magnitude, part)
    return row
