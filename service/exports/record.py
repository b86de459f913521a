"""A run on record: all that is needed to compute it again without the service, and what it found."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sqlalchemy import Connection

from service import VERSION
from service.domain.payload import COUNTS, ERRORS, ESTIMATES, QUANTITIES, ResultPayload
from service.domain.plan import OPTICS_AXES
from service.exports.contents import stamp
from service.store.result_filter import ResultFilter
from service.store.result_rows import ResultColumn, result_columns, result_statement
from service.store.results import estimate_rows, found_columns
from service.store.tables import result

FORMAT = "hostlens record 1"
_OF_ESTIMATE = (*(f"{quantity}_{part}" for quantity in QUANTITIES for part in ("mean", "sd", "bias")), *COUNTS, *ERRORS)
_GIVEN = frozenset({"paper_run", "l_eta", "n", "r_eff", "magnitude", "seed", "wall_s", "cpu_s", *OPTICS_AXES})
"""Numbers of a result that are no finding."""


def read_found(connection: Connection, run_id: str) -> dict[str, Any] | None:
    """What a run found, by the names that :func:`found_by` gives; None where it has no result."""
    wanted = [column for column in result_columns(ESTIMATES) if is_finding(column)]
    statement = result_statement(ResultFilter(), ESTIMATES, wanted).where(result.c.run_id == run_id)
    row = connection.execute(statement).one_or_none()
    return None if row is None else {column.name: value for column, value in zip(wanted, row, strict=True)}


def is_finding(column: ResultColumn) -> bool:
    """Whether a column holds what a run found, and not what it was asked or how long it took."""
    return column.name == "chain_status" or (column.kind in {int, float} and column.name not in _GIVEN)


def record(document: Mapping[str, Any], found: Mapping[str, Any]) -> dict[str, Any]:
    """The record of a run, from the run with its result as plain data and what it ``found``."""
    stored = document["result"]
    return {
        "format": FORMAT,
        "service": f"hostlens {VERSION}",
        "run_id": document["id"],
        "grid_id": document["grid_id"],
        "label": document["label"],
        "paper_run": document["paper_run"],
        "spec": document["spec"],
        "seed": document["spec"].get("seed"),
        "realization_digest": document["digest"],
        "engine_digest": stored["engine_digest"],
        "payload_digest": stored["payload_digest"],
        "versions": stored["versions"],
        "stored_at": stamp(stored["stored_at"]),
        "warnings": stored["warnings"],
        "found": dict(found),
    }


def found_by(payload: ResultPayload) -> dict[str, Any]:
    """What a payload found, flat: as the columns of an export of all estimators are named."""
    values: dict[str, Any] = {}
    for row in estimate_rows("", 0, payload):
        name = f"{row['estimator']}_{row['index_prior']}"
        values |= {f"{name}_{part}": row[part] for part in _OF_ESTIMATE}
    lacking = {f"{name}_{part}": None for name in ESTIMATES for part in _OF_ESTIMATE}
    return {**lacking, **values, **found_columns(payload)}
