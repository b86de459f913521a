"""Many numbers at once from the database: as an array, past one Python object for each."""

from __future__ import annotations

from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import (
    ColumnElement,
    Connection,
    Float,
    LargeBinary,
    Select,
    cast,
    func,
    literal,
    literal_column,
    select,
)


def read_numbers(connection: Connection, statement: Select[Any]) -> NDArray[np.float64]:
    """Rows of a statement whose columns are all numbers, of shape (rows, columns), in no order; NULL is NaN."""
    columns = statement.subquery().c
    if connection.dialect.name == "postgresql":
        missing: ColumnElement[float] = literal_column("'NaN'::float8")
        row: ColumnElement[Any] = literal(b"", LargeBinary)
        for column in columns:
            row = row.op("||")(func.float8send(func.coalesce(cast(column, Float(53)), missing)))
        # One value of the server's own binary numbers, big-endian.
        gathered = func.string_agg(row, literal(b"", LargeBinary), type_=LargeBinary)
        values = np.frombuffer(connection.scalar(select(gathered)) or b"", dtype=">f8").astype(np.float64)
    else:
        # SQLite knows no NaN, and an infinite number is none that is ever stored.
        found = connection.execute(select(*(func.coalesce(column, literal_column("9e999")) for column in columns)))
        values = np.fromiter(chain.from_iterable(found.cursor), dtype=np.float64)  # type: ignore[arg-type]
        values[np.isinf(values)] = np.nan
    return values.reshape(-1, len(columns))
