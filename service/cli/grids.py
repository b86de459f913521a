"""The commands that ask a service: for grids, how far they are, what came out, and to try again."""

from __future__ import annotations

from enum import StrEnum
from http import HTTPStatus
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.cli.connection import Token, Url, connected, console
from service.cli.outputs import as_file_name, require_folder
from service.cli.request_file import named_or_read, read_request
from service.cli.sky import DeflectorOption, HostImageOption, HostOption, deflectors_asked, hosts_asked

if TYPE_CHECKING:
    from collections.abc import Sequence

    from service.client import Client
    from service.domain.answers import SummaryAnswer
    from service.domain.views import GridView

Floats = Annotated[list[float] | None, typer.Option()]
GridArgument = Annotated[str, typer.Argument(help="Its id, as g_06h05zns0sxqesvz1qxk4a1s56")]
Where = Annotated[
    list[str] | None,
    typer.Option(metavar="AXIS=VALUE", help="As system=HE0435 or magnitude=20..22; may be repeated"),
]
_WATCH = typer.Option(
    "--wait", "--watch", help="Stay until the grid has ended; exit code 1 unless all runs that are needed are stored"
)
Watch = Annotated[bool, _WATCH]


class Format(StrEnum):
    """How numbers are shown."""

    TABLE = "table"
    JSON = "json"
    CSV = "csv"


class Picture(StrEnum):
    """Kinds of files that figures are drawn to."""

    SVG = "svg"
    PNG = "png"


def submit(
    preset: Annotated[str | None, typer.Option(help="As h0licow-vi/HE0435")] = None,
    system: Annotated[
        list[str] | None, typer.Option(help="A name, or a TOML or JSON file; may be repeated, like the values below")
    ] = None,
    n: Floats = None,
    host: HostOption = None,
    host_image: HostImageOption = None,
    r_eff: Floats = None,
    magnitude: Floats = None,
    l_eta: Floats = None,
    deflector: DeflectorOption = None,
    seed: Annotated[int | None, typer.Option(help="Of the first replicate; 0 without")] = None,
    replicates: Annotated[int | None, typer.Option(help="Seeds of each point; 1 without")] = None,
    until: Annotated[
        str | None,
        typer.Option(metavar="QUANTITY=ERROR", help="Seeds until its mean bias is known so well, as magnitude=0.02"),
    ] = None,
    until_estimator: Annotated[str | None, typer.Option(help="By which; the recommended one without")] = None,
    at_least: Annotated[int | None, typer.Option(help="Seeds of each point, with --until; 10 without")] = None,
    at_most: Annotated[int | None, typer.Option(help="The same; 100 without")] = None,
    camera: Annotated[str | None, typer.Option(help="Instead of the systems': a name, or a TOML or JSON file")] = None,
    mass_model: Annotated[str | None, typer.Option(help="recommended without, or another of the systems")] = None,
    noise_level: Annotated[str | None, typer.Option(help="author without (the paper's scripts), or handbook")] = None,
    defocus_nm: Annotated[
        list[float] | None, typer.Option(help="Focus error of the telescope, nm rms of wavefront; an axis if repeated")
    ] = None,
    jitter: Annotated[list[float] | None, typer.Option(help="Pointing jitter, arcsec rms an axis")] = None,
    colour: Annotated[
        list[float] | None, typer.Option(help="How much bluer the sky is than the star of the PSF: slope of photons")
    ] = None,
    residual: Annotated[
        list[float] | None, typer.Option(help="Smooth random error of the PSF, rms as a part of its light")
    ] = None,
    residual_seed: Annotated[list[int] | None, typer.Option(help="Of the random error")] = None,
    coarse: Annotated[
        list[int] | None, typer.Option(help="Sub-pixels a side on which the analysis knows the PSF")
    ] = None,
    profile: Annotated[str | None, typer.Option(help="Of the analysis: draft, standard, reference or paper")] = None,
    estimator: Annotated[
        list[str] | None, typer.Option(help="Whose answer is wanted, as image, which takes seconds; all without")
    ] = None,
    analysis: Annotated[
        list[str] | None, typer.Option(metavar="FIELD=VALUE", help="Any other of the analysis, as draws=60, in JSON")
    ] = None,
    name: Annotated[str | None, typer.Option(help="For people")] = None,
    file: Annotated[Path | None, typer.Option(help="A body as JSON or TOML; options override it")] = None,
    key: Annotated[str | None, typer.Option(help="Idempotency key: the same grid again")] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what it would be")] = False,
    wait: Watch = False,
    url: Url = None,
    token: Token = None,
) -> None:
    """Submit a grid, and print its id."""
    request = {} if file is None else read_request(file, "--file")
    options = {
        "preset": preset, "systems": [named_or_read(entry, "--system") for entry in system or []],
        "n": n, "hosts": hosts_asked(host, host_image), "r_eff": r_eff, "magnitude": magnitude, "l_eta": l_eta,
        "deflectors": deflectors_asked(deflector), "seed": seed, "replicates": replicates,
        "camera": None if camera is None else named_or_read(camera, "--camera"),
        "mass_model": mass_model, "noise_level": noise_level, "name": name,
    }  # fmt: skip
    request |= {option: value for option, value in options.items() if value not in (None, [])}
    rule = {"estimator": until_estimator, "at_least": at_least, "at_most": at_most}
    _change(request, "until", {**_error_of(until), **rule})
    _spoil(
        request, defocus_nm=defocus_nm, jitter=jitter, colour=colour, residual=residual, residual_seed=residual_seed,
        coarse=coarse,
    )  # fmt: skip
    _change(request, "analysis", {**_fields(analysis), "profile": profile, "estimators": estimator or None})
    with connected(url, token) as client:
        if dry_run:
            from service.cli.formatting import dry_run_lines  # noqa: PLC0415 - as all that a command needs

            for line in dry_run_lines(client.dry_run(request)):
                typer.echo(line)
            return
        grid = client.submit(request, key=key)
        typer.echo(grid.id)
        if wait:
            _watch(client, grid.id)


