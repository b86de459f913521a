"""What a worker sends back for one run: finite numbers and the addresses of its artefacts, nothing else.

The payload is the contract between worker and dispatcher. It is validated where it is made *and* where it is stored,
because a remote worker can be of another version.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

if TYPE_CHECKING:
    from engine import Aperture, Estimate, Quantity, RunResult

Finite = Annotated[float, Field(allow_inf_nan=False)]
# Sums are kept of these and of their squares: one that overflowed would keep out every later result of its input.
Moderate = Annotated[float, Field(ge=-1e100, le=1e100, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
_PLAIN = r"^[^\x00]*$"  # PostgreSQL keeps no NUL
Text = Annotated[str, Field(max_length=2000, pattern=_PLAIN)]
Word = Annotated[str, Field(max_length=64, pattern=_PLAIN)]
EstimateName = Literal[
    "paper_wide", "paper_free", "paper_fixed",
    "covariance_wide", "covariance_free", "covariance_fixed",
    "projected_wide", "projected_free", "projected_fixed",
    "image_wide", "image_free", "image_fixed",
]  # fmt: skip
ESTIMATES: tuple[EstimateName, ...] = get_args(EstimateName)
"""Estimator and prior of n: wide 0.3-8, free 1-4, fixed to the truth."""
RECOMMENDED: EstimateName = "image_wide"
"""The estimate to quote where nobody asks for another."""
QUANTITIES = ("magnitude", "r_eff", "r_eff_galfit", "n", "q", "position_angle", "x", "y")
COUNTS = ("draws", "at_bound", "n_at_bound", "r_eff_at_bound", "failed")
BUDGETED = ("magnitude", "r_eff", "n")
ERROR_STAGES = ("rendering", "psf", "grid", "sampling", "draws")
"""Quantities whose numerical error is predicted, and the stages that it is told by."""
ERROR_PARTS = tuple(
    (quantity, f"{quantity}_error", tuple((stage, f"{quantity}_error_{stage}") for stage in ERROR_STAGES))
    for quantity in BUDGETED
)
"""Of each quantity the column of the whole error, and those of its stages."""
ERRORS = tuple(name for _, whole, stages in ERROR_PARTS for name in (whole, *(column for _, column in stages)))
_OF_CHAIN = ("ln_evidence", "chi2", "degrees_of_freedom", "condition_number")
"""What a result has if it has a chain."""
WORK = ("pixels_rendered", "rays_traced", "columns_solved", "parameters_sampled")
"""What is counted of a run beside the evaluations of its chain."""
LENS_PARAMETERS = ("theta_E", "q", "phi", "slope", "x", "y", "gamma1", "gamma2", "ln_lambda")


def estimator_and_prior(name: str) -> tuple[str, str]:
    """The two parts of an estimate's name."""
    estimator, _, prior = name.rpartition("_")
    return estimator, prior


class InvalidResultError(ValueError):
    """A run ended with a result that must not be stored: a number is not finite, or a part is missing."""


_PayloadT = TypeVar("_PayloadT", bound=BaseModel)


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class QuantityPayload(_Strict):
    """Mean and standard deviation of a recovered quantity, and the truth where there is one."""

    mean: Moderate
    sd: Annotated[Moderate, Field(ge=0.0)]
    truth: Finite | None = None

    @property
    def bias(self) -> float | None:
        """Recovered minus true, None without a truth."""
        return None if self.truth is None else self.mean - self.truth


class NumericalErrorPayload(_Strict):
    """Predicted distance of a quantity from a converged computation on the same data, by stage."""

    rendering: NonNegative
    psf: NonNegative
    grid: NonNegative
    sampling: NonNegative
    draws: NonNegative

    @property
    def total(self) -> float:
        """Root of the sum of their squares."""
        return math.hypot(self.rendering, self.psf, self.grid, self.sampling, self.draws)


class ErrorBudgetPayload(_Strict):
    """Numerical errors of magnitude, r_eff [arcsec] and n."""

    magnitude: NumericalErrorPayload
    r_eff: NumericalErrorPayload
    n: NumericalErrorPayload


class EstimatePayload(_Strict):
    """What one estimator recovered: magnitude [AB], r_eff and GALFIT's [arcsec], n, q, position angle [deg], centre."""

    magnitude: QuantityPayload
    r_eff: QuantityPayload
    r_eff_galfit: QuantityPayload
    n: QuantityPayload
    q: QuantityPayload
    position_angle: QuantityPayload
    x: QuantityPayload
    y: QuantityPayload
    draws: Annotated[int, Field(ge=1)]
    at_bound: Annotated[int, Field(ge=0)]
    n_at_bound: Annotated[int, Field(ge=0)]
    r_eff_at_bound: Annotated[int, Field(ge=0)]
    failed: Annotated[int, Field(ge=0)]
    budget: ErrorBudgetPayload | None = None


