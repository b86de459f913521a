"""``hostlens study``: the paper's runs with one command, and what they say of its conclusions."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.cli.connection import FailedError, Token, Url, connected, console
from service.cli.connection import settings as _settings
from service.cli.grids import Picture
from service.cli.outputs import as_file_name, require_folder, require_readable

if TYPE_CHECKING:
    import pyarrow

    from engine import Study
    from service.cli.watch import Show
    from service.client import Client
    from service.domain.views import GridView

    Guard = Callable[[Show], Show]

SHIPPED = "shipped"
FILE, TABLE = "study.parquet", "conclusions.md"
_SHOWN = {"paper": "free", "image": "wide"}
"""Estimators that are drawn, and the prior of n beside the one that fixes it."""
_WITHOUT = ("failed", "quarantined", "cancelled")


def study(
    preset: Annotated[str, typer.Argument(help="h0licow-vi, or h0licow-vi/HE0435: one of its systems")],
    seeds: Annotated[int, typer.Option(min=1, help="Noise seeds of each input")] = 2,
    profile: Annotated[str, typer.Option(help="Of the analysis: draft, standard or reference")] = "standard",
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder of results, figures, table")] = Path("study"),
    kind: Annotated[Picture, typer.Option("--format", help="Of the figures")] = Picture.SVG,
    grid: Annotated[
        list[str] | None, typer.Option(help="A grid that is there, instead of a new one; may be repeated")
    ] = None,
    source: Annotated[
        str | None, typer.Option("--from", metavar="FILE", help="A study's file, or shipped; nothing is computed")
    ] = None,
    local: Annotated[bool, typer.Option("--local", help="A service of its own, even where one is named")] = False,
    data_dir: Annotated[Path, typer.Option(help="Of its own service")] = Path("var/study"),
    url: Url = None,
    token: Token = None,
) -> None:
    """Compute the paper's runs, and write their results, the figures and the table of conclusions.

    By the service that --url names, or by one of its own with the cluster of the settings. Interrupted, the same
    command goes on where it was. Exit code 1 unless all runs have a result.
    """
    if source is not None and grid:
        raise typer.BadParameter("--grid: got one beside --from, allowed is one of them")
    if source not in (None, SHIPPED):
        require_readable([Path(source)])
    require_folder(output)
    if source is None:
        with _service(None if local else url, token, data_dir) as (client, guarded):
            ids = grid or [_submit(client, preset, profile, seeds)]
            grids = [client.status(one) for one in ids] if grid else [_ended(client, ids[0], guarded)]
            table = _collected(client, preset, grids)
        _write(table, output / FILE)
        source = str(output / FILE)
    found = _read(source)
    _report(found, output, kind)
    if found.provenance["without_result"]:
        raise FailedError(f"runs without a result: {len(found.provenance['without_result'])}; {FILE} names them")


@contextmanager
def _service(url: str | None, token: str | None, data_dir: Path) -> Iterator[tuple[Client, Guard]]:
    """The service that is named, or one of its own for as long as it takes; and what ends a wait by Ctrl-C."""
    if url is not None:
        with connected(url, token) as client:
            yield client, lambda show: show
        return
    import httpx  # noqa: PLC0415 - what a command needs it loads itself

    from service.cli.own_service import StoppedError, own_service, wait_until_ready  # noqa: PLC0415 - as above
    from service.client import ClientError  # noqa: PLC0415 - as above
    from service.runtime.installation import DidNotHappenError  # noqa: PLC0415 - as above

    with own_service(_settings(data_dir=data_dir)) as (service, stop):
        typer.echo(f"a service of its own at {service.client.url}, data in {data_dir}")
        try:
            wait_until_ready(service, stop)
            yield service.client, stop.until
        except StoppedError:
            typer.echo("interrupted: the same command goes on from here")
            raise typer.Exit(128 + stop.number) from None
        except (ClientError, DidNotHappenError, httpx.RequestError) as error:
            raise FailedError(str(error)) from error


def _submit(client: Client, preset: str, profile: str, seeds: int) -> str:
    """The grid of the study: for one engine the same one each time, so that what is interrupted goes on."""
    request = {"name": f"study {preset}", "preset": preset, "replicates": seeds, "analysis": {"profile": profile}}
    key = f"study:{preset}:{profile}:{seeds}:{client.engine().digest[:16]}"
    found = client.submit(request, key=key)
    typer.echo(f"grid {found.id}: {found.n_runs} runs, {found.counts.done} stored")
    return found.id


def _ended(client: Client, grid_id: str, guarded: Guard) -> GridView:
    """The grid once it has ended."""
    from service.cli.watch import progress  # noqa: PLC0415 - as above

    with progress(console()) as show:
        return client.wait(grid_id, guarded(show))


def _collected(client: Client, preset: str, grids: Sequence[GridView]) -> pyarrow.Table:
    """What the runs of grids found, with where it is from."""
    import json  # noqa: PLC0415 - as above

    from pyarrow import parquet  # noqa: PLC0415 - as above

    from service.exports.study_file import study_table  # noqa: PLC0415 - as above

    ids = [grid.id for grid in grids]
    exported = parquet.read_table(io.BytesIO(client.export("parquet", *ids, estimator="all", specs="true")))
    if not exported.num_rows:
        raise FailedError(f"no run of {', '.join(ids)} has a result yet")
    without = [
        {"label": run.label, "state": run.state, "error": None if run.error is None else run.error.code}
        for one in ids
        for state in _WITHOUT
        for run in client.runs(one, state)
    ]
    stored = sorted(exported["stored_at"].to_pylist())
    provenance: dict[str, Any] = {
        "study": preset,
        "service": client.engine().version,
        "engines": _different(exported, "engine_digest"),
        "profiles": _different(exported, "profile"),
        "seeds": _different(exported, "seed"),
        "versions": [json.loads(text) for text in _different(exported, "versions")],
        "grids": ids,
        "stored": [stored[0], stored[-1]],
        "runs": exported.num_rows,
        "runs_asked": sum(grid.n_runs for grid in grids),
        "without_result": without,
    }
    return study_table(exported, provenance)


def _different(table: pyarrow.Table, column: str) -> list[Any]:
    return sorted(set(table[column].to_pylist()))


def _write(table: pyarrow.Table, path: Path) -> None:
    from service.exports.study_file import write_study  # noqa: PLC0415 - as above

    with path.open("wb") as sink:
        write_study(table, sink)
    typer.echo(path)


def _read(source: str) -> Study:
    from engine import StudyError, read_study  # noqa: PLC0415 - as above

    try:
        return read_study(None if source == SHIPPED else Path(source))
    except StudyError as error:
        raise typer.BadParameter(f"--from: {error}") from error


def _report(found: Study, output: Path, kind: Picture) -> None:
    """The figures and the table of conclusions."""
    from engine import conclusions_markdown, study_conclusions  # noqa: PLC0415 - as above
    from service.cli.formatting import conclusions_table  # noqa: PLC0415 - as above

    for stem, data in _figures(found, kind):
        path = output / f"{as_file_name(stem)}.{kind}"
        path.write_bytes(data)
        typer.echo(path)
    (output / TABLE).write_text(conclusions_markdown(found), encoding="utf-8")
    typer.echo(output / TABLE)
    console().print(conclusions_table(study_conclusions(found)))


def _figures(found: Study, kind: Picture) -> Iterator[tuple[str, bytes]]:
    """Four panels of each system and six of the sample, by the paper's estimator and by the recommended one."""
    from engine.figures import bias_figure, figure_bytes, sample_figure  # noqa: PLC0415 - as above

    said = found.provenance
    heading = f"{said['study']}, profile {', '.join(said['profiles'])}, noise seed {', '.join(map(str, said['seeds']))}"
    for estimator, free in _SHOWN.items():
        points = found.points(estimator, free, "fixed")  # type: ignore[arg-type]
        for system in sorted({point.system for point in points}):
            drawn = bias_figure([point for point in points if point.system == system], heading=heading)
            yield f"bias_{system}_{estimator}", figure_bytes(drawn, kind.value)
        yield f"sample_{estimator}", figure_bytes(sample_figure(points, free=free, heading=heading), kind.value)  # type: ignore[arg-type]
