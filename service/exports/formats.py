"""The formats of exports, by the suffix that asks for them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import BinaryIO

from service.exports.contents import Contents, Rows
from service.exports.delimited import write_csv, write_ecsv
from service.exports.fits_table import write_fits
from service.exports.parquet import write_parquet
from service.exports.votable import write_votable


@dataclass(frozen=True)
class Format:
    """How results are written, and what the file is called by its media type."""

    media_type: str
    description: str
    write: Callable[[Iterable[Rows], Contents, BinaryIO], None]


FORMATS: dict[str, Format] = {
    "csv": Format("text/csv; charset=utf-8", "CSV: names and values alone", write_csv),
    "ecsv": Format("text/x-ecsv; charset=utf-8", "ECSV: CSV below units, descriptions and provenance", write_ecsv),
    "parquet": Format("application/vnd.apache.parquet", "Parquet, also VOParquet", write_parquet),
    "vot": Format("application/x-votable+xml", "VOTable, rows as BINARY2", write_votable),
    "fits": Format("application/fits", "FITS binary table", write_fits),
}
