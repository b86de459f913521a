"""The columns of an export as an Astropy table without rows: its writers know how units and descriptions are kept."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from service.exports.contents import Contents

if TYPE_CHECKING:
    from astropy.table import Table

_AB = "AB mag"
"""No unit of the standards: there it is a magnitude, and the description says which."""


def empty_table(contents: Contents, meta: Mapping[str, Any] | None = None) -> Table:
    """A table of the right columns, units and descriptions with no row; ``meta`` without more is the provenance."""
    from astropy.table import Column, Table  # noqa: PLC0415 - half a second that only exports need

    kinds: dict[type, str] = {float: "f8", int: "i8"}
    columns = [
        Column(
            name=column.name,
            dtype=kinds.get(column.kind) or f"U{contents.widths[column.name].octets}",
            unit="mag" if column.unit == _AB else column.unit,
            description=f"{column.description} (AB)" if column.unit == _AB else column.description,
        )
        for column in contents.columns
    ]
    return Table(columns, meta=dict(contents.provenance if meta is None else meta))


def flat_provenance(contents: Contents) -> dict[str, str]:
    """The provenance for headers that keep text alone; what is not text is JSON."""
    return {name: value if isinstance(value, str) else json.dumps(value) for name, value in contents.provenance.items()}
