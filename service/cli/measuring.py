"""The command that measures the host galaxy in an image of anybody's."""

from __future__ import annotations

import json
import math
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.cli.outputs import FITS, PICTURES, require_apart, require_file, require_readable
from service.cli.pictures import refusals

if TYPE_CHECKING:
    from engine import ImageMeasurement, Observation

_DPI = 110
_SAID = {"parametric": "parametric fit"}
"""What is said of a stage of the engine; all the others are the inversion."""


def measure(
    image: Annotated[Path, typer.Argument(help="FITS; one of `hostlens simulate` has noise map and PSF in it")],
    noise: Annotated[Path | None, typer.Option(help="1 sigma map; made from the image without one")] = None,
    psf: Annotated[Path | None, typer.Option(help="PSF on the image's pixels; any centre")] = None,
    pixel_scale: Annotated[float | None, typer.Option(help="arcsec; the image's header without")] = None,
    zeropoint: Annotated[float | None, typer.Option(help="AB magnitude of 1 e-/s")] = None,
    profile: Annotated[str, typer.Option(help="draft, standard or reference")] = "standard",
    json_file: Annotated[Path | None, typer.Option("--json", help="Where to write the result")] = None,
    figure: Annotated[Path | None, typer.Option(help="Where to draw it (PNG, PDF, SVG)")] = None,
    fits: Annotated[Path | None, typer.Option(help="Where to write model, residual and arc")] = None,
    theta_e: Annotated[float | None, typer.Option("--theta-e", help="Rough Einstein radius, arcsec")] = None,
    agn_images: Annotated[int | None, typer.Option(help="How many AGN images there are; found without")] = None,
    no_agn: Annotated[bool, typer.Option("--no-agn", help="There is no AGN: --agn-images 0")] = False,
    positions: Annotated[
        list[str] | None, typer.Option(help="x,y of an AGN image in arcsec from the middle; once for each image")
    ] = None,
    no_deflector: Annotated[bool, typer.Option("--no-deflector", help="The deflector does not shine")] = False,
    shear: Annotated[bool | None, typer.Option("--shear/--no-shear", help="External shear; the data decide")] = None,
    unit: Annotated[str, typer.Option(help="Of image and noise map: e-/s or e-")] = "e-/s",
    exposure: Annotated[float | None, typer.Option(help="Seconds; the image's EXPTIME without")] = None,
    gain: Annotated[float, typer.Option(help="Electrons in a count of the image")] = 1.0,
    saturation: Annotated[float | None, typer.Option(help="e-/s of a saturated pixel; without --noise only")] = None,
    sky_rms: Annotated[float | None, typer.Option(help="e-/s of the empty sky's noise; without --noise only")] = None,
    mask: Annotated[Path | None, typer.Option(help="FITS, not zero where a pixel may be used")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the chain")] = 0,
    inversion: Annotated[bool, typer.Option(help="Sample the inversion too; without it seconds")] = True,
) -> None:
    """Measure the host galaxy in an image. Its magnitude, radius and index, with their uncertainties."""
    if no_agn and (agn_images or positions):
        raise typer.BadParameter("--no-agn: there are --agn-images or --positions as well")
    outputs = [path for path in (json_file, figure, fits) if path is not None]
    require_apart(outputs, [path for path in (image, noise, psf, mask) if path is not None])
    for path, kinds in ((json_file, ()), (figure, PICTURES), (fits, FITS)):
        if path is not None:
            require_file(path, kinds)
    require_readable(path for path in (image, noise, psf, mask) if path is not None)
    where = _positions(positions)
    with refusals():
        from rich.console import Console  # noqa: PLC0415 - help needs none

        observation = _observation(
            image, noise, psf, pixel_scale, zeropoint,
            mask=mask, unit=unit, exposure_s=exposure, gain=gain, saturation_e_s=saturation, sky_rms_e_s=sky_rms,
        )  # fmt: skip
        from engine import measure_image  # noqa: PLC0415 - seconds, which only an image is worth

        console = Console(stderr=True)
        with console.status("reading") as status:
            found = measure_image(
                observation, profile=profile, agn_images=0 if no_agn else agn_images, deflector=not no_deflector,
                shear=shear, theta_E=theta_e, positions=where, seed=seed, inversion=inversion,
                progress=lambda stage, _: status.update(_SAID.get(stage, "inversion")),
            )  # fmt: skip
        _write(found, json_file, figure, fits)
    for line in _summary(found):
        typer.echo(line)
    for warning in found.warnings:
        typer.echo(f"warning: {warning}", err=True)
    for path in outputs:
        typer.echo(path)


def _observation(
    image: Path, noise: Path | None, psf: Path | None, pixel_scale: float | None, zeropoint: float | None, **how: Any
) -> Observation:
    """Our own FITS file as it is, or anybody's from its parts."""
    if psf is None:
        return _own_observation(image, (noise, pixel_scale, zeropoint))
    if zeropoint is None or not math.isfinite(zeropoint):
        raise typer.BadParameter("--zeropoint: the AB magnitude of 1 e-/s must be given")
    if how["unit"] not in ("e-/s", "e-"):
        raise typer.BadParameter(f"--unit: got {how['unit']!r}, allowed is e-/s or e-")
    from engine import read_external_observation  # noqa: PLC0415 - seconds, which only right options are worth

    return read_external_observation(
        image, psf, zero_point=zeropoint, noise=noise, pixel_scale=pixel_scale, recentre_psf="pixel",
        normalise_psf=True, **how,
    )  # fmt: skip


def _own_observation(image: Path, told: tuple[Path | float | None, ...]) -> Observation:
    from astropy.io import fits  # noqa: PLC0415 - as the engine

    from engine import ObservationError  # noqa: PLC0415

    try:
        own = "HOSTLENS" in fits.getheader(image)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise ObservationError(f"{image}: not a FITS file that can be read ({error})") from error
    if not own:
        raise typer.BadParameter(f"--psf: {image} is not of `hostlens simulate`, so a PSF must be given")
    if any(value is not None for value in told):
        raise typer.BadParameter(f"{image} has noise map, pixel scale and zero point in it: leave them out")
    from engine import read_observation  # noqa: PLC0415 - as above

    return read_observation(image)


def _positions(given: list[str] | None) -> list[tuple[float, float]] | None:
    if not given:
        return None
    out = []
    for text in " ".join(given).split():
        try:
            x, y = map(float, text.split(","))
        except ValueError:
            raise typer.BadParameter(f"--positions: got {text!r}, allowed is x,y in arcsec, as 1.2,-0.4") from None
        out.append((x, y))
    return out


def _write(found: ImageMeasurement, json_file: Path | None, figure: Path | None, fits: Path | None) -> None:
    """Each file whole or not at all."""
    if figure is not None:
        from engine.figures import measurement_figure  # noqa: PLC0415 - matplotlib takes a while

        kind = figure.suffix.lower().removeprefix(".") or "png"
        _whole(figure, lambda path: measurement_figure(found).savefig(path, dpi=_DPI, format=kind))
    if fits is not None:
        from engine.measurement_files import write_measurement  # noqa: PLC0415 - as above

        _whole(fits, lambda path: write_measurement(path, found))
    if json_file is not None:
        text = json.dumps(found.to_dict(), indent=2, allow_nan=False) + "\n"
        _whole(json_file, lambda path: path.write_text(text, encoding="utf-8"))


def _whole(path: Path, write: Callable[[Path], Any]) -> None:
    handle, name = tempfile.mkstemp(dir=path.absolute().parent, prefix=f".{path.name}.")
    os.close(handle)
    part = Path(name)
    try:
        write(part)
        part.chmod(0o644)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def _summary(found: ImageMeasurement) -> list[str]:
    host, lens = found.host, found.lens
    values = (("magnitude", host.magnitude), ("radius", host.r_eff), ("n", host.n))
    lines = [f"host.{name:10s} {value.mean:8.3f} +- {value.sd:.3f}" for name, value in values]
    lines += [f"lens.{name:10s} {value.mean:8.3f} +- {value.sd:.3f}" for name, value in lens.items()]
    lines.append(f"{len(found.agn)} AGN images, chi2/dof {found.chi2_per_dof:.2f}, {found.estimator}, {found.status}")
    return lines
