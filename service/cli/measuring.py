"""The command that measures the host galaxy in an image of anybody's."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.cli.outputs import FITS, PICTURES, require_apart, require_file, require_readable
from service.cli.pictures import refusals

if TYPE_CHECKING:
    from engine import Calibration, ImageMeasurement, Observation

_DPI = 110
_UNITS = ("e-/s", "e-", "count/s", "count", "DN/s", "DN", "MJy/sr")
_SAID = {"parametric": "parametric fit"}
"""What is said of a stage of the engine; all the others are the inversion."""


def measure(
    image: Annotated[Path, typer.Argument(help="FITS; one of `hostlens simulate` has noise map and PSF in it")],
    noise: Annotated[Path | None, typer.Option(help="1 sigma map; the image's ERR, or made from it, without")] = None,
    psfs: Annotated[
        list[Path] | None,
        typer.Option("--psf", help="PSF on the image's pixels; any centre; again for others that it may as well be"),
    ] = None,
    pixel_scale: Annotated[float | None, typer.Option(help="arcsec; the image's header without")] = None,
    zeropoint: Annotated[float | None, typer.Option(help="AB magnitude of 1 e-/s; the image's header without")] = None,
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
    centre: Annotated[
        tuple[float, float] | None, typer.Option(help="x y of the deflector, arcsec from the middle; found without")
    ] = None,
    no_deflector: Annotated[bool, typer.Option("--no-deflector", help="The deflector does not shine")] = False,
    shear: Annotated[bool | None, typer.Option("--shear/--no-shear", help="External shear; the data decide")] = None,
    unit: Annotated[str | None, typer.Option(help=f"BUNIT, or e-/s, without; {', '.join(_UNITS)}")] = None,
    exposure: Annotated[float | None, typer.Option(help="Seconds; the image's EXPTIME without")] = None,
    gain: Annotated[float | None, typer.Option(help="Electrons in a count of the image")] = None,
    saturation: Annotated[float | None, typer.Option(help="e-/s of a saturated pixel")] = None,
    sky_rms: Annotated[float | None, typer.Option(help="e-/s of the empty sky's noise; without --noise only")] = None,
    mask: Annotated[Path | None, typer.Option(help="FITS, not zero where a pixel may be used")] = None,
    psf_oversampling: Annotated[
        int | None, typer.Option(help="How many times as finely as the image the PSF is sampled")
    ] = None,
    dq: Annotated[Path | None, typer.Option(help="FITS, flags of bad pixels; the image's DQ without")] = None,
    good_bits: Annotated[str | None, typer.Option(help="Flags that do no harm, as 64,512 or WARM,HOT")] = None,
    center: Annotated[tuple[str, str] | None, typer.Option(help="RA Dec to cut the image out by")] = None,
    size: Annotated[float | None, typer.Option(help="Side of the cutout, arcsec")] = None,
    extension: Annotated[str | None, typer.Option(help="Name or number of the image's plane, as SCI,2")] = None,
    trust_options: Annotated[
        bool, typer.Option("--trust-options", help="Options overrule a file that contradicts; doubts become warnings")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of the chain")] = 0,
    inversion: Annotated[bool, typer.Option(help="Sample the inversion too; without it seconds")] = True,
    calibrations: Annotated[
        int | None, typer.Option("--calibrate", help="Correct the answer by so many simulations like the image")
    ] = None,
) -> None:
    """Measure the host galaxy in an image. Its magnitude, radius and index, with their uncertainties."""
    if no_agn and (agn_images or positions):
        raise typer.BadParameter("--no-agn: there are --agn-images or --positions as well")
    outputs = [path for path in (json_file, figure, fits) if path is not None]
    inputs = [path for path in (image, noise, *(psfs or ()), mask, dq) if path is not None]
    require_apart(outputs, inputs)
    for path, kinds in ((json_file, ()), (figure, PICTURES), (fits, FITS)):
        if path is not None:
            require_file(path, kinds)
    require_readable(inputs)
    where = _positions(positions)
    with refusals():
        from rich.console import Console  # noqa: PLC0415 - help needs none

        options: dict[str, Any] = {
            "trust_options": trust_options, "noise": noise, "pixel_scale": pixel_scale, "zero_point": zeropoint,
            "mask": mask, "dq": dq, "unit": unit, "exposure_s": exposure, "gain": gain, "saturation_e_s": saturation,
            "sky_rms_e_s": sky_rms, "good_bits": good_bits, "center": center, "size": size, "extension": extension,
            "psf_oversampling": psf_oversampling,
        }  # fmt: skip
        given: list[Path | None] = [*psfs] if psfs else [None]
        observation, *others = [observation_of_files(image, psf, **options) for psf in given]
        from engine import calibrate, measure_image, readings  # noqa: PLC0415 - seconds, which only an image is worth

        for reading in readings(observation):
            typer.echo(f"read.{reading.name:12s} {_short(reading.value)}  ({reading.origin})")
        console = Console(stderr=True)
        with console.status("reading") as status:
            found = measure_image(
                observation, profile=profile, agn_images=0 if no_agn else agn_images, deflector=not no_deflector,
                shear=shear, theta_E=theta_e, positions=where, centre=centre, seed=seed,
                inversion=inversion, other_psfs=[other.psf for other in others],
                trust_options=trust_options, progress=lambda stage, _: status.update(_SAID.get(stage, "inversion")),
            )  # fmt: skip
            calibration = None
            if calibrations is not None:
                calibration = calibrate(
                    found, calibrations, seed, lambda _, done: status.update(f"simulations {done:.0%}")
                )
    for line in (*_summary(found), *([] if calibration is None else _corrected(calibration))):
        typer.echo(line)
    for warning in found.warnings:
        typer.echo(f"warning: {warning}", err=True)
    failed = _write(found, calibration, json_file, figure, fits)
    for path in outputs:
        typer.echo(f"{path}: not written ({failed[path]})" if path in failed else path, err=path in failed)
    if failed:
        raise typer.Exit(1)


def _short(value: str | float) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def observation_of_files(image: Path, psf: Path | None, *, trust_options: bool, **how: Any) -> Observation:
    """Our own FITS file as it is, or anybody's from its parts; ``how`` is None where nothing is given."""
    if psf is None:
        return _own_observation(image, [name for name, value in how.items() if value is not None])
    if how["unit"] not in (None, *_UNITS):
        raise typer.BadParameter(f"--unit: got {how['unit']!r}, allowed is one of {', '.join(_UNITS)}")
    from engine import read_external_observation  # noqa: PLC0415 - seconds, which only right options are worth

    return read_external_observation(
        image, psf, recentre_psf="pixel", normalise_psf=True, mend_psf=True, trust_options=trust_options, **how
    )


