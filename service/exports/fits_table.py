"""Results as a FITS binary table (FITS 4.0, section 7.3)."""

from __future__ import annotations

import io
from collections.abc import Iterable
from typing import BinaryIO

from service.exports.contents import Contents, Rows, Width
from service.exports.records import NO_INTEGER, Encode, record_type, records
from service.exports.template import empty_table, flat_provenance

_BLOCK = 2880
_KEYWORDS = {
    "service": "CREATOR", "picture_at": "DATE", "filter": "FILTER", "estimates": "ESTIMATE", "engines": "ENGINES",
    "rows": "RESULTS",
}  # fmt: skip


def write_fits(pieces: Iterable[Rows], contents: Contents, sink: BinaryIO) -> None:
    """An empty primary array and one table, whose header says beforehand how many rows there are.

    A number that is not there is NaN or TNULL, a text empty. FITS has ASCII alone: other characters are escaped as
    Python does it. Descriptions stand as TCOMM and, for Astropy, once more in the form that its reader looks for.
    """
    octets = {
        name: width.octets if width.is_ascii else 10 * width.characters for name, width in contents.widths.items()
    }
    kind = record_type(contents, octets)
    sink.write(_head(contents, octets, kind.itemsize))
    encode = {name: _encoder(width) for name, width in contents.widths.items()}
    size = 0
    for piece in pieces:
        data = records(piece, contents, kind, encode).tobytes()
        sink.write(data)
        size += len(data)
    sink.write(bytes(-size % _BLOCK))


def _head(contents: Contents, octets: dict[str, int], row: int) -> bytes:
    from astropy.io import fits  # noqa: PLC0415 - takes a while

    data = io.BytesIO()
    empty_table(contents, {}).write(data, format="fits")
    with fits.open(io.BytesIO(data.getvalue())) as units:
        primary, header = units[0].header, units[1].header
    header["NAXIS1"], header["NAXIS2"] = row, contents.rows
    header["EXTNAME"] = "RESULTS"
    for place, column in enumerate(contents.columns, 1):
        if column.name in octets:
            header[f"TFORM{place}"] = f"{octets[column.name]}A"
        elif column.kind is int:
            header[f"TNULL{place}"] = NO_INTEGER
        header[f"TCOMM{place}"] = column.description
    for name, value in flat_provenance(contents).items():
        header[_KEYWORDS[name]] = value.encode("ascii", "backslashreplace").decode()
    text: str = primary.tostring() + header.tostring()
    return text.encode("ascii")


def _encoder(width: Width) -> Encode:
    return lambda text: text.encode("ascii", "strict" if width.is_ascii else "backslashreplace")