def status(
    grid: Annotated[str | None, typer.Argument(help="A grid; the newest ones without")] = None,
    wait: Watch = False,
    runs: Annotated[bool, typer.Option("--runs", help="List the runs")] = False,
    url: Url = None,
    token: Token = None,
) -> None:
    """How far grids are."""
    with connected(url, token) as client:
        if grid is None:
            for item in client.grids().items:
                _tell(item)
        elif wait:
            _watch(client, grid)
        elif runs:
            from service.cli.formatting import runs_table  # noqa: PLC0415 - as above

            console().print(runs_table(client.runs(grid)))
        else:
            _tell(client.status(grid))


def results(
    grids: Annotated[list[str] | None, typer.Argument(help="Grids; all there are without")] = None,
    group_by: Annotated[
        str, typer.Option(metavar="AXES", help="Comma-separated, of system, n, magnitude, camera, profile and others")
    ] = "system,n",
    where: Where = None,
    quantity: Annotated[str, typer.Option(help="magnitude, r_eff, r_eff_galfit, n, q, position_angle, x or y")] = (
        "magnitude"
    ),
    estimator: Annotated[str | None, typer.Option(help="The recommended one without, which is image")] = None,
    index_prior: Annotated[str | None, typer.Option(help="wide (n in 0.3-8) without")] = None,
    style: Annotated[Format, typer.Option("--format", help="csv and json have all numbers")] = Format.TABLE,
    url: Url = None,
    token: Token = None,
) -> None:
    """Biases by group, and whether the stated errors hold."""
    asked: dict[str, Any] = {**filters(where), "quantity": quantity}
    asked |= {"estimator": estimator} if estimator else {}
    asked |= {"index_prior": index_prior} if index_prior else {}
    with connected(url, token) as client:
        with _asking():
            found = client.summary(*(grids or []), group_by=group_by, **asked)
        _show(found, style)


def figures(
    grid: GridArgument,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the files; made where it is missing")] = Path(),
    kind: Annotated[Picture, typer.Option("--format")] = Picture.SVG,
    url: Url = None,
    token: Token = None,
) -> None:
    """Save the figures of a grid. Biases of each system, the sample, coverage, pulls, trends, and a montage."""
    require_folder(out)
    with connected(url, token) as client:
        from service.client import ApiError  # noqa: PLC0415 - as above

        systems = [str(row.group["system"]) for row in client.summary(grid).rows]
        wanted: list[tuple[str, str, dict[str, str]]] = [
            (f"bias_{as_file_name(system)}", "bias", {"system": system}) for system in systems
        ]
        wanted += [(name, name, {}) for name in ("sample", "coverage", "pull", "trends", "montage")]
        for stem, name, asked in wanted:
            try:
                with _asking():
                    data = client.figure(grid, name, kind, **asked)
            except ApiError as error:
                # A montage of too many runs, say: the others can be drawn. Without a result none of them can.
                if error.status != HTTPStatus.UNPROCESSABLE_ENTITY:
                    raise
                typer.echo(f"no {name}: {error}", err=True)
                continue
            (out / f"{stem}.{kind}").write_bytes(data)
            typer.echo(out / f"{stem}.{kind}")


