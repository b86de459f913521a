"""Rows as records of fixed length, big-endian: the body of a FITS table and of a VOTable in BINARY2."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.exports.contents import Contents, Rows

NO_INTEGER = -(2**63)
"""Stands for an integer that is not there where a format has no other way to say so."""
Encode = Callable[[str], bytes]


def record_type(contents: Contents, octets: Mapping[str, int], before: int = 0) -> np.dtype[Any]:
    """A record: ``before`` bytes for whoever wants them, then the columns, texts of so many ``octets``."""
    kinds: dict[type, str] = {float: ">f8", int: ">i8"}
    fields: list[Any] = [("", "u1", (before,))] if before else []
    fields += [(column.name, kinds.get(column.kind) or f"S{octets[column.name]}") for column in contents.columns]
    return np.dtype(fields)


def records(piece: Rows, contents: Contents, kind: np.dtype[Any], encode: Mapping[str, Encode]) -> NDArray[Any]:
    """Rows as records: what is not there is NaN, :data:`NO_INTEGER` or an empty text."""
    found = np.zeros(len(piece), dtype=kind)
    for column, values in zip(contents.columns, zip(*piece, strict=True), strict=True):
        if column.kind is float:
            found[column.name] = np.array(values, dtype=np.float64)  # None becomes NaN
        elif column.kind is int:
            found[column.name] = [NO_INTEGER if value is None else value for value in values]
        else:
            write = encode[column.name]
            found[column.name] = [b"" if text is None else write(text) for text in values]
    return found


def missing(piece: Rows) -> NDArray[np.uint8]:
    """A bit for each value that is not there, the first in the highest bit, rows padded to whole bytes."""
    return np.packbits(np.array([[value is None for value in row] for row in piece]), axis=1)