class AperturePayload(_Strict):
    """Magnitude of the source maps within ``radius`` [arcsec]; ``coverage`` of the circle is on the source grid."""

    radius: NonNegative
    magnitude: QuantityPayload
    coverage: Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)]
    draws: Annotated[int, Field(ge=1)]
    failed: Annotated[int, Field(ge=0)]


class ChainPayload(_Strict):
    """How well the posterior was sampled."""

    status: Literal["converged", "not_converged"]
    walkers: Annotated[int, Field(ge=1)]
    steps: Annotated[int, Field(ge=0)]
    burn_in: Annotated[int, Field(ge=0)]
    tau: NonNegative
    effective_samples: NonNegative
    acceptance: NonNegative
    evaluations: Annotated[int, Field(ge=0)]
    r_hat: NonNegative | None = None


class WorkPayload(_Strict):
    """What simulation and analysis computed, in numbers that no clock changes.

    Pixels onto which light or a derivative of it was laid, rays traced through the lens, unknowns of linear systems
    solved, dimensions of the chain, evaluations of the evidence.
    """

    pixels_rendered: Annotated[int, Field(ge=0, lt=2**63)]
    rays_traced: Annotated[int, Field(ge=0, lt=2**63)]
    columns_solved: Annotated[int, Field(ge=0, lt=2**63)]
    parameters_sampled: Annotated[int, Field(ge=0, lt=2**31)]
    evidence_evaluations: Annotated[int, Field(ge=0, lt=2**63)]


class StagePayload(_Strict):
    """Wall and CPU seconds of one stage."""

    stage: Word
    wall_s: NonNegative
    cpu_s: NonNegative


class ArtefactPayload(_Strict):
    """Where an artefact lies: its key in the store, which is made of the SHA-256 of its bytes, and that digest."""

    key: Annotated[str, Field(pattern=r"^[0-9a-f]{2}/[0-9a-f]{64}\.[a-z0-9]{1,8}$")]
    digest: Digest

    @model_validator(mode="after")
    def _named_by_digest(self) -> ArtefactPayload:
        if not self.key.startswith(f"{self.digest[:2]}/{self.digest}."):
            raise ValueError(f"the key {self.key} is not that of the digest")
        return self


class ResultPayload(_Strict):
    """Everything that is stored of one run.

    Every estimate is named; one that could fit no draw, or was not asked for, is null. A run that asked for nothing
    that needs a chain has none, and no evidence.
    """

    realization_digest: Digest
    engine_digest: Digest
    versions: Annotated[dict[Word, Text], Field(max_length=200)]
    noise_treatment: Annotated[str, Field(max_length=32, pattern=_PLAIN)]
    regularisation: Annotated[str, Field(max_length=32, pattern=_PLAIN)]
    profile: Annotated[str, Field(max_length=32, pattern=_PLAIN)] | None = None
    estimates: dict[EstimateName, EstimatePayload | None]
    aperture: AperturePayload | None
    lens: dict[str, QuantityPayload]
    chain: ChainPayload | None = None
    ln_evidence: Finite | None = None
    chi2: NonNegative | None = None
    degrees_of_freedom: int | None = None
    condition_number: NonNegative | None = None
    arc_magnitude: Finite
    agn_contrast: Finite | None
    surface_brightness: Finite
    stages: Annotated[tuple[StagePayload, ...], Field(max_length=1000)]
    work: WorkPayload | None = None
    warnings: Annotated[tuple[Text, ...], Field(max_length=1000)] = ()
    figure: ArtefactPayload | None = None
    products: ArtefactPayload | None = None

    @model_validator(mode="after")
    def _complete(self) -> ResultPayload:
        missing = [name for name in ESTIMATES if name not in self.estimates]
        if missing:
            raise ValueError(f"estimates are missing: {', '.join(missing)}")
        unknown = sorted(set(self.lens) - set(LENS_PARAMETERS))
        if unknown:
            raise ValueError(f"unknown lens parameters: {', '.join(unknown)}")
        lacking = [name for name in _OF_CHAIN if getattr(self, name) is None]
        if self.chain is not None and lacking:
            raise ValueError(f"a chain without {', '.join(lacking)}")
        evaluations = 0 if self.chain is None else self.chain.evaluations
        if self.work is not None and self.work.evidence_evaluations != evaluations:
            raise ValueError(f"{self.work.evidence_evaluations} evaluations counted, {evaluations} in the chain")
        return self

    @property
    def digest(self) -> str:
        """SHA-256 of what the run found.

        Times and pictures are left out: two executions of one run must agree in this and may differ in those.
        """
        document = self.model_dump(mode="json", exclude={"stages", "figure", "products", "versions"})
        return hashlib.sha256(json.dumps(document, sort_keys=True, separators=(",", ":")).encode()).hexdigest()

    @property
    def wall_s(self) -> float:
        """Wall seconds of all stages."""
        return sum(stage.wall_s for stage in self.stages)

    @property
    def cpu_s(self) -> float:
        """CPU seconds of all stages."""
        return sum(stage.cpu_s for stage in self.stages)