def cancel(grid: GridArgument, url: Url = None, token: Token = None) -> None:
    """Cancel a grid."""
    with connected(url, token) as client:
        _tell(client.cancel(grid))


def pause(grid: GridArgument, url: Url = None, token: Token = None) -> None:
    """Start no further run of a grid for now. Running ones go on to their end."""
    with connected(url, token) as client:
        _tell(client.pause(grid))


def resume(grid: GridArgument, url: Url = None, token: Token = None) -> None:
    """Go on with a paused grid."""
    with connected(url, token) as client:
        _tell(client.resume(grid))


def retry(
    grid: GridArgument,
    failed: Annotated[bool, typer.Option("--failed", help="Not what was cancelled")] = False,
    where: Annotated[
        list[str] | None,
        typer.Option(metavar="FIELD=VALUE", help="As error_code=deadline or system=HE0435; may be repeated"),
    ] = None,
    url: Url = None,
    token: Token = None,
) -> None:
    """Queue again what ended without a result, or some of it."""
    only = filters(where)
    if failed:
        if "state" in only:
            raise typer.BadParameter("--failed: there is a state in --where as well")
        only["state"] = ["failed", "quarantined"]
    with connected(url, token) as client:
        found = client.retry(grid, **only)
        typer.echo(f"{found.retried} run{'' if found.retried == 1 else 's'} queued again")
        _tell(found)


COMMANDS = (submit, status, results, figures, cancel, pause, resume, retry)


def _tell(grid: GridView) -> None:
    from service.cli.formatting import grid_line  # noqa: PLC0415 - as above

    typer.echo(grid_line(grid))


def _watch(client: Client, grid_id: str) -> None:
    from service.cli.watch import progress  # noqa: PLC0415 - as above

    with progress(console()) as show:
        grid = client.wait(grid_id, show)
    _tell(grid)
    if grid.counts.done + grid.counts.not_needed != grid.n_runs:
        raise typer.Exit(1)


def _show(found: SummaryAnswer, style: Format) -> None:
    if style is Format.JSON:
        typer.echo(found.model_dump_json(indent=2))
    elif style is Format.CSV:
        from service.cli.bias_tables import bias_csv  # noqa: PLC0415 - as above

        typer.echo(bias_csv(found), nl=False)
    else:
        from service.cli.bias_tables import bias_table  # noqa: PLC0415 - as above

        console().print(bias_table(found))


def _asking() -> Any:
    """A sign on a terminal that something is under way; nothing goes to standard output."""
    from rich.console import Console  # noqa: PLC0415 - as above

    return Console(stderr=True).status("asking")


def _change(request: dict[str, Any], part: str, given: dict[str, Any]) -> None:
    """Put what was given into an object within a request."""
    given = {name: value for name, value in given.items() if value is not None}
    if given:
        before = request.get(part)
        request[part] = {**(before if isinstance(before, dict) else {}), **given}


def _spoil(request: dict[str, Any], **given: Sequence[float] | None) -> None:
    """Put optics into a request: an object, or a list of every combination where a value is given more than once."""
    named = {name: values for name, values in given.items() if values}
    several = [dict(zip(named, values, strict=True)) for values in product(*named.values())]
    if len(several) > 1:
        request["optics"] = several
    else:
        _change(request, "optics", several[0])


def filters(where: list[str] | None) -> dict[str, Any]:
    """Values by axis, of AXIS=VALUE."""
    found: dict[str, Any] = {}
    for text in where or []:
        name, value = _pair("--where", text)
        found.setdefault(name, []).append(value)
    return found


def _fields(analysis: list[str] | None) -> dict[str, Any]:
    """Fields of the analysis: what is JSON is read as such, anything else is text."""
    import json  # noqa: PLC0415 - as above

    found: dict[str, Any] = {}
    for text in analysis or []:
        name, value = _pair("--analysis", text)
        try:
            found[name] = json.loads(value)
        except (ValueError, RecursionError):
            found[name] = value
    return found


def _error_of(until: str | None) -> dict[str, Any]:
    """Quantity and error of QUANTITY=ERROR."""
    if until is None:
        return {}
    quantity, error = _pair("--until", until)
    try:
        return {"quantity": quantity, "error": float(error)}
    except ValueError:
        raise typer.BadParameter(f"--until: got {until!r}, allowed is QUANTITY=ERROR, as magnitude=0.02") from None


def _pair(option: str, text: str) -> tuple[str, str]:
    name, sign, value = text.partition("=")
    if not (name.strip() and sign):
        raise typer.BadParameter(f"{option}: got {text!r}, allowed is NAME=VALUE")
    return name.strip(), value.strip()
