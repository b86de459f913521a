"""What an export holds: which columns of which results, from which picture of the database, and how large they are."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import islice
from typing import Any

from sqlalchemy import Connection, LargeBinary, Text, cast, func, select

from service import VERSION
from service.domain.payload import EstimateName
from service.store.result_filter import ResultFilter
from service.store.result_rows import ResultColumn, result_columns, result_rows, result_statement
from service.store.tables import input_group, result, run

_CELLS = 2**18
"""In a piece of an export: some tens of megabytes as Python's objects."""
Rows = Sequence[Sequence[Any]]

SPEC_COLUMNS = (
    ResultColumn("spec", str, "realization as JSON: what hostlens replay computes again", None, cast(run.c.spec, Text)),
    ResultColumn("versions", str, "versions that the run was made with, as JSON", None, cast(result.c.versions, Text)),
)


@dataclass(frozen=True)
class Question:
    """What is to be exported; ``asked`` is the filter as it was asked, for the file to repeat."""

    where: ResultFilter
    asked: Mapping[str, Sequence[str]]
    estimates: tuple[EstimateName, ...]
    specs: bool = False

    def columns(self) -> tuple[ResultColumn, ...]:
        """Columns of the file, in their order."""
        return (*result_columns(self.estimates), *(SPEC_COLUMNS if self.specs else ()))


@dataclass(frozen=True)
class Width:
    """The longest text of a column."""

    characters: int
    octets: int

    @property
    def is_ascii(self) -> bool:
        """Whether none of its texts can have another character."""
        return self.characters == self.octets


@dataclass(frozen=True)
class Contents:
    """What a writer has to know before the first row."""

    columns: tuple[ResultColumn, ...]
    rows: int
    widths: Mapping[str, Width]
    """Of the columns of text, times among them, by name."""
    provenance: Mapping[str, Any]
    """Plain data that says where the rows come from."""


def survey(connection: Connection, question: Question, now: datetime) -> Contents:
    """Count and measure what is meant; in one transaction with :func:`pieces`, or they do not fit each other."""
    columns = question.columns()
    texts = [column for column in columns if column.kind is str]
    source = result_statement(question.where, (), texts).order_by(None).subquery()
    sizes = [
        size
        for column in texts
        for size in (
            func.max(func.length(source.c[column.name])),
            func.max(func.length(cast(source.c[column.name], LargeBinary)))
            if connection.dialect.name == "sqlite"
            else func.max(func.octet_length(source.c[column.name])),
        )
    ]
    rows, *found = connection.execute(select(func.count(), *sizes).select_from(source)).one()
    widths = {
        column.name: Width(found[2 * place] or 1, found[2 * place + 1] or 1) for place, column in enumerate(texts)
    }
    widths |= {column.name: Width(_STAMP, _STAMP) for column in columns if column.kind is datetime}
    engines = select(input_group.c.engine_digest).distinct().order_by(input_group.c.engine_digest)
    inputs = question.where.inputs()
    if inputs is not None:
        engines = engines.where(input_group.c.id.in_(inputs))
    provenance = {
        "service": f"hostlens {VERSION}",
        "picture_at": stamp(now),
        "filter": {name: list(values) for name, values in question.asked.items()},
        "estimates": list(question.estimates),
        "engines": list(connection.scalars(engines)),
        "rows": rows,
    }
    return Contents(columns, rows, widths, provenance)


def pieces(connection: Connection, question: Question, columns: Sequence[ResultColumn]) -> Iterator[Rows]:
    """The rows, some at a time, in constant memory; times are text, for want of a type that all formats have."""
    times = [place for place, column in enumerate(columns) if column.kind is datetime]
    rows = result_rows(connection, question.where, question.estimates, columns)
    size = max(1, _CELLS // len(columns))
    while piece := list(islice(rows, size)):
        yield [_told(row, times) for row in piece]


def _told(row: tuple[Any, ...], times: Sequence[int]) -> list[Any]:
    values = list(row)
    for place in times:
        values[place] = stamp(values[place])
    return values


def stamp(moment: datetime) -> str:
    """A time as it stands in files: ISO 8601, in UTC, with microseconds, so that all are of one length."""
    return moment.isoformat(timespec="microseconds")


_STAMP = len("2026-01-01T00:00:00.000000+00:00")
