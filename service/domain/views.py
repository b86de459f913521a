"""What the API answers. Free of the engine, so that the client and the CLI start quickly."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from service.domain.payload import ChainPayload, EstimateName, StagePayload, WorkPayload
from service.domain.precision import Until
from service.domain.states import GridState, RunState

UwsPhase = Literal["PENDING", "QUEUED", "HELD", "EXECUTING", "COMPLETED", "ERROR", "ABORTED"]
UWS_PHASES: dict[str, UwsPhase] = {
    "queued": "QUEUED",
    "paused": "HELD",
    "leased": "EXECUTING",
    "running": "EXECUTING",
    "done": "COMPLETED",
    "failed": "ERROR",
    "quarantined": "ERROR",
    "cancelled": "ABORTED",
    "not_needed": "ABORTED",
}
"""States in the words of the IVOA's Universal Worker Service."""


Links = dict[str, str]
"""Addresses by what they lead to: none before the API, which alone knows them, has filled them in."""


class _Answer(BaseModel):
    model_config = ConfigDict(extra="forbid", use_attribute_docstrings=True)


class Place(_Answer):
    """One thing that is wrong with a request, and where."""

    source: Literal["body", "query", "path", "header"] = Field(serialization_alias="in", validation_alias="in")
    pointer: str
    """JSON pointer into the body, or the name of the parameter."""
    message: str


class Problem(_Answer):
    """RFC 9457: every error of the API."""

    type: str = "about:blank"
    title: str
    status: int
    detail: str | None = None
    instance: str | None = None
    artefact: str | None = None
    """Key of the artefact that cannot be given."""
    errors: list[Place] = Field(default_factory=list)


class RunCounts(_Answer):
    """Runs of a grid by state."""

    queued: int = 0
    paused: int = 0
    leased: int = 0
    done: int = 0
    failed: int = 0
    quarantined: int = 0
    cancelled: int = 0
    not_needed: int = 0
    """Replicates that nobody runs, since the mean bias of their point is known well enough without them."""

    @property
    def ended(self) -> int:
        """Runs that will not change by themselves."""
        return self.done + self.failed + self.quarantined + self.cancelled + self.not_needed


class UntilView(Until):
    """The rule that ends replicates of a grid, and how many of its points it has ended."""

    model_config = ConfigDict(extra="forbid", use_attribute_docstrings=True)

    points: int
    reached: int
    """Points whose mean bias is known to ``error``: of the others replicates go on, or all have ended."""


class GridView(_Answer):
    """A grid and how far it is."""

    id: str
    name: str | None
    state: GridState
    uws_phase: UwsPhase
    n_runs: int
    counts: RunCounts
    until: UntilView | None = None
    """Null where all replicates are wanted."""
    progress: float
    """Share of the runs that have ended."""
    rate_per_s: float | None
    """Runs that ended per second, over the latest hundred; None before the first."""
    eta_seconds: float | None
    """Time left by the rate; before the first run has ended, by stored runs of its kind on the workers of now, and null
    where there are none. With ``until``, of so many replicates as it should take by the scatter of those there are."""
    created_at: datetime
    finished_at: datetime | None
    cancelled_at: datetime | None
    paused_at: datetime | None
    engine_digest: str | None
    """Of the engine whose results the grid takes: the one that was installed where it was submitted."""
    owner: str | None
    """Name of the token that it was submitted with, who may cancel and retry it; null where none was asked for."""
    request: dict[str, Any]
    links: Links


class GridItem(_Answer):
    """A grid in short."""

    id: str
    name: str | None
    owner: str | None
    state: GridState
    n_runs: int
    progress: float
    eta_seconds: float | None
    created_at: datetime
    finished_at: datetime | None
    links: Links


class CompactGridPage(_Answer):
    """A page of grids in short, newest first."""

    items: list[GridItem]
    next: str | None


class RetriedGrid(GridView):
    """A grid some of whose runs have been queued again."""

    retried: int
    """How many; in a grid that is paused they wait with the others."""


GridKind = Literal["simulation", "measurement", "all"]
"""Which grids a list has: those that were submitted, those of one run that measure an uploaded image, both."""


class GridPage(_Answer):
    """A page of grids, newest first."""

    items: list[GridView]
    next: str | None
    """Address of the next page."""


class Interval(_Answer):
    """What is expected, and two standard deviations either way."""

    low: float
    expected: float
    high: float


class CostKind(_Answer):
    """What the time that a run takes depends on most."""

    camera: str
    configuration: str
    profile: str | None
    """Null where runs choose their settings (``max_error``)."""


class Cost(_Answer):
    """What runs should take, by stored runs of their kind (camera, configuration, profile)."""

    cpu_s: Interval | None
    """CPU of all runs together; null, as the next, where it is not known."""
    wall_s: Interval | None
    """On the workers that there are now, had they nothing else to do; null also where there are none."""
    workers: int
    stored_runs: int
    """Stored runs that it is taken from."""
    unknown: list[CostKind]
    """Kinds with fewer than five stored runs: where there is one, nothing is known of the whole."""


