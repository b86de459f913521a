"""What may be asked for: the body of POST /v1/grids, and the runs that it means.

The one module of the API that knows the engine's specifications.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

from pydantic import BaseModel, ConfigDict, StringConstraints, create_model

import engine
from engine import (
    NOMINAL_OPTICS,
    PRINTABLE,
    USUAL_DEFLECTOR,
    Analysis,
    CameraChoice,
    Deflectors,
    Expansion,
    FirstSeed,
    Grid,
    GridRun,
    Hosts,
    Identifier,
    Indices,
    LensEquationError,
    LensSystem,
    Magnitudes,
    NoiseLevel,
    OpticsChoice,
    Radii,
    Realization,
    Replicates,
    Slopes,
    SpecError,
    Systems,
    camera_names,
    engine_digest,
    load_camera,
    load_system,
    preset_names,
    spec_digest,
    system_facts,
    system_names,
)
from service.domain.plan import OPTICS_AXES, Kind, PlannedRun
from service.domain.precision import Until
from service.domain.views import CameraItem, EngineView, SystemItem, SystemView

CONFIGURATIONS = {2: "double", 4: "quad"}
"""What a lens with so many AGN images is called; any other is ``other``."""
_CONFIG = ConfigDict(extra="forbid", allow_inf_nan=False)


def _optional_fields() -> dict[str, Any]:
    """The engine's Analysis with every field optional, so that a request names only what differs."""
    hints = get_type_hints(Analysis, include_extras=True)
    return {field.name: (hints[field.name] | None, None) for field in dataclasses.fields(Analysis)}


AnalysisRequest = create_model("AnalysisRequest", __config__=_CONFIG, **_optional_fields())
AnalysisRequest.__doc__ = "What to change of the default analysis."

if TYPE_CHECKING:
    AnalysisBody = BaseModel
else:
    AnalysisBody = AnalysisRequest


class GridRequest(BaseModel):
    """A grid of realizations: the engine's Grid, in its own types, with a name and a partial analysis.

    With ``preset`` (as ``h0licow-vi/HE0435``) the lists cut the paper's Table 2; without it ``systems`` and all four
    lists are needed, and every combination is run. A system is a name of the catalogue or an object of one's own, and
    so is ``camera``, which takes the place of the systems' own. ``hosts`` are galaxies beside, or in the place of, the
    Sersic profiles of the indices ``n``; ``deflectors`` what the lenses have beside their own light and mass, {} being
    nothing; ``optics``, one or several, spoil the PSF of the sky. ``replicates`` repeats each point with seeds seed,
    seed + 1, ...; with ``until`` instead each point is repeated until its mean bias is known to an error.
    """

    model_config = _CONFIG

    name: Annotated[str, StringConstraints(min_length=1, max_length=200, pattern=PRINTABLE)] | None = None
    preset: Identifier | None = None
    systems: Systems | None = None
    n: Indices | None = None
    hosts: Hosts | None = None
    r_eff: Radii | None = None
    magnitude: Magnitudes | None = None
    l_eta: Slopes | None = None
    deflectors: Deflectors | None = None
    noise_level: NoiseLevel = "author"
    mass_model: Identifier = "recommended"
    optics: OpticsChoice | None = None
    camera: CameraChoice | None = None
    seed: FirstSeed = 0
    replicates: Replicates = 1
    until: Until | None = None
    analysis: AnalysisBody | None = None

    @property
    def most_replicates(self) -> int:
        """Seeds that a point has at most."""
        return self.replicates if self.until is None else self.until.at_most

    def canonical(self) -> dict[str, Any]:
        """What was asked for, without what was left out: kept with the grid and compared under an idempotency key."""
        return self.model_dump(mode="json", exclude_none=True)


class TooManyRunsError(ValueError):
    """A grid has more runs than the service takes."""

    def __init__(self, runs: int, allowed: int) -> None:
        super().__init__(f"the grid has {runs} runs, allowed are {allowed}")