def result_payload(
    result: RunResult, figure: ArtefactPayload | None = None, products: ArtefactPayload | None = None
) -> ResultPayload:
    """The payload of an engine's result.

    Raises
    ------
    InvalidResultError
        A number is not finite or a part is missing; the message names the first.
    """
    found = {f"{e.estimator}_{e.index_prior}": _estimate(e) for e in result.estimates}
    return read_payload(
        {
            "realization_digest": result.realization_digest,
            "engine_digest": result.engine_digest,
            "versions": dict(result.versions),
            "noise_treatment": result.noise_treatment,
            "regularisation": result.regularisation,
            "profile": result.profile,
            "estimates": {name: found.get(name) for name in ESTIMATES} | found,
            "aperture": None if result.aperture is None else _aperture(result.aperture),
            "lens": {parameter.name: _quantity(parameter.value) for parameter in result.lens},
            "chain": None
            if result.chain is None
            else {name: _plain(getattr(result.chain, name)) for name in ChainPayload.model_fields},
            **{name: _plain(getattr(result, name)) for name in _OF_CHAIN},
            "arc_magnitude": float(result.arc_magnitude),
            "agn_contrast": None if result.agn_contrast is None else float(result.agn_contrast),
            "surface_brightness": float(result.surface_brightness),
            "stages": [{"stage": s.stage, "wall_s": float(s.wall_s), "cpu_s": float(s.cpu_s)} for s in result.stages],
            "work": {name: getattr(result.work, name) for name in WorkPayload.model_fields},
            "warnings": [warning[:2000] for warning in result.warnings],
            "figure": figure,
            "products": products,
        }
    )


class MeasurementPayload(_Strict):
    """What was found in an uploaded image; ``document`` is the JSON that ``hostlens measure`` writes."""

    realization_digest: Digest
    """Of the run's specification."""
    engine_digest: Digest
    document: dict[str, Any]
    wall_s: NonNegative
    cpu_s: NonNegative
    figure: ArtefactPayload | None = None

    @model_validator(mode="after")
    def _finite(self) -> MeasurementPayload:
        json.dumps(self.document, allow_nan=False)
        return self

    @property
    def products(self) -> None:
        """Arrays are not kept."""

    @property
    def digest(self) -> str:
        """SHA-256 of what was found; the time that it took is left out."""
        found = {name: value for name, value in self.document.items() if name not in {"seconds", "versions"}}
        said = json.dumps([self.realization_digest, self.engine_digest, found], sort_keys=True)
        return hashlib.sha256(said.encode()).hexdigest()


Payload = ResultPayload | MeasurementPayload
"""What a run of either kind brings home."""


def read_measurement(document: object) -> MeasurementPayload:
    """Validate the payload of a measurement, as :func:`read_payload`."""
    return _read(MeasurementPayload, document)


def read_payload(document: object) -> ResultPayload:
    """Validate a payload, wherever it comes from; an InvalidResultError names the first part that is wrong."""
    return _read(ResultPayload, document)


def _read(kind: type[_PayloadT], document: object) -> _PayloadT:
    try:
        return kind.model_validate(document)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or "payload"
        raise InvalidResultError(f"{place}: {first['msg']}") from error


def _estimate(estimate: Estimate) -> dict[str, Any]:
    quantities = {name: _quantity(getattr(estimate, name)) for name in QUANTITIES}
    counts = {name: int(getattr(estimate, name)) for name in COUNTS}
    return {**quantities, **counts, "budget": None if estimate.budget is None else asdict(estimate.budget)}


def _aperture(aperture: Aperture) -> dict[str, Any]:
    return {
        "radius": float(aperture.radius),
        "magnitude": _quantity(aperture.magnitude),
        "coverage": float(aperture.coverage),
        "draws": aperture.draws,
        "failed": aperture.failed,
    }


def _quantity(quantity: Quantity) -> dict[str, Any]:
    truth = None if quantity.truth is None else float(quantity.truth)
    return {"mean": float(quantity.mean), "sd": float(quantity.sd), "truth": truth}


def _plain(value: Any) -> Any:
    """A numpy scalar as Python's own, so that the payload is JSON."""
    return value.item() if hasattr(value, "item") else value
