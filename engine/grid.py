"""Grids of realizations: the paper's Table 2 with the numbering of Table 3, cut as wanted, or a grid of one's own."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import product
from math import prod
from typing import Annotated, Any

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from engine.catalogue import (
    camera_names,
    dither_names,
    load_camera,
    load_dither,
    load_system,
    read_catalogue,
    system_names,
)
from engine.errors import SpecError
from engine.spec.analysis import Analysis
from engine.spec.deflector import Deflector
from engine.spec.host import Host, HostShape
from engine.spec.instrument import NOMINAL_OPTICS, Camera, CameraChoice, Dither, NoiseLevel, Optics, OpticsChoice
from engine.spec.quantities import Count, Identifier, Magnitude, Radius, SersicIndex, Slope
from engine.spec.realization import Realization
from engine.spec.sky import LensSystem, SystemChoice

PAPER = "h0licow-vi"
_STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)
_SOME = Field(max_length=1000)

Systems = Annotated[tuple[SystemChoice, ...], _SOME]
Indices = Annotated[tuple[SersicIndex, ...], _SOME]
Hosts = Annotated[tuple[HostShape, ...], Field(max_length=200)]
Deflectors = Annotated[tuple[Deflector, ...], Field(max_length=20)]
Radii = Annotated[tuple[Radius, ...], _SOME]
Magnitudes = Annotated[tuple[Magnitude, ...], _SOME]
Slopes = Annotated[tuple[Slope, ...], _SOME]
# Below the greatest seed of a realization by more than the replicates, which count on from here.
FirstSeed = Annotated[Count, Field(ge=0, le=2**62)]
Replicates = Annotated[Count, Field(ge=1, le=100_000)]


@dataclass(frozen=True, config=_STRICT)
class Grid:
    """A request for realizations.

    With ``preset`` (``h0licow-vi`` for all eight systems, ``h0licow-vi/HE0435`` for one) the values are those of the
    paper's Table 2, and n, r_eff, magnitude, l_eta cut them: each must then be a subset of the preset's values.
    Without it, ``systems`` (names of the catalogue, or lens systems of one's own) and all four lists of values must be
    given and every combination is run. ``hosts`` are galaxies beside, or in the place of, Sersic profiles of the
    indices ``n``; ``deflectors`` what the lenses have beside their own light and mass, {} being nothing. ``camera``
    takes the place of the systems' own. ``optics``, one or several, spoil the PSF of the sky: each point is run with
    each, {} being nothing. ``replicates`` repeats each point with seeds seed, seed + 1, ...
    """

    preset: Identifier | None = None
    systems: Systems | None = None
    n: Indices | None = None
    hosts: Hosts | None = None
    r_eff: Radii | None = None
    magnitude: Magnitudes | None = None
    l_eta: Slopes | None = None
    deflectors: Deflectors | None = None
    mass_model: Identifier = "recommended"
    noise_level: NoiseLevel = "author"
    optics: OpticsChoice | None = None
    seed: FirstSeed = 0
    replicates: Replicates = 1
    analysis: Analysis = Field(default_factory=Analysis)
    camera: CameraChoice | None = None


@dataclass(frozen=True, config=_STRICT)
class GridRun:
    """One run of a grid: its label within the grid, the paper's run number (1-48) where it has one, and the spec."""

    label: str
    paper_run: int | None
    realization: Realization


def preset_names() -> tuple[str, ...]:
    """Names of the presets: the paper's whole study, and each of its systems."""
    return (PAPER, *(f"{PAPER}/{name}" for name in read_catalogue("h0licow_vi")["systems"]))


def expand(grid: Grid) -> tuple[GridRun, ...]:
    """All runs of a grid in a fixed order; a SpecError says which value is not allowed and what is."""
    return tuple(Expansion(grid))


class Expansion:
    """The runs of a grid in a fixed order: checked and counted at once, made one by one as they are asked for.

    ``samples`` has one run of each system at each slope with each deflector, ``shares`` how many of the runs each
    stands for. What these and the values of the lists are refused for is all that a run can be refused for, so neither
    time nor memory grows with the number of runs. A SpecError says which value is not allowed and what is.
    """

    def __init__(self, grid: Grid) -> None:
        _require_own_names(grid)
        self._grid, self._optics = grid, _each_optics(grid)
        self._paper = None if grid.preset is None else _paper_points(grid)
        samples = list(_samples(grid)) if self._paper is None else self._paper
        by_setting = {point.setting: point for point in samples}
        counts = Counter(point.setting for point in samples)
        _require_known_parts(grid, list(by_setting.values()))
        self.samples = tuple(self._run(point, 0, self._optics[0]) for point in by_setting.values())
        each = len(self) // len(samples)
        self.shares = tuple(counts[setting] * each for setting in by_setting)

    def __len__(self) -> int:
        """How many runs there are."""
        points = prod(map(len, _axes(self._grid))) if self._paper is None else len(self._paper)
        return points * len(self._optics) * self._grid.replicates

    def __iter__(self) -> Iterator[GridRun]:
        """Make the runs, anew each time."""
        for point in _free_points(self._grid) if self._paper is None else self._paper:
            for optics, replicate in product(self._optics, range(self._grid.replicates)):
                yield self._run(point, replicate, optics)

    def by_replicate(self) -> Iterator[GridRun]:
        """The same runs in another order: the first replicate of each point, then the second of each, and so on."""
        for replicate in range(self._grid.replicates):
            for point in _free_points(self._grid) if self._paper is None else self._paper:
                for optics in self._optics:
                    yield self._run(point, replicate, optics)

    def _run(self, point: _Point, replicate: int, optics: Optics | None) -> GridRun:
        grid, host = self._grid, point.host
        realization = Realization(
            system=point.system,
            l_eta=point.l_eta,
            host=host,
            deflector=point.deflector,
            seed=grid.seed + replicate,
            noise_level=grid.noise_level,
            optics=optics,
            mass_model=grid.mass_model,
            camera=grid.camera,
            analysis=grid.analysis,
        )
        name = point.name if point.number is None else f"{point.number:02d}"
        suffix = f"_{(optics or NOMINAL_OPTICS).label}" if len(self._optics) > 1 else ""
        suffix += f"#{replicate + 1}" if grid.replicates > 1 else ""
        return GridRun(f"{realization.system_name}/{name}{suffix}", point.number, realization)


@dataclass(frozen=True)
class _Point:
    """What runs of one point have in common."""

    system: str | LensSystem
    number: int | None
    host: Host
    l_eta: float
    deflector: Deflector | None = None

    @property
    def setting(self) -> tuple[str, float, str]:
        """What a run can be refused for as a whole."""
        return _name(self.system), self.l_eta, "" if self.deflector is None else self.deflector.label

    @property
    def name(self) -> str:
        """What a run is called within its system."""
        host = self.host
        shape = host.label if host.n is None or host.name is not None else f"n{host.n:g}"
        more = "" if self.deflector is None else f"_{self.deflector.label}"
        return f"{shape}_r{host.r_eff:g}_m{host.magnitude:g}_l{self.l_eta:g}{more}"


def _require_own_names(grid: Grid) -> None:
    """What is one's own has a name of its own: results are told apart by the names of system and camera."""
    _require_own_camera(grid.camera, "camera")
    for place, system in enumerate(grid.systems or ()):
        if not isinstance(system, LensSystem):
            continue
        where = f"systems[{place}]"
        if system.name in system_names():
            raise SpecError(f"{where}.name", system.name, "a name that the catalogue does not have")
        _require_own_camera(system.camera, f"{where}.camera")
        dither = system.exposures.dither
        if isinstance(dither, Dither) and dither.name in dither_names():
            raise SpecError(f"{where}.exposures.dither.name", dither.name, "a name that the catalogue does not have")


def _each_optics(grid: Grid) -> tuple[Optics | None, ...]:
    """What the points are run with; in a list, optics that spoil nothing are the same as none."""
    if not isinstance(grid.optics, tuple):
        return (grid.optics,)
    if len(set(grid.optics)) != len(grid.optics):
        raise SpecError("optics", [one.label for one in grid.optics], "a list without repeated values")
    return tuple(None if one == NOMINAL_OPTICS else one for one in grid.optics)


def _require_own_camera(camera: str | Camera | None, where: str) -> None:
    if isinstance(camera, Camera) and camera.name in camera_names():
        raise SpecError(f"{where}.name", camera.name, "a name that the catalogue does not have")


def _require_known_parts(grid: Grid, points: Sequence[_Point]) -> None:
    """Every camera, dither pattern and mass model that the points name must be there."""
    if isinstance(grid.camera, str):
        load_camera(grid.camera)
    for point in points:
        system = load_system(point.system) if isinstance(point.system, str) else point.system
        system.mass_model(grid.mass_model, point.l_eta)
        if isinstance(system.camera, str):
            load_camera(system.camera)
        if isinstance(system.exposures.dither, str):
            load_dither(system.exposures.dither)


def _paper_points(grid: Grid) -> list[_Point]:
    table = read_catalogue("h0licow_vi")
    if grid.preset not in preset_names():
        raise SpecError("preset", grid.preset, f"one of {list(preset_names())}")
    for field in ("hosts", "deflectors"):
        if getattr(grid, field) is not None:
            raise SpecError(field, [one.label for one in getattr(grid, field)], "nothing where there is a preset")
    _, _, only = grid.preset.partition("/")
    names = [only] if only else list(table["systems"])
    if grid.systems is not None:
        wanted = [_name(system) for system in grid.systems]
        if not all(isinstance(system, str) for system in grid.systems):
            raise SpecError("systems", wanted, "names of the catalogue where there is a preset")
        _require_subset("systems", wanted, names)
        names = [name for name in names if name in wanted]
    serials = {entry["serial"]: entry for entry in table["serials"]}
    known = {
        "n": {float(entry["n"]) for entry in serials.values()},
        "l_eta": {float(entry["l_eta"]) for entry in serials.values()},
        "r_eff": {float(r) for name in names for r in table["systems"][name]["r_eff"].values()},
        "magnitude": {float(m) for name in names for m in table["systems"][name]["magnitude"]},
    }
    for field, values in known.items():
        _require_subset(field, getattr(grid, field), sorted(values))
    points: list[_Point] = []
    for name in names:
        values = table["systems"][name]
        for number, serial, rank in table["runs"]:
            entry = serials[serial]
            n, l_eta = float(entry["n"]), float(entry["l_eta"])
            r_eff, magnitude = float(values["r_eff"][entry["r_eff"]]), float(values["magnitude"][rank - 1])
            cuts = ((n, grid.n), (l_eta, grid.l_eta), (r_eff, grid.r_eff), (magnitude, grid.magnitude))
            if all(wanted is None or value in wanted for value, wanted in cuts):
                points.append(_Point(name, number, Host(n=n, r_eff=r_eff, magnitude=magnitude), l_eta))
    if not points:
        raise SpecError("grid", "no run left", "cuts that leave at least one of the preset's runs")
    return points


def _samples(grid: Grid) -> Iterator[_Point]:
    """Of a free grid, the first point of each system at each slope with each deflector."""
    needed = ("systems", "r_eff", "magnitude", "l_eta", *(("n",) if grid.hosts is None else ()))
    for field in (*needed, *(field for field in ("n", "hosts", "deflectors") if getattr(grid, field) is not None)):
        values = getattr(grid, field)
        if not values:
            raise SpecError(field, values, "a non-empty list where no preset is given")
    for field in ("systems", "n", "hosts", "r_eff", "magnitude", "l_eta", "deflectors"):
        entries = [_entry(value) for value in getattr(grid, field) or ()]
        if len(set(entries)) != len(entries):
            unnamed = ", or names of their own for those that differ" if field in ("hosts", "deflectors") else ""
            raise SpecError(field, entries, f"a list without repeated values{unnamed}")
    usual = [f"n{index:g}" for index in grid.n or ()]
    taken = [shape.label for shape in grid.hosts or () if shape.label in usual]
    if taken:
        raise SpecError("hosts", taken, "names that no index of n has")
    brief = dataclasses.replace(grid, r_eff=(grid.r_eff or ())[:1], magnitude=(grid.magnitude or ())[:1])
    if grid.n:
        return _free_points(dataclasses.replace(brief, n=grid.n[:1], hosts=None))
    return _free_points(dataclasses.replace(brief, hosts=(grid.hosts or ())[:1]))


def _axes(grid: Grid) -> tuple[Sequence[Any], ...]:
    """The lists of a free grid, every combination of which is run."""
    shapes = (*(HostShape(n=index) for index in grid.n or ()), *(grid.hosts or ()))
    return (
        grid.systems or (), grid.l_eta or (), grid.r_eff or (), shapes, grid.magnitude or (), grid.deflectors or (None,)
    )  # fmt: skip


def _free_points(grid: Grid) -> Iterator[_Point]:
    for system, slope, radius, shape, brightness, deflector in product(*_axes(grid)):
        # One that has nothing is none: the same realization as without.
        more = None if deflector is None or deflector.is_plain else deflector
        yield _Point(system, None, Host.of(shape, radius, brightness), slope, more)


def _entry(value: object) -> object:
    """What entries of a list are told apart by."""
    return (
        value.label
        if isinstance(value, HostShape | Deflector)
        else value.name
        if isinstance(value, LensSystem)
        else value
    )


def _name(system: str | LensSystem) -> str:
    return system if isinstance(system, str) else system.name


def _require_subset(field: str, values: Sequence[object] | None, allowed: Sequence[object]) -> None:
    if values is None:
        return
    if not values:
        raise SpecError(field, values, f"a non-empty subset of {list(allowed)}")
    for value in values:
        if value not in allowed:
            raise SpecError(field, value, f"one of {list(allowed)} in this preset")