class Plan:
    """The runs that a request means: counted at once, made one by one as they are stored.

    In the engine's order; where replicates may turn out not to be needed, the first of each point come first.
    """

    def __init__(self, runs: Expansion, until: Until | None = None) -> None:
        self._runs = runs
        self._until = until

    def __len__(self) -> int:
        """How many runs there are."""
        return len(self._runs)

    def __iter__(self) -> Iterator[PlannedRun]:
        """Make the runs, anew each time."""
        return map(_planned, self._runs if self._until is None else self._runs.by_replicate())

    @property
    def least(self) -> int:
        """How many of them have to be done: all, or those that each point has before it is judged."""
        until = self._until
        return len(self) if until is None else len(self) // until.at_most * until.at_least

    def kinds(self) -> dict[Kind, int]:
        """How many runs there are of each kind."""
        counts: Counter[Kind] = Counter()
        for sample, runs in zip(self._runs.samples, self._runs.shares, strict=True):
            counts[_kind(sample.realization)] += runs
        return dict(counts)


def plan(request: GridRequest, max_runs: int) -> Plan:
    """What a request means; whatever is to be refused is refused here, before any run is made.

    Raises
    ------
    engine.errors.SpecError
        A value is not allowed.
    TooManyRunsError
        There would be more than ``max_runs``.
    """
    _require_fitting(request)
    # Before anything is looked at: a few lists can mean more systems and slopes than there is time for.
    lists = (request.systems, request.r_eff, request.magnitude, request.l_eta)
    if request.preset is None:
        shapes = len(request.n or ()) + len(request.hosts or ())
        spoilt = len(request.optics) if isinstance(request.optics, tuple) else 1
        each = shapes * spoilt * len(request.deflectors or (None,)) * request.most_replicates
        _limit(math.prod(len(values or ()) for values in lists) * each, max_runs)
    _check_own_systems(request)
    runs = Expansion(_grid(request))
    _limit(len(runs), max_runs)
    for run in runs.samples:
        _check(request, run.realization)
    return Plan(runs, request.until)


def _require_fitting(request: GridRequest) -> None:
    """Refuse a rule that cannot end replicates, or that something else in the request contradicts."""
    until = request.until
    if until is None:
        return
    if "replicates" in request.model_fields_set:
        raise SpecError("replicates", request.replicates, "nothing beside until, whose at_most says how many at most")
    if until.at_least > until.at_most:
        raise SpecError("until.at_least", until.at_least, f"at most at_most, which is {until.at_most}")
    given = None if request.analysis is None else getattr(request.analysis, "estimators")  # noqa: B009 - made by name
    computed = given or Analysis().estimators
    if until.estimator not in computed:
        raise SpecError("until.estimator", until.estimator, f"one that the analysis computes: {', '.join(computed)}")
    if (until.quantity, until.index_prior) == ("n", "fixed"):
        raise SpecError("until.index_prior", "fixed", "wide or free, since n has no bias where it is fixed")
    without = [host.label for host in request.hosts or () if host.n is None]
    if without and (until.quantity == "n" or until.index_prior == "fixed"):
        raise SpecError("hosts", without, "hosts with an index n, or their biases are never known as until asks")


def _check_own_systems(request: GridRequest) -> None:
    """Refuse here what every run would fail of: a system that has not the images its mass models make (a few ms each).

    Those of the catalogue are as they have to be.
    """
    for place, system in enumerate(request.systems or ()):
        if isinstance(system, LensSystem):
            try:
                engine.check_system(system)  # by its name in the engine: what computes loads with the first grid
            except SpecError as error:
                field = "exposures.dither" if error.field == "dither" else error.field
                raise SpecError(f"systems[{place}].{field}", error.value, error.allowed) from error
            except LensEquationError as error:
                models = f"systems[{place}].mass_models"
                raise SpecError(
                    models, sorted(system.mass_models), f"lenses whose images can be found: {error}"
                ) from error


