"""Results as Parquet, with what Astropy and the Virtual Observatory read of units and descriptions."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, BinaryIO

from service.exports.contents import Contents, Rows
from service.exports.template import empty_table
from service.exports.votable import document

if TYPE_CHECKING:
    import pyarrow

_CELLS = 2**21
"""In a group of rows: 16 MB as numbers."""


def write_parquet(pieces: Iterable[Rows], contents: Contents, sink: BinaryIO) -> None:
    """Groups of rows, compressed; nulls where there is no value.

    The metadata hold Astropy's ``table_meta_yaml`` and a VOTable without data (VOParquet 1.0).
    """
    import pyarrow  # noqa: PLC0415 - takes a while, as below
    from pyarrow import parquet  # noqa: PLC0415

    schema = _schema(contents)
    group = max(1, _CELLS // len(contents.columns))
    with parquet.ParquetWriter(sink, schema, compression="zstd") as writer:
        waiting: list[Any] = []
        for piece in pieces:
            columns = zip(zip(*piece, strict=True), schema, strict=True)
            arrays = [pyarrow.array(values, type=field.type) for values, field in columns]
            waiting.append(pyarrow.RecordBatch.from_arrays(arrays, schema=schema))
            if sum(batch.num_rows for batch in waiting) >= group:
                writer.write_table(pyarrow.Table.from_batches(waiting))
                waiting.clear()
        if waiting:
            writer.write_table(pyarrow.Table.from_batches(waiting))


def _schema(contents: Contents) -> pyarrow.Schema:
    import pyarrow  # noqa: PLC0415
    from astropy.table import meta  # noqa: PLC0415

    kinds: dict[type, Any] = {int: pyarrow.int64(), float: pyarrow.float64()}
    table = empty_table(contents)
    fields = []
    for column in contents.columns:
        unit = table[column.name].unit
        told = {"description": table[column.name].description} | ({} if unit is None else {"unit": str(unit)})
        fields.append(pyarrow.field(column.name, kinds.get(column.kind, pyarrow.string()), metadata=told))
    lengths = {f"table::len::{name}": str(width.characters) for name, width in contents.widths.items()}
    head, tail = document(contents, '<PARQUET type="Parquet-local-XML"/>')
    metadata = {
        "table_meta_yaml": "\n".join(meta.get_yaml_from_table(table)),
        "IVOA.VOTable-Parquet.version": "1.0",
        "IVOA.VOTable-Parquet.content": head + tail,
        **lengths,
    }
    return pyarrow.schema(fields, metadata=metadata)
