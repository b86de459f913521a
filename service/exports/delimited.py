"""Results as text, a line each: CSV, and ECSV, which is the same below a header of units and descriptions."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from typing import BinaryIO

from service.exports.contents import Contents, Rows
from service.exports.template import empty_table


def write_csv(pieces: Iterable[Rows], contents: Contents, sink: BinaryIO) -> None:
    """Names, then values: a number as the shortest text that gives it back, nothing where there is no value."""
    _write(pieces, contents, sink, "")


def write_ecsv(pieces: Iterable[Rows], contents: Contents, sink: BinaryIO) -> None:
    """The same below a header in YAML (Astropy's APE 6)."""
    text = io.StringIO()
    empty_table(contents).write(text, format="ascii.ecsv", delimiter=",")
    header = "".join(line for line in text.getvalue().splitlines(keepends=True) if line.startswith("#"))
    _write(pieces, contents, sink, header)


def _write(pieces: Iterable[Rows], contents: Contents, sink: BinaryIO, header: str) -> None:
    text = io.StringIO(newline="")
    text.write(header)
    lines = csv.writer(text, lineterminator="\n")
    lines.writerow([column.name for column in contents.columns])
    for piece in pieces:
        lines.writerows(piece)
        sink.write(text.getvalue().encode())
        text.seek(0)
        text.truncate()
    sink.write(text.getvalue().encode())
