"""The commands that simulate without a service: one realization, a system's 48, the eight systems, an inversion."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.cli.outputs import PICTURES, as_file_name, require_file, require_folder, require_kind, require_readable
from service.cli.sky import DeflectorOption, HostImageOption, HostOption, deflectors_asked, hosts_asked

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from engine import Camera, LensSystem, Realization, Simulation

# The engine and matplotlib take seconds to load: only a command that runs pays, not its --help.

_FILES = (".toml", ".json")
_DPI = 96
_GALLERY_RUN = 17
_N, _L_ETA = 2.0, 1.0

Out = Annotated[Path, typer.Option(help="Folder of the files; made where it is missing")]
NoiseOption = Annotated[str, typer.Option(help="author (the paper's scripts) or handbook")]
MassOption = Annotated[str, typer.Option(help="recommended, or an alternative of the system, as epl_noshear")]
CameraOption = Annotated[str | None, typer.Option(help="Instead of the system's: a name, or a TOML or JSON file")]
SeedOption = Annotated[int, typer.Option(min=0)]


@dataclass(frozen=True)
class HostOptions:
    """The host and slope as the command line gives them; None where the catalogue has to say.

    ``shape`` is the index, or what the host is instead, as a specification has it.
    """

    shape: dict[str, Any]
    r_eff: float | None
    magnitude: float | None
    l_eta: float


def simulate(
    system: Annotated[str, typer.Argument(help="A system of the catalogue, as HE0435, or a TOML or JSON file")],
    n: Annotated[float | None, typer.Option(help="Sersic index of the host; 2 where not given")] = None,
    host: HostOption = None,
    host_image: HostImageOption = None,
    r_eff: Annotated[float | None, typer.Option(help="arcsec; the paper's smaller one where not given")] = None,
    magnitude: Annotated[float | None, typer.Option(help="AB; the paper's second brightest where not given")] = None,
    l_eta: Annotated[float | None, typer.Option(help="Slope of the lens, gamma' - 1; 1 where not given")] = None,
    deflector: DeflectorOption = None,
    seed: SeedOption = 0,
    noise_level: NoiseOption = "author",
    mass_model: MassOption = "recommended",
    camera: CameraOption = None,
    defocus_nm: Annotated[float, typer.Option(help="Focus error of the telescope, nm rms of wavefront")] = 0.0,
    jitter: Annotated[float, typer.Option(min=0.0, help="Pointing jitter, arcsec rms an axis")] = 0.0,
    colour: Annotated[float, typer.Option(help="How much bluer the sky is than the star of the PSF")] = 0.0,
    residual: Annotated[float, typer.Option(help="Smooth random error of the PSF, part of its light")] = 0.0,
    out: Out = Path(),
    all_runs: Annotated[bool, typer.Option("--all", help="The paper's 48 instead, as a montage")] = False,
) -> None:
    """Simulate one realization. A FITS file, and a picture of its steps as in the paper's Fig. 1."""
    common = {"seed": seed, "noise_level": noise_level, "mass_model": mass_model}
    if all_runs:
        own = (n, host, host_image, r_eff, magnitude, l_eta, deflector)
        if any(value is not None for value in own) or any((defocus_nm, jitter, colour, residual)):
            raise typer.BadParameter("--all has the hosts, slopes and optics of the paper: leave out --n, --r-eff, ...")
        montage(system, **common, camera=camera, out=out)  # type: ignore[arg-type]
        return
    optics = {"defocus_nm": defocus_nm, "jitter": jitter, "colour": colour, "residual": residual}
    _require_files(system, camera)
    shapes, deflectors = hosts_asked(host, host_image), deflectors_asked(deflector)
    if len(shapes) + (n is not None) > 1 or len(deflectors) > 1:
        raise typer.BadParameter("one realization has one host and one deflector: of --n, --host and --host-image one")
    shape = shapes[0] if shapes else {"n": _N if n is None else n}
    with refusals():
        realization = _realization(
            system,
            HostOptions(shape, r_eff, magnitude, _L_ETA if l_eta is None else l_eta),
            camera,
            common
            | {"optics": optics if any(optics.values()) else None, "deflector": deflectors[0] if deflectors else None},
        )
        _write_one(realization, out)