class DryRun(_Answer):
    """What a request would start, and what that would cost."""

    n_runs: int
    """With ``until``, at most; so is the cost."""
    least_runs: int
    """``n_runs``; with ``until``, those without which no point is judged."""
    labels: list[str]
    """Labels of the first hundred runs."""
    cost: Cost


class RunError(_Answer):
    """Why a run has no result."""

    code: str
    detail: str | None


class RunView(_Answer):
    """A run, in lists."""

    id: str
    grid_id: str
    ordinal: int
    label: str
    paper_run: int | None
    state: RunState
    uws_phase: UwsPhase
    inputs: dict[str, Any]
    attempt: int
    suspect: bool
    """It may have killed a worker, and is only run alone."""
    error: RunError | None
    finished_at: datetime | None
    links: Links


class RunItem(_Answer):
    """A run in short."""

    id: str
    ordinal: int
    label: str
    state: RunState
    error_code: str | None
    finished_at: datetime | None
    links: Links


class CompactRunPage(_Answer):
    """A page of a grid's runs in short."""

    items: list[RunItem]
    next: str | None


class RunPage(_Answer):
    """A page of a grid's runs in the grid's order."""

    items: list[RunView]
    next: str | None


class Recovered(_Answer):
    """A recovered quantity of one run; ``bias`` is recovered minus input."""

    mean: float
    sd: float
    bias: float | None


class NumericalErrorView(_Answer):
    """Predicted distance of a quantity from what a converged computation on the same data would say."""

    total: float
    """Root of the sum of the squares of what follows."""
    rendering: float
    """Of the host's light, and what the search for a minimum leaves."""
    psf: float
    """As it is cut or moved."""
    grid: float
    """Of the source."""
    sampling: float
    """Of the posterior by a chain of finite length."""
    draws: float
    """Of the posterior that were fitted."""


class ErrorBudgetView(_Answer):
    """Numerical errors of magnitude [mag], r_eff [arcsec] and n."""

    magnitude: NumericalErrorView
    r_eff: NumericalErrorView
    n: NumericalErrorView


class EstimateView(_Answer):
    """What one estimator recovered in one run."""

    magnitude: Recovered
    r_eff: Recovered
    """Half-light radius on the intermediate axis [arcsec]."""
    r_eff_galfit: Recovered | None
    """The same on the major axis, GALFIT's convention; null in results that are older than this field."""
    n: Recovered
    q: Recovered
    position_angle: Recovered
    x: Recovered | None
    """Centre in the source plane [arcsec]; null in older results."""
    y: Recovered | None
    draws: int
    at_bound: int
    """Draws whose fit ended at a bound of n or of r_eff."""
    n_at_bound: int | None
    r_eff_at_bound: int | None
    failed: int
    budget: ErrorBudgetView | None
    """Beside the statistical error; null in older results, and where it could not be predicted."""


class ApertureView(_Answer):
    """Magnitude of the reconstructed source within ``radius`` arcsec; ``coverage`` of the circle is on its grid."""

    radius: float
    magnitude: Recovered
    coverage: float
    draws: int
    failed: int


class LensValue(_Answer):
    """Posterior of one lens parameter."""

    mean: float
    sd: float
    truth: float | None


class ResultView(_Answer):
    """Everything that was stored of a run."""

    estimates: dict[EstimateName, EstimateView | None]
    """Null where an estimator could fit no draw, and where the result is older than the estimator."""
    aperture: ApertureView | None
    regularisation: str | None
    profile: str | None
    lens: dict[str, LensValue]
    chain: ChainPayload | None
    """Null, as are the next four, where the run needed no chain."""
    ln_evidence: float | None
    chi2: float | None
    degrees_of_freedom: int | None
    condition_number: float | None
    arc_magnitude: float
    agn_contrast: float | None
    surface_brightness: float
    wall_s: float
    cpu_s: float
    stages: list[StagePayload]
    work: WorkPayload | None
    """Null in results that are older than this field."""
    warnings: list[str]
    versions: dict[str, str]
    payload_digest: str
    engine_digest: str
    stored_at: datetime
    figure: str | None
    """Key of the figure in the artefact store."""
    products: str | None


class EventView(_Answer):
    """Something that happened to a grid; ``detail`` depends on the kind."""

    id: int
    """Grows from event to event."""
    grid_id: str
    run_id: str | None
    kind: str
    detail: dict[str, Any]
    created_at: datetime


class EventPage(_Answer):
    """Events of a grid, oldest first."""

    items: list[EventView]
    cursor: int
    """Number of the last event up to here: with it as ``cursor`` the next answer goes on from here."""
    ended: bool
    """The grid has ended: nothing more comes, unless it is tried again."""
    next: str | None


class AttemptView(_Answer):
    """One execution of a run, after it ended."""

    number: int
    generation: int
    outcome: str
    code: str | None
    detail: str | None
    started_at: datetime
    ended_at: datetime