def _check(request: GridRequest, realization: Realization) -> None:
    """Refuse a realization that no run could end well with, by the place in the request that makes it so."""
    try:
        engine.check_realization(realization)
    except SpecError as error:
        own = error.field.startswith("system.")
        place = (request.systems or ()).index(realization.system) if own else 0
        field = f"systems[{place}].{error.field.removeprefix('system.')}" if own else error.field
        if field == "deflector" and realization.deflector is not None:
            field = f"deflectors[{(request.deflectors or ()).index(realization.deflector)}]"
        raise SpecError(field, error.value, error.allowed) from error


def _limit(runs: int, allowed: int) -> None:
    if runs > allowed:
        raise TooManyRunsError(runs, allowed)


def _grid(request: GridRequest) -> Grid:
    cuts: dict[str, Any] = {
        name: None if getattr(request, name) is None else tuple(getattr(request, name))
        for name in ("systems", "n", "hosts", "r_eff", "magnitude", "l_eta", "deflectors")
    }
    changes = {} if request.analysis is None else request.analysis.model_dump(exclude_none=True)
    return Grid(
        preset=request.preset,
        mass_model=request.mass_model,
        noise_level=request.noise_level,
        optics=request.optics,
        camera=request.camera,
        seed=request.seed,
        replicates=request.most_replicates,
        analysis=Analysis(**changes),
        **cuts,
    )


def _planned(run: GridRun) -> PlannedRun:
    realization = run.realization
    kind = _kind(realization)
    inputs = {
        "system": realization.system_name,
        "camera": kind.camera,
        "configuration": kind.configuration,
        "mass_model": realization.mass_model,
        "noise_level": realization.noise_level,
        "noise_treatment": realization.analysis.noise_treatment,
        "l_eta": realization.l_eta,
        "n": realization.host.n,
        "r_eff": realization.host.r_eff,
        "magnitude": realization.host.magnitude,
        "host_kind": realization.host.kind,
        "host_label": realization.host.label,
        "deflector": USUAL_DEFLECTOR if realization.deflector is None else realization.deflector.label,
        **{name: getattr(realization.optics or NOMINAL_OPTICS, name) for name in OPTICS_AXES},
        "seed": realization.seed,
    }
    spec = realization.to_dict()
    return PlannedRun(run.label, run.paper_run, spec, inputs, spec_digest(spec))


def _kind(realization: Realization) -> Kind:
    system = realization.system
    lens = load_system(system) if isinstance(system, str) else system
    camera = realization.camera or lens.camera
    return Kind(
        camera=camera if isinstance(camera, str) else camera.name,
        configuration=CONFIGURATIONS.get(len(lens.agn), "other"),
        profile=None if realization.analysis.max_error is not None else realization.analysis.profile,
    )


def list_systems() -> list[SystemItem]:
    """The catalogue's systems, in short."""
    return [SystemItem(**_system_fields(name)) for name in system_names()]


def system_view(name: str) -> SystemView:
    """One system unabridged; a SpecError where the catalogue has none of that name."""
    return SystemView(facts=system_facts(name), **_system_fields(name))


def _system_fields(name: str) -> dict[str, Any]:
    system = load_system(name)
    return {
        "name": name,
        "camera": system.camera_name,
        "mass_models": {model: sorted(map(float, slopes)) for model, slopes in system.mass_models.items()},
        "links": {},
    }


def list_cameras() -> list[CameraItem]:
    """The catalogue's cameras."""
    fields = ("name", "pixel_scale", "drizzled_scale", "zero_point")
    return [CameraItem(**{field: getattr(load_camera(name), field) for field in fields}) for name in camera_names()]


def engine_view(version: str) -> EngineView:
    """Which engine runs here."""
    return EngineView(digest=engine_digest(), version=version, presets=list(preset_names()))