def montage(
    system: Annotated[str, typer.Argument(help="A system of the catalogue")],
    seed: SeedOption = 0,
    noise_level: NoiseOption = "author",
    mass_model: MassOption = "recommended",
    camera: CameraOption = None,
    out: Out = Path(),
) -> None:
    """Picture the 48 realizations of a system. They are numbered as in the paper's Table 3."""
    _require_files(camera)
    with refusals():
        from engine import Grid, expand  # noqa: PLC0415

        document = {"seed": seed, "noise_level": noise_level, "mass_model": mass_model}
        runs = expand(_validated(Grid, preset=f"h0licow-vi/{system}", camera=_camera(camera), **document))
        require_folder(out)
        from engine import simulate_realization  # noqa: PLC0415 - after all that may be refused
        from engine.figures import montage_figure  # noqa: PLC0415

        observations = []
        with progress_bar(f"simulating {system}", len(runs)) as advance:
            for run in runs:
                observations.append(simulate_realization(run.realization).observation)
                advance()
        _save(montage_figure(runs, observations), out / f"{system}_montage.png")


def gallery(
    paper_run: Annotated[int, typer.Option("--run", min=1, max=48, help="Of the paper's Table 3")] = _GALLERY_RUN,
    seed: SeedOption = 0,
    noise_level: NoiseOption = "author",
    out: Out = Path(),
) -> None:
    """Picture the eight systems side by side. Each also with its lensed host alone."""
    with refusals():
        from engine import Grid, expand  # noqa: PLC0415

        grid = _validated(Grid, preset="h0licow-vi", seed=seed, noise_level=noise_level)
        runs = [run for run in expand(grid) if run.paper_run == paper_run]
        require_folder(out)
        from engine import simulate_realization  # noqa: PLC0415 - as above
        from engine.figures import gallery_figure  # noqa: PLC0415

        simulations: list[Simulation] = []
        with progress_bar("simulating the eight systems", len(runs)) as advance:
            for run in runs:
                simulations.append(simulate_realization(run.realization))
                advance()
        _save(gallery_figure(simulations), out / "gallery.png")


def inversion(
    system: Annotated[str, typer.Argument(help="A system of the catalogue, as HE0435, or a TOML or JSON file")],
    n: Annotated[float, typer.Option(help="Sersic index of the host")] = _N,
    r_eff: Annotated[float | None, typer.Option(help="arcsec; the paper's smaller one where not given")] = None,
    magnitude: Annotated[float | None, typer.Option(help="AB; the paper's second brightest where not given")] = None,
    l_eta: Annotated[float, typer.Option(help="Slope of the lens, gamma' - 1")] = _L_ETA,
    profile: Annotated[str, typer.Option(help="draft, standard, reference or paper")] = "standard",
    source_pixels: Annotated[int | None, typer.Option(help="Source pixels along a side; the profile's without")] = None,
    seed: SeedOption = 0,
    noise_level: NoiseOption = "author",
    mass_model: MassOption = "recommended",
    camera: CameraOption = None,
    out: Annotated[Path | None, typer.Option(help="The picture; SYSTEM_inversion.png without")] = None,
) -> None:
    """Picture one inversion. Data, model, residual, source and its resolution, ln Z along each lens parameter."""
    grid = {} if source_pixels is None else {"source_pixels": (source_pixels, source_pixels)}
    common = {
        "seed": seed, "noise_level": noise_level, "mass_model": mass_model, "analysis": {"profile": profile, **grid},
    }  # fmt: skip
    _require_files(system, camera)
    if out is not None:
        require_kind(out, PICTURES)
    with refusals():
        realization = _realization(system, HostOptions({"n": n}, r_eff, magnitude, l_eta), camera, common)
        path = out or Path(f"{as_file_name(realization.system_name)}_inversion.png")
        require_folder(path.parent)
        require_file(path, PICTURES)
        from engine import inspect_simulation, simulate_realization  # noqa: PLC0415 - as above
        from engine.figures import inversion_figure  # noqa: PLC0415

        with progress_bar(f"inverting {realization.system_name}", 3) as advance:
            simulation = simulate_realization(realization)
            advance()
            view = inspect_simulation(simulation, realization.analysis)
            advance()
            figure = inversion_figure(view)
            advance()
        _save(figure, path)


COMMANDS = (simulate, montage, gallery, inversion)