def _own_observation(image: Path, told: list[str]) -> Observation:
    """An observation of ours, of which nothing may be ``told``: parameters of the reader, as ``exposure_s``."""
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
    if told:
        plain = (name.replace("zero_point", "zeropoint").removesuffix("_e_s").removesuffix("_s") for name in told)
        extra = ", ".join(f"--{name.replace('_', '-')}" for name in plain)
        raise typer.BadParameter(f"{image} has its own noise map, PSF and zero point in it: leave out {extra}")
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


def _write(
    found: ImageMeasurement,
    calibration: Calibration | None,
    json_file: Path | None,
    figure: Path | None,
    fits: Path | None,
) -> dict[Path, Exception]:
    """Each file whole or not at all; those that could not be written, and why: none takes another with it."""

    def draw(path: Path) -> None:
        from engine.figures import measurement_figure  # noqa: PLC0415 - matplotlib takes a while

        kind = (figure or path).suffix.lower().removeprefix(".") or "png"
        measurement_figure(found).savefig(path, dpi=_DPI, format=kind)

    def store(path: Path) -> None:
        from engine.measurement_files import write_measurement  # noqa: PLC0415 - as above

        write_measurement(path, found)

    def tell(path: Path) -> None:
        told = found.to_dict() | ({} if calibration is None else {"calibration": calibration.to_dict()})
        path.write_text(json.dumps(told, indent=2, allow_nan=False) + "\n", encoding="utf-8")

    failed: dict[Path, Exception] = {}
    for target, write in ((json_file, tell), (fits, store), (figure, draw)):
        if target is not None:
            try:
                _whole(target, write)
            except (OSError, ValueError, TypeError, RuntimeError, ArithmeticError, MemoryError) as error:
                failed[target] = error
    return failed


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
    if found.fit.deflector_gaussians:
        lines.append(f"deflector: {len(found.fit.deflector_gaussians)} Gaussians instead of a Sersic profile")
    told = ", ".join(f"{name} {value:g}" for name, value in found.priors.items())
    lines.append(f"priors of the lens: {told}")
    lines += [
        f"psf {one['psf']}: weight {one['weight']:.2f}, chi2/dof {one['chi2_per_dof']:.2f}, "
        f"host {one['magnitude']:.3f} +- {one['sd']:.3f}"
        for one in found.to_dict()["psfs"]
    ]
    if found.host_limit is not None:
        lines.append(f"host: not detected, fainter than {found.host_limit:.2f} mag (95 %)")
    lines.append(f"{len(found.agn)} AGN images, chi2/dof {found.chi2_per_dof:.2f}, {found.estimator}, {found.status}")
    work = found.work
    told = f"{work.pixels_rendered:,} pixels rendered, {work.rays_traced:,} rays traced, "
    told += f"{work.columns_solved:,} columns solved"
    if work.parameters_sampled:
        told += f", {work.parameters_sampled} parameters sampled by {work.evidence_evaluations:,} evidence evaluations"
    return [*lines, told]


def _corrected(calibration: Calibration) -> list[str]:
    lines = [
        f"calibrated.{name:10s} {one.corrected.mean:8.3f} +- {one.corrected.sd:.3f}  "
        f"(simulations: bias {one.bias:+.3f} +- {one.bias_error:.3f}, scatter {one.pull_sd:.2f} of the errors, "
        f"{one.covered95} of {calibration.simulations} inside 95 %)"
        for name, one in calibration.quantities.items()
    ]
    return lines + [f"not measured: {count} simulations: {why}" for why, count in calibration.failed.items()]
