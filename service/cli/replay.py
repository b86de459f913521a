"""``hostlens replay``: compute a run of a file again, without a service, and say whether it finds the same."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.cli.pictures import refusals
from service.cli.request_file import read_request

if TYPE_CHECKING:
    from service.domain.payload import ResultPayload

_SHOWN = 10
_SPEC_WANTED = "export it with ?specs=true"


@dataclass(frozen=True)
class OnRecord:
    """A run as a file has it; ``found`` by the names of an export of all estimators."""

    run_id: str
    kind_of_file: str
    spec: dict[str, Any]
    engine_digest: str
    payload_digest: str
    versions: dict[str, str]
    found: Mapping[str, Any]


def replay(
    file: Annotated[Path, typer.Argument(help="A run's record (JSON), or an export with specs (ECSV, Parquet)")],
    run: Annotated[str | None, typer.Argument(help="Which run of an export; may be left out where it has one")] = None,
) -> None:
    """Compute a run again: exit code 0 where it finds the same to the last bit, 1 where not, 2 for a bad file."""
    recorded = read_record(file, run)
    payload, versions = _compute(recorded.spec)
    if payload.digest == recorded.payload_digest:
        typer.echo(f"{recorded.run_id}: the same to the last bit (payload {payload.digest[:12]})")
        return
    typer.echo(f"{recorded.run_id}: not the same")
    for line in differences(recorded, payload, versions):
        typer.echo(f"  {line}")
    raise typer.Exit(1)


def read_record(file: Path, run: str | None) -> OnRecord:
    """A run of a file; a refusal where it is none of these files or has no such run."""
    readers = {".json": _of_record, ".ecsv": _of_ecsv, ".parquet": _of_parquet}
    reader = readers.get(file.suffix.lower())
    if reader is None:
        raise typer.BadParameter(f"{file}: allowed is a name that ends in {', '.join(readers)}")
    if not file.is_file():
        raise typer.BadParameter(f"{file}: is not there or is not a file")
    try:
        return reader(file, run)
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, typer.BadParameter):
            raise
        raise typer.BadParameter(f"{file}: is not what it should be ({type(error).__name__}: {error})") from error


def differences(recorded: OnRecord, payload: ResultPayload, versions: Mapping[str, str]) -> Iterator[str]:
    """What differs, a line each: engine, versions and platform, then the numbers that differ most."""
    from service.exports.record import found_by  # noqa: PLC0415 - takes a while

    if recorded.engine_digest != payload.engine_digest:
        yield f"engine: {recorded.engine_digest[:12]} on record, {payload.engine_digest[:12]} here"
    for name in sorted(recorded.versions.keys() | versions.keys()):
        then, now = recorded.versions.get(name, "not on record"), versions.get(name, "not known")
        if then != now:
            yield f"{name}: {then} on record, {now} here"
    found = found_by(payload)
    unlike = [
        (_distance(then, found[name]), name, then)
        for name, then in recorded.found.items()
        if name in found and then != found[name]
    ]
    for distance, name, then in sorted(unlike, key=lambda one: (-one[0], one[1]))[:_SHOWN]:
        yield f"{name}: {_told(then)} on record, {_told(found[name])} here ({distance:.1e} of it)"
    if len(unlike) > _SHOWN:
        yield f"and {len(unlike) - _SHOWN} more"
    if not unlike:
        yield f"no number of the {recorded.kind_of_file}: what differs is a warning or a name"


def _compute(spec: dict[str, Any]) -> tuple[ResultPayload, dict[str, str]]:
    """A run as a worker computes it, on one thread."""
    with refusals():
        from engine import realization_from_dict, run  # noqa: PLC0415 - seconds, which only a good file is worth
        from service.domain.payload import result_payload  # noqa: PLC0415
        from service.worker.machine import machine  # noqa: PLC0415
        from service.worker.tasks import one_thread  # noqa: PLC0415

        realization = realization_from_dict(spec)
        one_thread()
        payload = result_payload(run(realization))
        return payload, payload.versions | machine()


def _of_record(file: Path, run: str | None) -> OnRecord:
    from service.exports.record import FORMAT  # noqa: PLC0415 - takes a while

    document = read_request(file, "FILE")
    if document.get("format") != FORMAT:
        raise typer.BadParameter(f"{file}: format is {document.get('format')!r}, allowed is {FORMAT!r}")
    if run not in (None, document["run_id"]):
        raise typer.BadParameter(f"{file}: is the record of {document['run_id']}, not of {run}")
    names = ("spec", "engine_digest", "payload_digest", "versions", "found")
    return OnRecord(document["run_id"], "record", **{name: document[name] for name in names})


def _of_parquet(file: Path, run: str | None) -> OnRecord:
    from astropy.table.meta import get_header_from_yaml  # noqa: PLC0415 - takes a while
    from pyarrow import parquet  # noqa: PLC0415

    metadata = parquet.read_schema(file).metadata or {}
    header = get_header_from_yaml(metadata[b"table_meta_yaml"].decode().split("\n"))
    wanted = None if run is None else [("run_id", "=", run)]
    return _of_rows(file, run, parquet.read_table(file, filters=wanted).slice(0, 2).to_pylist(), header["meta"])


def _of_ecsv(file: Path, run: str | None) -> OnRecord:
    from astropy.table import Table  # noqa: PLC0415 - takes a while

    table = Table.read(file, format="ascii.ecsv")
    chosen = table if run is None else table[table["run_id"] == run]
    rows = [{name: _plain(row[name]) for name in table.colnames} for row in chosen[:2]]
    return _of_rows(file, run, rows, table.meta)


def _plain(value: Any) -> Any:
    """A value of an Astropy table as Python's own."""
    from numpy.ma import masked  # noqa: PLC0415 - loaded by now

    return None if value is masked else value.item() if hasattr(value, "item") else value


def _of_rows(file: Path, run: str | None, rows: list[dict[str, Any]], about: Mapping[str, Any]) -> OnRecord:
    """The one run of an export."""
    if len(rows) != 1:
        told = "no such run" if run is not None else "not one run alone: say which"
        raise typer.BadParameter(f"{file}: has {told if rows or run is not None else 'no run'}")
    (row,) = rows
    if "spec" not in row:
        raise typer.BadParameter(f"{file}: has no specifications: {_SPEC_WANTED}")
    # Of one estimator alone its columns have no prefix.
    estimates = about["estimates"]
    prefix = f"{estimates[0]}_" if len(estimates) == 1 else ""
    found = {name: row[name] for name in row} | {f"{prefix}{name}": value for name, value in row.items()}
    return OnRecord(
        str(row["run_id"]), "export", json.loads(row["spec"]), str(row["engine_digest"]), str(row["payload_digest"]),
        json.loads(row["versions"]), found,
    )  # fmt: skip


def _distance(then: Any, now: Any) -> float:
    """How far apart two values are, as a part of the first; what is no number on both sides is farthest."""
    if not isinstance(then, int | float) or not isinstance(now, int | float):
        return float("inf")
    return abs(now - then) / (abs(then) or 1.0)


def _told(value: Any) -> str:
    return "none" if value is None else str(value)