def _realization(system: str, host: HostOptions, camera: str | None, common: dict[str, Any]) -> Realization:
    from engine import load_camera, load_system, realization_from_dict  # noqa: PLC0415

    chosen: str | LensSystem = system
    values = {"r_eff": host.r_eff, "magnitude": host.magnitude}
    if system.lower().endswith(_FILES):
        from engine import read_system  # noqa: PLC0415

        chosen = read_system(system)
        missing = [name for name, value in values.items() if value is None]
        if missing:
            options = " and ".join(f"--{name.replace('_', '-')}" for name in missing)
            raise typer.BadParameter(f"a system of your own has no default host: give {options}")
    else:
        values = _paper_values(system) | {name: value for name, value in values.items() if value is not None}
    found = realization_from_dict(
        {"system": chosen, "l_eta": host.l_eta, "host": {**host.shape, **values}, "camera": _camera(camera), **common}
    )
    # Names that the catalogue does not have would be told by the simulation too, when all of it is loaded.
    lens = load_system(found.system) if isinstance(found.system, str) else found.system
    lens.mass_model(found.mass_model, found.l_eta)
    if isinstance(found.camera, str):
        load_camera(found.camera)
    return found


def _paper_values(system: str) -> dict[str, float | None]:
    """The smaller r_eff and the second brightest magnitude of the system in the paper's Table 2."""
    from engine import Grid, expand, load_system  # noqa: PLC0415

    load_system(system)  # refuses an unknown one by this name, not as a preset
    hosts = [run.realization.host for run in expand(Grid(preset=f"h0licow-vi/{system}"))]
    return {"r_eff": min(host.r_eff for host in hosts), "magnitude": sorted({host.magnitude for host in hosts})[1]}


def _require_files(*choices: str | None) -> None:
    """Systems and cameras that are files: there, and readable."""
    require_readable(Path(choice) for choice in choices if choice is not None and choice.lower().endswith(_FILES))


def _camera(choice: str | None) -> str | Camera | None:
    if choice is None or not choice.lower().endswith(_FILES):
        return choice
    from engine import read_camera  # noqa: PLC0415

    return read_camera(choice)


def _validated(kind: Any, **fields: Any) -> Any:
    """An object of the engine; pydantic's complaint becomes a SpecError that names the field."""
    from pydantic import ValidationError  # noqa: PLC0415

    from engine import spec_error  # noqa: PLC0415

    try:
        return kind(**fields)
    except ValidationError as error:
        raise spec_error(error) from error


def _write_one(realization: Realization, out: Path) -> None:
    host = realization.host
    # The digest in the name: another seed or camera is another file, and the same command writes the same one again.
    shape = as_file_name(host.label) if host.n is None else f"n{host.n:g}"
    stem = (
        f"{as_file_name(realization.system_name)}_{shape}_r{host.r_eff:g}_m{host.magnitude:g}_l{realization.l_eta:g}"
        f"_{realization.digest[:8]}"
    )
    require_folder(out)
    from engine import simulate_realization, write_observation  # noqa: PLC0415 - as above
    from engine.figures import simulation_figure  # noqa: PLC0415

    with progress_bar(f"simulating {realization.system_name}", 3) as advance:
        simulation = simulate_realization(realization)
        advance()
        write_observation(out / f"{stem}.fits", simulation.observation, overwrite=True)
        advance()
        figure = simulation_figure(simulation)
        advance()
    typer.echo(out / f"{stem}.fits")
    _save(figure, out / f"{stem}.png")
    record = simulation.observation.provenance
    if record["NOISE"] != record["NOISEREQ"]:
        typer.echo(f"the camera has no noise level {record['NOISEREQ']!r}: {record['NOISE']!r} was used", err=True)


def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path, dpi=_DPI)
    typer.echo(path)


@contextmanager
def progress_bar(what: str, steps: int) -> Iterator[Any]:
    """A bar on a terminal; what it yields advances it by one step."""
    from rich.console import Console  # noqa: PLC0415 - as the engine
    from rich.progress import (  # noqa: PLC0415 - as above
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns: Sequence[Any] = (
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn(),
    )  # fmt: skip
    console = Console(stderr=True)
    # Elsewhere than on a terminal a bar that has gone leaves an empty line.
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(what, total=steps)
        yield lambda: bar.advance(task)


@contextmanager
def refusals() -> Iterator[None]:
    """What the engine refuses ends the command with a line instead of a traceback."""
    from engine import EngineError  # noqa: PLC0415

    try:
        yield
    except (EngineError, OSError) as error:
        raise typer.BadParameter(str(error)) from error
