"""How an observation is analysed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, get_args

from pydantic import AfterValidator, Field, model_validator
from pydantic.dataclasses import dataclass
from pydantic_core import ArgsKwargs

from engine.errors import SpecError
from engine.spec.priors import Priors
from engine.spec.quantities import STRICT, UNSIGNED, Count, Flag, Number

ProfileName = Literal["draft", "standard", "reference", "paper"]
NoiseTreatment = Literal["diagonal", "covariance", "paper_code"]
RegularisationName = Literal["zeroth", "gradient", "curvature"]
EstimatorName = Literal["paper", "covariance", "projected", "image"]
ESTIMATORS: tuple[EstimatorName, ...] = get_args(EstimatorName)
PROFILES: dict[str, dict[str, Any]] = {
    "draft": {"walkers": 4, "chain_length": 30.0, "max_steps": 300},
    "standard": {},
    "reference": {"walkers": 32, "chain_length": 150.0, "max_steps": 5000},
    "paper": {
        "source_pixels": (30, 30),
        "source_envelope": False,
        "noise_treatment": "diagonal",
        "walkers": 14,
        "chain_length": 50.0,
        "max_steps": 1000,
    },
}
"""What each profile sets otherwise than ``standard``, the defaults of :class:`Analysis`.

``draft``, ``standard`` and ``reference`` sample the same posterior, ever longer. ``paper`` is the source of the paper:
30 x 30 even pixels whose own brightness is regularised, noise without correlations.
"""


def _each_once(names: tuple[EstimatorName, ...]) -> tuple[EstimatorName, ...]:
    """The names in the one order that they have in every digest."""
    if len(set(names)) != len(names):
        raise SpecError("", names, "estimators without repetition")
    return tuple(sorted(names, key=ESTIMATORS.index))


@dataclass(frozen=True, config=STRICT)
class Analysis:
    """How a run is analysed. Nothing here knows the truth.

    ``profile`` names one of :data:`PROFILES`: it gives the values of what is not given here.
    ``mask_inner`` and ``mask_outer`` bound the ring of fitted pixels in units of the measured Einstein radius;
    ``core_radius`` [arcsec] is the region round each AGN image whose noise is boosted to be effectively infinite;
    ``subrays`` rays are traced along each side of an image pixel; ``ray_margin`` [pixels] is how far outside the
    mask rays still count because the PSF carries their light in; ``source_pixels`` is (ny, nx) of the source grid; with
    ``source_envelope`` the regularisation asks for a smooth ratio of the source to the host of the parametric fit,
    otherwise for a smooth source. ``walkers`` walk until the chain is ``chain_length`` autocorrelation times long, or
    for ``max_steps``.
    ``priors`` of the lens parameters, by name, come before those of the system. With ``agn_position_sd`` [arcsec per
    axis] the measured positions of the AGN images have to come from one point of the source plane. ``background_sd``
    [e-/s in a pixel] is how well the sky was taken off before; where None the background is free.
    With ``max_error`` [mag] the run itself chooses walkers, length of the chain, draws and source pixels, from those of
    `draft` up to the cost of `reference`, so that the numerical error of every magnitude (n in the wide range) stays
    below it; draws and source pixels that are given are the least. A warning says where it does not.
    ``estimators`` are those whose answer is wanted: ``image`` alone needs neither an inversion nor a chain.
    """

    profile: ProfileName = "standard"
    source_pixels: tuple[Annotated[Count, Field(ge=2, le=80)], Annotated[Count, Field(ge=2, le=80)]] = (20, 20)
    regularisation: RegularisationName = "curvature"
    noise_treatment: NoiseTreatment = "covariance"
    mask_inner: Annotated[Number, Field(ge=0.0, lt=1.0), UNSIGNED] = 0.4
    mask_outer: Annotated[Number, Field(gt=1.0, le=5.0)] = 1.65
    core_radius: Annotated[Number, Field(ge=0.0, le=2.0), UNSIGNED] = 0.25
    subrays: Annotated[Count, Field(ge=1, le=8)] = 2
    source_envelope: Flag = True
    ray_margin: Annotated[Count, Field(ge=0, le=40)] = 4
    psf_radius: Annotated[Count, Field(ge=1, le=80)] = 15
    walkers: Annotated[Count, Field(ge=2, le=1000)] = 8
    chain_length: Annotated[Number, Field(ge=10.0, le=1e4)] = 100.0
    max_steps: Annotated[Count, Field(ge=10, le=200_000)] = 600
    draws: Annotated[Count, Field(ge=2, le=1000)] = 30
    priors: Priors = Field(default_factory=dict)
    agn_position_sd: Annotated[Number, Field(ge=1e-5, le=1.0)] | None = None
    background_sd: Annotated[Number, Field(ge=1e-9, le=1e9)] | None = None
    max_error: Annotated[Number, Field(ge=1e-4, le=10.0)] | None = None
    estimators: Annotated[
        tuple[EstimatorName, ...], Field(min_length=1, max_length=len(ESTIMATORS)), AfterValidator(_each_once)
    ] = ESTIMATORS

    @property
    def needs_chain(self) -> bool:
        """Whether an estimator is asked for that looks at sources of the chain."""
        return self.estimators != ("image",)

    @model_validator(mode="before")
    @classmethod
    def _fill_from_profile(cls, given: Any) -> Any:
        """What is not given is the profile's."""
        if isinstance(given, ArgsKwargs):
            settings = given.kwargs or {}
            if given.args:
                return given
            return ArgsKwargs((), {**PROFILES.get(settings.get("profile", "standard"), {}), **settings})
        if isinstance(given, Mapping):
            name = given.get("profile", "standard")
            return {**(PROFILES.get(name, {}) if isinstance(name, str) else {}), **given}
        return given
