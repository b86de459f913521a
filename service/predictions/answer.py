"""From a request to its answer: the lens's traits, what simulated runs say of it, and the grids that settle it."""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Callable
from typing import Any

from pydantic import TypeAdapter

from engine import (
    NEAR,
    PREDICTED,
    EstimatorPrediction,
    Host,
    LensSystem,
    LensTraits,
    Predictor,
    QuantityPrediction,
    Range,
    Realization,
    SimulatedRun,
    SpecError,
    check_system,
    load_camera,
    load_system,
    resolution_of,
    traits_of,
)
from service.domain.payload import ESTIMATES, estimator_and_prior
from service.domain.prediction_views import (
    ExpectedView,
    GridOffer,
    NearestRun,
    PredictedDepth,
    PredictedEstimator,
    PredictedQuantity,
    PredictionAnswer,
)
from service.domain.predictions import PredictionRequest
from service.domain.requests import GridRequest
from service.domain.views import Cost, Interval

_SYSTEM = TypeAdapter(LensSystem)
_UNITS = {"magnitude": "AB mag", "r_eff": "arcsec", "n": None}
_SEEDS = 10
"""Of a grid that settles a bias: its mean is then known to a third of the scatter of one measurement."""
_LONGEST_NAME = 60
_MOST_EXPOSURES = 100
_LONGEST_EXPOSURE_S = 1e5

CostOf = Callable[[GridRequest], Cost]
"""What a grid should take by a service's own stored runs."""


def answer(
    request: PredictionRequest, runs: tuple[SimulatedRun, ...], predictor: Predictor, cost_of: CostOf | None = None
) -> PredictionAnswer:
    """Predict a lens by the runs that ``predictor`` was made of; ``cost_of`` knows a service's stored runs.

    Raises
    ------
    engine.SpecError
        A value is not allowed, or there are no runs of an estimator that is asked for.
    """
    traits = lens_traits(request)
    known = predictor.estimators()
    names = request.estimators or [name for name in ESTIMATES if name in known and name.endswith("_wide")]
    if not names:
        raise SpecError("grids", request.grids, "grids with runs of four lenses at least, or study = true beside them")
    predictions = [_at_depth(traits.deeper(factor), factor, names, predictor, request) for factor in request.exposures]
    answers = [found for one in predictions for found in one.estimates.values()]
    return PredictionAnswer(
        lens={**dataclasses.asdict(traits), "arc_snr": six(traits.arc_snr)},
        level=request.level,
        extrapolating=any(found.extrapolating for found in answers),
        told=_told(predictions),
        predictions=predictions,
        to_know=_offers(request, traits, names, runs, cost_of),
    )


def lens_traits(request: PredictionRequest) -> LensTraits:
    """What is known of the lens that a request means."""
    if request.simulated is None:
        return _given_traits(request)
    system, host = request.simulated
    if isinstance(system, LensSystem):
        try:
            check_system(system)
        except SpecError as error:
            raise SpecError(f"system.{error.field}", error.value, error.allowed) from error
    realization = Realization(
        system=system,
        host=host,
        l_eta=request.l_eta,
        mass_model=request.mass_model,
        noise_level=request.noise_level,
        camera=request.camera,
        optics=request.optics,
    )
    return traits_of(realization)


def _given_traits(request: PredictionRequest) -> LensTraits:
    given = request.traits
    if given is None:
        raise SpecError("traits", None, "the traits of a lens where there is no system")
    values = given.model_dump()
    if given.resolution is None:
        try:
            values["resolution"] = resolution_of(load_camera(given.camera))
        except SpecError as error:
            raise SpecError("traits.camera", given.camera, f"{error.allowed}, or one with a resolution") from error
    try:
        return LensTraits(**values)
    except SpecError as error:
        raise SpecError(f"traits.{error.field}", error.value, error.allowed) from error


def _at_depth(
    traits: LensTraits, factor: float, names: list[Any], predictor: Predictor, request: PredictionRequest
) -> PredictedDepth:
    found = {name: _estimator(predictor.predict(traits, name, request.level)) for name in names}
    return PredictedDepth(exposures=factor, depth=six(traits.depth), arc_snr=six(traits.arc_snr), estimates=found)


def _estimator(found: EstimatorPrediction) -> PredictedEstimator:
    return PredictedEstimator(
        **{name: _quantity(found.quantities[name], name) for name in PREDICTED},
        runs=found.runs,
        lenses=found.lenses,
        run_ids=list(found.run_ids),
        extrapolating=found.extrapolating,
        nearest=NearestRun(
            lens=found.nearest_lens,
            run_id=found.run_ids[0],
            distance=six(found.distance),
            differences={name: six(value) for name, value in found.differences.items()},
        ),
    )


def _quantity(found: QuantityPrediction | None, name: str) -> PredictedQuantity | None:
    if found is None:
        return None
    parts = {part: _range(getattr(found, part)) for part in ("bias", "scatter", "measurement")}
    return PredictedQuantity(unit=_UNITS[name], **parts)


def _range(found: Range) -> ExpectedView:
    return ExpectedView(expected=six(found.expected), low=six(found.low), high=six(found.high))


def six(value: float) -> float:
    """Six significant digits: no number here has more."""
    return float(f"{value:.6g}")


