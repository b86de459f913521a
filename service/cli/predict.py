"""``hostlens predict``: bias and scatter to be expected in a lens that nobody has simulated."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.cli.connection import Token, Url, connected, console
from service.cli.grids import Format
from service.cli.outputs import require_file, require_readable
from service.cli.pictures import refusals
from service.cli.request_file import named_or_read

if TYPE_CHECKING:
    from rich.table import Table

    from service.domain.prediction_views import PredictedDepth, PredictedQuantity, PredictionAnswer

_QUANTITIES = ("magnitude", "r_eff", "n")


def predict(
    system: Annotated[str | None, typer.Argument(help="As HE0435, or a TOML or JSON file; none with --image")] = None,
    n: Annotated[float | None, typer.Option(help="Sersic index of the host")] = None,
    r_eff: Annotated[float | None, typer.Option(help="Of the host, arcsec")] = None,
    magnitude: Annotated[float | None, typer.Option(help="Of the host behind the lens, AB")] = None,
    l_eta: Annotated[float | None, typer.Option(help="Slope of the lens, gamma' - 1; 1 without")] = None,
    image: Annotated[Path | None, typer.Option(help="FITS, measured first: it says what the lens is")] = None,
    psf: Annotated[Path | None, typer.Option(help="PSF of an image that is not of `hostlens simulate`")] = None,
    depth: Annotated[str | None, typer.Option(help="Times the exposures, as 0.5,1,2,4; 1 without")] = None,
    estimator: Annotated[list[str] | None, typer.Option(help="As image_wide; all with n in 0.3-8 without")] = None,
    level: Annotated[float | None, typer.Option(help="Probability of the intervals; 0.9 without")] = None,
    camera: Annotated[str | None, typer.Option(help="Instead of the system's: a name, or a TOML or JSON file")] = None,
    mass_model: Annotated[str | None, typer.Option(help="recommended without")] = None,
    noise_level: Annotated[str | None, typer.Option(help="author without (the paper's scripts), or handbook")] = None,
    defocus_nm: Annotated[float | None, typer.Option(help="Focus error unknown to the analysis, nm rms")] = None,
    jitter: Annotated[float | None, typer.Option(help="Pointing jitter unknown to it, arcsec rms")] = None,
    grid: Annotated[list[str] | None, typer.Option(help="Grid of the service whose runs are to predict too")] = None,
    study: Annotated[bool, typer.Option(help="Whether the runs that come with hostlens predict")] = True,
    grid_file: Annotated[Path | None, typer.Option(help="Where to write the grid that would settle it")] = None,
    style: Annotated[Format, typer.Option("--format", help="table or json")] = Format.TABLE,
    url: Url = None,
    token: Token = None,
) -> None:
    """Bias and scatter that each estimator is expected to have in a lens, from simulated runs of other lenses."""
    if style is Format.CSV:
        raise typer.BadParameter("--format: got 'csv', allowed are table and json")
    if (system is None) == (image is None):
        raise typer.BadParameter("give a system, or an --image that says what the lens is")
    if grid_file is not None:
        require_file(grid_file, (".json",))
        if image is not None:
            raise typer.BadParameter("--grid-file: no grid is known of a lens that --image alone tells of")
    host = {"n": n, "r_eff": r_eff, "magnitude": magnitude}
    optional = {
        "l_eta": l_eta, "mass_model": mass_model, "noise_level": noise_level, "estimators": estimator or None,
        "level": level, "exposures": None if depth is None else _factors(depth), "grids": grid or None,
        "camera": None if camera is None else named_or_read(camera, "--camera"),
    }  # fmt: skip
    asked = _given(optional) | {"study": study}
    optics = _given({"defocus_nm": defocus_nm, "jitter": jitter})
    if image is not None:
        for name in ("n", "r_eff", "magnitude", "l_eta", "mass_model", "noise_level", "camera"):
            if (host | optional).get(name) is not None:
                raise typer.BadParameter(f"--{name.replace('_', '-')}: the --image says what the lens is")
        asked["traits"] = _measured(image, psf) | optics
    else:
        asked |= _of_system(str(system), host, psf) | ({"optics": optics} if optics else {})
    found = _answer(asked, url, token)
    if style is Format.JSON:
        typer.echo(found.model_dump_json(indent=2))
    else:
        _show(found)
    if grid_file is not None:
        grid_file.write_text(json.dumps(found.to_know[-1].request, indent=2) + "\n", encoding="utf-8")
        typer.echo(str(grid_file), err=style is Format.JSON)


def _given(values: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}


def _factors(text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise typer.BadParameter(f"--depth: got {text!r}, allowed are factors, as 0.5,1,2,4") from None


def _of_system(system: str, host: dict[str, float | None], psf: Path | None) -> dict[str, Any]:
    missing = [f"--{name.replace('_', '-')}" for name, value in host.items() if value is None]
    if missing:
        raise typer.BadParameter(f"the host is to be known: give {', '.join(missing)}")
    if psf is not None:
        raise typer.BadParameter("--psf: allowed with --image")
    return {"system": named_or_read(system, "SYSTEM"), "host": host}


def _measured(image: Path, psf: Path | None) -> dict[str, Any]:
    """Traits of the lens in an image, by the parametric fit."""
    require_readable([path for path in (image, psf) if path is not None])
    with refusals():
        from dataclasses import asdict  # noqa: PLC0415 - as the engine

        from engine import measure_image, traits_of_image  # noqa: PLC0415 - seconds, which only a request is worth
        from service.cli.measuring import observation_of_files  # noqa: PLC0415

        observation = observation_of_files(image, psf, trust_options=False, unit=None)
        return asdict(traits_of_image(measure_image(observation, inversion=False)))


def _answer(asked: dict[str, Any], url: str | None, token: str | None) -> PredictionAnswer:
    """By this installation, or where grids are to predict by the service that has them."""
    if asked.get("grids"):
        with connected(url, token) as client:
            return client.predict(asked)
    from pydantic import ValidationError  # noqa: PLC0415 - as the engine

    from engine import spec_error  # noqa: PLC0415 - as above
    from service.domain.predictions import PredictionRequest  # noqa: PLC0415 - as above

    with refusals():
        try:
            request = PredictionRequest.model_validate(asked)
        except ValidationError as error:
            raise spec_error(error) from error
        from service.predictions.answer import answer  # noqa: PLC0415 - loads what computes
        from service.predictions.shipped import shipped_predictor, shipped_runs  # noqa: PLC0415 - as above

        return answer(request, shipped_runs(), shipped_predictor())


def _show(found: PredictionAnswer) -> None:
    lens = ", ".join(
        f"{name} {value:.4g}" if isinstance(value, float) else f"{value}"
        for name, value in found.lens.items()
        if value not in (None, 0.0)
    )
    typer.echo(lens)
    for one in found.predictions:
        console().print(_table(found, one))
    for name, answer in found.predictions[0].estimates.items():
        near = answer.nearest
        typer.echo(f"{name}: {answer.runs} runs of {answer.lenses} lenses, {near.lens} at {near.distance:.1f}")
    typer.echo(found.told)
    for offer in found.to_know:
        cost = "of unknown cost" if offer.cpu_s is None else f"about {offer.cpu_s.expected:.0f} CPU s"
        typer.echo(f"to settle it: {offer.n_runs} runs of {offer.what}, {cost} (--grid-file writes the last)")


def _table(found: PredictionAnswer, one: PredictedDepth) -> Table:
    from rich import box  # noqa: PLC0415 - as all that a command needs
    from rich.table import Table  # noqa: PLC0415 - as above

    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, title_justify="left")
    table.title = f"Recovered minus true, {100 * found.level:g} % intervals, {one.exposures:g} times the exposures"
    for name in ("estimator", "quantity", "bias", "scatter", "one image shows"):
        table.add_column(name, justify="left" if name in {"estimator", "quantity"} else "right")
    for estimator, answer in one.estimates.items():
        for name in _QUANTITIES:
            quantity: PredictedQuantity | None = getattr(answer, name)
            if quantity is None:
                continue
            bias, scatter, shown = quantity.bias, quantity.scatter, quantity.measurement
            table.add_row(
                estimator, name, f"{bias.expected:+.3f} [{bias.low:+.3f}, {bias.high:+.3f}]",
                f"{scatter.expected:.3f} [{scatter.low:.3f}, {scatter.high:.3f}]",
                f"[{shown.low:+.3f}, {shown.high:+.3f}]",
            )  # fmt: skip
    return table
