"""``hostlens compare-codes``: one image by hostlens, lenstronomy and PyAutoLens, as a table and as COOLEST."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.cli.measuring import observation_of_files
from service.cli.outputs import require_apart, require_file, require_folder, require_readable
from service.cli.pictures import refusals

if TYPE_CHECKING:
    from rich.table import Table

    from engine import Comparison

_HOST = ("magnitude", "r_eff", "n")


def compare_codes(
    image: Annotated[Path, typer.Argument(help="FITS; one of `hostlens simulate` has noise map and PSF in it")],
    noise: Annotated[Path | None, typer.Option(help="1 sigma map; as for `hostlens measure`")] = None,
    psf: Annotated[Path | None, typer.Option(help="PSF on the image's pixels; any centre")] = None,
    pixel_scale: Annotated[float | None, typer.Option(help="arcsec; the image's header without")] = None,
    zeropoint: Annotated[float | None, typer.Option(help="AB magnitude of 1 e-/s; the image's header without")] = None,
    mask: Annotated[Path | None, typer.Option(help="FITS, not zero where a pixel may be used")] = None,
    theta_e: Annotated[float | None, typer.Option("--theta-e", help="Rough Einstein radius, arcsec")] = None,
    agn_images: Annotated[int | None, typer.Option(help="How many AGN images there are, 0 for none")] = None,
    autolens: Annotated[Path | None, typer.Option(help="Python that PyAutoLens is installed for; ours without")] = None,
    folder: Annotated[Path | None, typer.Option(help="Where to write each code's lens model as COOLEST")] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="Where to write the answers")] = None,
) -> None:
    """Measure one image by several codes. Ours, lenstronomy and PyAutoLens, those that are installed.

    All have the same pixels, noise, PSF, parameters and priors; each draws lens, light and PSF by itself and begins
    away from our answer. A minute for a code.
    """
    if json_file is not None:
        require_file(json_file, {".json"})
        require_apart([json_file], [image])
    if folder is not None:
        require_folder(folder)
    require_readable([path for path in (image, noise, psf, mask, autolens) if path is not None])
    with refusals():
        from rich.console import Console  # noqa: PLC0415 - help needs none

        observation = observation_of_files(
            image, psf, trust_options=False, noise=noise, pixel_scale=pixel_scale, zero_point=zeropoint, mask=mask
        )
        import engine  # noqa: PLC0415 - seconds, which only an image is worth

        with Console(stderr=True).status("hostlens") as status:
            found = engine.measure_image(observation, theta_E=theta_e, agn_images=agn_images, inversion=False)
            compared = engine.compare_codes(
                found, autolens, lambda code, steps: status.update(f"{code}: step {steps:.0f}")
            )
        for warning in found.warnings:
            typer.echo(f"warning: {warning}", err=True)
        _tell(compared)
        if json_file is not None:
            answers = [answer.to_dict() for answer in compared.answers]
            text = json.dumps({"answers": answers, "without_answer": compared.without_answer}, indent=2)
            json_file.write_text(text + "\n", encoding="utf-8")
            typer.echo(json_file)
        if folder is not None:
            for path in engine.write_coolest(folder, compared.task, list(compared.answers)):
                typer.echo(path)


def _tell(compared: Comparison) -> None:
    from service.cli.connection import console  # noqa: PLC0415 - as above

    console().print(_table(compared))
    for answer in compared.answers:
        for limit in answer.limits:
            typer.echo(f"{answer.code}: {limit}")
    for code, why in compared.without_answer.items():
        typer.echo(f"{code}: {why}")


def _table(compared: Comparison) -> Table:
    """A line for each quantity, a column for each code."""
    from rich import box  # noqa: PLC0415 - as above
    from rich.table import Table  # noqa: PLC0415 - as above

    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column("")
    for answer in compared.answers:
        table.add_column(f"{answer.code} {answer.version}", justify="right")
    for name in _HOST:
        cells = [getattr(answer if name == "magnitude" else answer.host, name) for answer in compared.answers]
        shown = [f"{x:.3f} +- {a.errors[name]:.3f}" for x, a in zip(cells, compared.answers, strict=True)]
        table.add_row(f"host {name}", *shown)
    for name in compared.task.fit.lens_names:
        shown = [f"{getattr(a.lens, name):.4f} +- {a.errors[name]:.4f}" for a in compared.answers]
        table.add_row(f"lens {name}", *shown)
    table.add_row("chi2 per degree of freedom", *(f"{answer.chi2_per_dof:.3f}" for answer in compared.answers))
    table.add_row("seconds", *(f"{answer.seconds:.0f}" for answer in compared.answers))
    return table