def _told(predictions: list[PredictedDepth]) -> str:
    """Which estimators are predicted by runs that are far from the lens, in words."""
    far = {
        name: found.nearest
        for one in predictions
        for name, found in one.estimates.items()
        if found.extrapolating
    }  # fmt: skip
    if not far:
        return "each estimator has simulated runs of lenses like this one"
    nearest = "; ".join(
        f"{name}: nearest is {run.lens}, {run.distance:.1f} away, most in "
        f"{max(run.differences, key=lambda feature: abs(run.differences[feature]))}"
        for name, run in far.items()
    )
    return f"extrapolating, no run is nearer than {NEAR:g}: {nearest}; only a grid can settle it"


def _offers(
    request: PredictionRequest, traits: LensTraits, names: list[Any], runs: tuple[SimulatedRun, ...],
    cost_of: CostOf | None,
) -> list[GridOffer]:  # fmt: skip
    """Grids that simulate this lens: as it is, and where other exposures are asked for, with those."""
    if request.simulated is None:
        return []
    wanted = {"as it is": _body(request, *request.simulated, names, [1.0])}
    if request.exposures != [1.0]:
        times = ", ".join(f"{factor:g}" for factor in request.exposures)
        wanted[f"with {times} times the exposures"] = _body(request, *request.simulated, names, request.exposures)
    offers = []
    for what, body in wanted.items():
        n_runs = len(body["systems"]) * _SEEDS
        cpu_s, told = _cost(GridRequest.model_validate(body), traits, names, n_runs, runs, cost_of)
        offers.append(
            GridOffer(what=f"this lens {what}", request=body, n_runs=n_runs, cpu_s=cpu_s, cost_from=told)
        )  # fmt: skip
    return offers


def _body(
    request: PredictionRequest, choice: str | LensSystem, host: Host, names: list[Any], exposures: list[float]
) -> dict[str, Any]:
    """A body of POST /v1/grids: ten seeds of the lens, at each of these exposures."""
    system = load_system(choice) if isinstance(choice, str) else choice
    level = request.noise_level
    if exposures == [1.0]:
        systems: list[Any] = [choice if isinstance(choice, str) else _dumped(system)]
    else:
        whole = all((system.exposures.n_long * factor).is_integer() for factor in exposures)
        # The paper's background is one of its exposures and knows no other length of them.
        level = level if whole else "handbook"
        systems = [_dumped(_exposed(system, factor, whole)) for factor in exposures]
    estimators = list(dict.fromkeys(estimator_and_prior(name)[0] for name in names))
    optional = {
        "camera": request.model_dump(mode="json")["camera"],
        "optics": None if request.optics is None else dataclasses.asdict(request.optics),
    }
    return {
        "name": f"settle {system.name}"[:_LONGEST_NAME],
        "systems": systems,
        "n": [host.n],
        "r_eff": [host.r_eff],
        "magnitude": [host.magnitude],
        "l_eta": [request.l_eta],
        "mass_model": request.mass_model,
        "noise_level": level,
        "replicates": _SEEDS,
        "analysis": {"profile": "draft", "estimators": estimators},
        **{name: value for name, value in optional.items() if value is not None},
    }


def _exposed(system: LensSystem, factor: float, whole: bool) -> LensSystem:
    """A system with so many times its exposures: more of them, or else longer ones."""
    plan = system.exposures
    number, seconds = (round(plan.n_long * factor), plan.long_s) if whole else (plan.n_long, plan.long_s * factor)
    if number > _MOST_EXPOSURES or seconds > _LONGEST_EXPOSURE_S:
        raise SpecError(
            "exposures", factor, f"factors that leave {_MOST_EXPOSURES} exposures of {_LONGEST_EXPOSURE_S:g} s at most"
        )
    name = f"{system.name[: _LONGEST_NAME - 10]}-x{factor:g}"
    return dataclasses.replace(
        system, name=name, exposures=dataclasses.replace(plan, n_long=number, long_s=seconds)
    )  # fmt: skip


def _dumped(system: LensSystem) -> dict[str, Any]:
    document = _SYSTEM.dump_python(system, mode="json")
    return {name: value for name, value in document.items() if value is not None}


def _cost(
    body: GridRequest, traits: LensTraits, names: list[Any], n_runs: int, runs: tuple[SimulatedRun, ...],
    cost_of: CostOf | None,
) -> tuple[Interval | None, str]:  # fmt: skip
    """CPU of a grid by the service's stored runs, or else by those of the prediction before the same camera."""
    if cost_of is not None:
        cost = cost_of(body)
        if cost.cpu_s is not None:
            return cost.cpu_s, f"{cost.stored_runs} stored runs of its camera, configuration and profile"
    times = [
        run.cpu_s
        for run in runs
        if run.cpu_s is not None
        and (run.traits.camera, run.traits.configuration) == (traits.camera, traits.configuration)
        and set(names) <= set(run.found)
    ]
    if len(times) < 2:
        return None, "no run of its camera and configuration is known"
    mean, scatter = statistics.fmean(times), statistics.stdev(times)
    either_way = 2.0 * scatter * (n_runs + n_runs**2 / len(times)) ** 0.5
    expected = n_runs * mean
    told = f"{len(times)} runs of its camera and configuration behind the prediction, with at least its estimators"
    return Interval(low=max(expected - either_way, 0.0), expected=expected, high=expected + either_way), told