class RunDetail(RunView):
    """A run with its specification, its result and its attempts."""

    spec: dict[str, Any]
    digest: str
    result: ResultView | None
    attempts: list[AttemptView]


class MeasurementView(_Answer):
    """An uploaded image, and what was found in it; the id is that of a grid of one run."""

    id: str
    run_id: str
    name: str | None
    owner: str | None
    state: RunState
    uws_phase: UwsPhase
    error: RunError | None
    created_at: datetime
    finished_at: datetime | None
    uploads: dict[str, str]
    """Keys of the files in the artefact store."""
    options: dict[str, Any]
    measurement: dict[str, Any] | None
    """The JSON that ``hostlens measure`` writes; null in lists, before the end, and once it was pruned."""
    links: Links


class MeasurementPage(_Answer):
    """A page of measurements, newest first."""

    items: list[MeasurementView]
    next: str | None


class RunRecord(_Answer):
    """A run that stands alone: computed again from ``spec`` with the same engine it finds the same ``found``."""

    format: Literal["hostlens record 1"]
    service: str
    run_id: str
    grid_id: str
    label: str
    paper_run: int | None
    spec: dict[str, Any]
    seed: int | None
    realization_digest: str
    engine_digest: str
    payload_digest: str
    """SHA-256 of what was found: two executions with one engine agree in it."""
    versions: dict[str, str]
    stored_at: datetime
    warnings: list[str]
    found: dict[str, float | int | str | None]
    """By the names of an export's columns, of all estimators."""


class SummaryValue(_Answer):
    """One quantity over the runs of one input.

    ``sd`` is the mean of the runs' own standard deviations, ``scatter`` the standard deviation of the recovered means
    between the runs (None for one run alone).
    """

    input: float | None
    mean: float
    sd: float
    scatter: float | None
    bias: float | None


class SummaryEstimate(_Answer):
    """One estimator over those runs of one input that have its answer."""

    magnitude: SummaryValue
    r_eff: SummaryValue
    n: SummaryValue
    runs: int
    at_bound: int
    failed: int


class PrecisionView(_Answer):
    """How well the mean bias of a point is known that a grid wants to know ``until`` an error."""

    reached: bool
    """Whether it was known well enough at some time; what was running then has been added since."""
    runs: int
    """Replicates with an answer of the rule's estimator."""
    standard_error: float | None
    """Of their mean bias; null of fewer than two."""
    upper_limit: float | None
    """Of that at 84.1 %, which is what is compared with ``until.error``; null of fewer than three."""


class SummaryRow(_Answer):
    """The runs that share an input (they differ in their seed)."""

    input: dict[str, Any]
    n_runs: int
    precision: PrecisionView | None
    """Null where the grid wants all replicates."""
    estimates: dict[EstimateName, SummaryEstimate | None]


class OverallValue(_Answer):
    """One quantity over all stored runs of a grid: mean bias, its scatter between runs, mean of the runs' sd."""

    bias: float | None
    bias_scatter: float | None
    sd: float


class OverallEstimate(_Answer):
    """One estimator over those stored runs of a grid that have its answer."""

    magnitude: OverallValue
    r_eff: OverallValue
    n: OverallValue
    runs: int


class Summary(_Answer):
    """Biases of a grid: a row for each input, and all together."""

    grid_id: str
    state: GridState
    n_runs: int
    n_stored: int
    rows: list[SummaryRow]
    overall: dict[EstimateName, OverallEstimate | None]
    next: str | None


class SystemItem(_Answer):
    """A lens system of the catalogue, in short."""

    name: str
    camera: str
    mass_models: dict[str, list[float]]
    """l_eta of each mass model by its name."""
    links: Links


class SystemList(_Answer):
    """The catalogue's systems."""

    items: list[SystemItem]


class SystemView(SystemItem):
    """A lens system with everything that the catalogue holds of it."""

    facts: dict[str, Any]


class CameraItem(_Answer):
    """A camera of the catalogue."""

    name: str
    pixel_scale: float
    drizzled_scale: float
    zero_point: float


class CameraList(_Answer):
    """The catalogue's cameras."""

    items: list[CameraItem]


class EngineView(_Answer):
    """Which engine this process would run."""

    digest: str
    version: str
    presets: list[str]


class Health(_Answer):
    """The process answers."""

    status: Literal["ok"] = "ok"


class Readiness(_Answer):
    """Whether requests are carried out: ``degraded`` accepts grids but nothing computes them now."""

    status: Literal["ready", "degraded"]
    database: Literal["ok"] = "ok"
    dispatcher: Literal["ok", "missing"]
    artefacts: Literal["ok", "away"] = "ok"
    """``away``: the store takes nothing, and the dispatcher claims nothing until it does."""
    workers: int
    """Worker threads that runs are given to."""
    engines: dict[str, int]
    """Worker threads of each engine by its digest: a grid waits where its own is not among them."""
    beat_at: datetime | None
