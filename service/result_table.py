"""Flat results as tables of Astropy and pandas, with their units."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd
    from astropy.table import QTable

Columns = Mapping[str, Mapping[str, str | None]]
"""Unit and description of each column, as /v1/results gives them."""
_UNITS = {"AB mag": "mag", "mag arcsec-2": "mag / arcsec2"}
"""Ours that Astropy spells otherwise. A scatter or a bias of AB magnitudes is none, so all of them are plain mag."""
_TIME = "stored_at"


def as_table(columns: Columns, rows: Sequence[Mapping[str, Any]]) -> QTable:
    """An Astropy table with units, descriptions, and the times as times."""
    import numpy as np  # noqa: PLC0415 - as Astropy, which the client alone has no need of
    from astropy import units  # noqa: PLC0415
    from astropy.table import MaskedColumn, QTable  # noqa: PLC0415
    from astropy.time import Time  # noqa: PLC0415

    table = QTable()
    for name, said in columns.items():
        values = [row[name] for row in rows]
        missing = [value is None for value in values]
        if name == _TIME:
            table[name] = Time([_without_zone(value) for value in values], format="isot", scale="utc")
        elif said["unit"] is not None or any(isinstance(value, float) for value in values):
            numbers = np.array([np.nan if value is None else value for value in values], dtype=float)
            unit = said["unit"]
            table[name] = numbers if unit is None else numbers * units.Unit(_UNITS.get(unit, unit))
        else:
            blank: Any = 0 if any(isinstance(value, int) for value in values) else ""
            filled = [blank if gone else value for value, gone in zip(values, missing, strict=True)]
            table[name] = MaskedColumn(filled, mask=missing) if any(missing) else filled
        table[name].info.description = said["description"]
    return table


def as_frame(columns: Columns, rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """A pandas frame; ``attrs`` has the units and descriptions by column."""
    import pandas as pd  # noqa: PLC0415 - optional

    frame = pd.DataFrame(list(rows), columns=list(columns))
    for name in columns:
        if {type(row[name]) for row in rows} == {int, type(None)}:
            frame[name] = frame[name].astype("Int64")  # or pandas makes numbers with a fraction of them
    frame[_TIME] = pd.to_datetime(frame[_TIME], utc=True, format="ISO8601")
    for part in ("unit", "description"):
        frame.attrs[f"{part}s"] = {name: said[part] for name, said in columns.items() if said[part] is not None}
    return frame


def _without_zone(text: str) -> str:
    return text.removesuffix("Z").removesuffix("+00:00")
