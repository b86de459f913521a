"""Specifications: what a run is asked to do. Frozen, validated at the door, written and read as JSON.

Everything here is in the sky frame of :mod:`engine.conventions` (East/North arcsec, position angles East of North);
:mod:`engine.scene` turns a :class:`Realization` into arrays.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated, Any, Literal, TypeVar

from pydantic import (
    AfterValidator,
    ConfigDict,
    Discriminator,
    Field,
    Strict,
    Tag,
    TypeAdapter,
    ValidationError,
    model_validator,
)
from pydantic.dataclasses import dataclass
from pydantic_core import ArgsKwargs

from engine.errors import SpecError
from engine.validation import (
    DECIMAL,
    IDENTIFIER,
    NAME_TAG,
    OBJECT_TAG,
    PRINTABLE,
    field_path,
    name_or_object,
    spec_error,
)

_STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)

# Strict, or a file's true would be the number 1 and its "20.5" a number. What stands here is the one statement of what
# is allowed: files, grids and the API's schema are made of these types.
# A negative zero is read as zero: the two are equal, and JSON would make two digests of them. It stands behind the
# bounds of every number that can be zero, or the schema would not know them for bounds.
_UNSIGNED = AfterValidator(lambda number: number + 0.0)
Number = Annotated[float, Strict()]
Count = Annotated[int, Strict()]
Flag = Annotated[bool, Strict()]
AxisRatio = Annotated[Number, Field(ge=0.05, le=1.0)]
Angle = Annotated[Number, Field(ge=-360.0, le=360.0), _UNSIGNED]
Magnitude = Annotated[Number, Field(ge=5.0, le=40.0)]
SersicIndex = Annotated[Number, Field(ge=0.3, le=10.0)]
Radius = Annotated[Number, Field(gt=1e-4, le=60.0)]
Coordinate = Annotated[Number, Field(ge=-60.0, le=60.0), _UNSIGNED]
Position = tuple[Coordinate, Coordinate]
Positive = Annotated[Number, Field(gt=0.0, le=1e9)]
NotNegative = Annotated[Number, Field(ge=0.0, le=1e9), _UNSIGNED]
Bound = Annotated[Number, Field(ge=-1e6, le=1e6), _UNSIGNED]
PupilCoordinate = Annotated[Number, Field(ge=-2.0, le=2.0), _UNSIGNED]
Waves = Annotated[Number, Field(ge=-10.0, le=10.0), _UNSIGNED]
Slope = Annotated[Number, Field(ge=0.2, le=1.8)]
Seed = Annotated[Count, Field(ge=0, le=2**63 - 1)]
Fraction = Annotated[Number, Field(ge=0.0, lt=1.0), _UNSIGNED]
Scale = Annotated[Number, Field(gt=0.0001, le=1.0)]
Shear = Annotated[Number, Field(ge=-0.7, le=0.7), _UNSIGNED]
Shift = Annotated[Count, Field(ge=-64, le=64)]
ZernikeTerm = Literal[4, 5, 6, 7, 8, 9, 10, 11, 22]
KernelRow = tuple[NotNegative, NotNegative, NotNegative]
RightAscension = Annotated[Number, Field(ge=0.0, lt=360.0), _UNSIGNED]
Declination = Annotated[Number, Field(ge=-90.0, le=90.0), _UNSIGNED]
Exposure = Annotated[Number, Field(gt=0.0, le=1e5)]
Identifier = Annotated[str, Field(min_length=1, max_length=64, pattern=IDENTIFIER)]
SlopeKey = Annotated[str, Field(pattern=DECIMAL)]
NoiseLevel = Literal["author", "handbook"]
ProfileName = Literal["draft", "standard", "reference", "paper"]
NoiseTreatment = Literal["diagonal", "covariance", "paper_code"]
LensParameterName = Literal["theta_E", "q", "phi", "slope", "x", "y", "gamma1", "gamma2", "ln_lambda"]
RegularisationName = Literal["zeroth", "gradient", "curvature"]
_Read = TypeVar("_Read")
_SLOPE_TOLERANCE = 1e-9


@dataclass(frozen=True, config=_STRICT)
class ParameterPrior:
    """Prior of one parameter of the chain: flat from ``low`` to ``high``, times a Gaussian of ``mean`` and ``sd``.

    A bound that is None stays where it is by default. Units and frame are those of the result: arcsec, radians, image
    frame of :mod:`engine.conventions`.
    """

    low: Bound | None = None
    high: Bound | None = None
    mean: Bound | None = None
    sd: Positive | None = None

    @model_validator(mode="after")
    def _says_something(self) -> ParameterPrior:
        if (self.mean is None) != (self.sd is None):
            raise SpecError("", (self.mean, self.sd), "mean, sd: both or neither")
        if self.low is None and self.high is None and self.mean is None:
            raise SpecError("", None, "low, high, mean, sd: a bound, or a mean with its sd")
        if self.low is not None and self.high is not None and not self.low < self.high:
            raise SpecError("", (self.low, self.high), "low, high: the lower bound below the upper")
        return self


Priors = dict[LensParameterName, ParameterPrior]


@dataclass(frozen=True, config=_STRICT)
class MassModel:
    """Elliptical power law with optional external shear, and where it puts the source.

    ``theta_E`` [arcsec] is on the intermediate axis; ``slope`` is gamma' = l_eta + 1; ``shear`` is (gamma1, gamma2)
    in the East/North axes, None where the system has none; ``source_position`` is the AGN's (and host's) position
    behind the lens [arcsec].
    """

    theta_E: Annotated[Number, Field(gt=0.001, le=30.0)]
    q: AxisRatio
    position_angle: Angle
    slope: Annotated[Number, Field(ge=1.2, le=2.8)]
    source_position: Position
    centre: Position = (0.0, 0.0)
    shear: tuple[Shear, Shear] | None = None


@dataclass(frozen=True, config=_STRICT)
class SersicLight:
    """A Sersic profile: total AB magnitude, r_eff [arcsec, intermediate axis], index, axis ratio, position angle."""

    magnitude: Magnitude
    r_eff: Radius
    n: SersicIndex
    q: AxisRatio
    position_angle: Angle
    centre: Position = (0.0, 0.0)


@dataclass(frozen=True, config=_STRICT)
class AgnImage:
    """One image of the AGN: its name, its observed position [arcsec] and its AB magnitude."""

    name: Annotated[str, Field(min_length=1, max_length=8, pattern=PRINTABLE)]
    position: Position
    magnitude: Magnitude


@dataclass(frozen=True, config=_STRICT)
class Dither:
    """Dither pattern: (x, y) shifts in sub-pixels, ``subpixels`` to the native pixel."""

    name: Identifier
    subpixels: Annotated[Count, Field(ge=1, le=12)]
    shifts: Annotated[tuple[tuple[Shift, Shift], ...], Field(min_length=1, max_length=64)]


DitherChoice = Annotated[
    Annotated[Identifier, Tag(NAME_TAG)] | Annotated[Dither, Tag(OBJECT_TAG)], Discriminator(name_or_object)
]


@dataclass(frozen=True, config=_STRICT)
class ExposurePlan:
    """What is taken at each dither position: ``n_long`` exposures of ``long_s`` and one of ``short_s`` seconds.

    ``field_pixels`` is the side of the drizzled image; ``dither`` names a pattern of the catalogue or is one.
    """

    field_pixels: Annotated[Count, Field(ge=16, le=1000)]
    dither: DitherChoice
    long_s: Exposure
    n_long: Annotated[Count, Field(ge=1, le=100)]
    short_s: Exposure


@dataclass(frozen=True, config=_STRICT)
class AuthorNoise:
    """Background level as the paper's scripts used it: e-/s per native pixel of one long and one short exposure."""

    std_long_e_s: Positive
    std_short_e_s: Positive
    bright_threshold_e_s: Positive


@dataclass(frozen=True, config=_STRICT)
class ColdMask:
    """Cold stop of WFC3-IR: obscurations in fractions of the primary's radius."""

    secondary: Fraction
    spider_width: Fraction
    outer_radius: Scale


@dataclass(frozen=True, config=_STRICT)
class Pupil:
    """Telescope pupil: primary diameter [m]; the other lengths in fractions of the primary's radius."""

    primary_diameter_m: Annotated[Number, Field(gt=0.0, le=100.0)]
    secondary: Fraction
    spider_width: Fraction
    pads: Annotated[tuple[tuple[PupilCoordinate, PupilCoordinate, Fraction], ...], Field(max_length=16)]
    rotation_deg: Angle
    cold_mask: ColdMask | None = None
    zernike_waves_at_547nm: Annotated[tuple[tuple[ZernikeTerm, Waves], ...], Field(max_length=16)] = ()


@dataclass(frozen=True, config=_STRICT)
class Camera:
    """A camera with one filter: sampling, zero point, noise, pupil, band pass and detector kernel.

    ``pixel_scale`` and ``drizzled_scale`` in arcsec; ``detector_kernel`` is 3 x 3 on native pixels; noise in e- per
    native pixel (per second where named so).
    """

    name: Identifier
    pixel_scale: Scale
    drizzled_scale: Scale
    pixfrac: Scale
    drizzle_kernel: Literal["square", "turbo", "gaussian", "point"]
    oversampling: Annotated[Count, Field(ge=1, le=12)]
    zero_point: Magnitude
    gain: Positive
    full_well_e: Positive
    read_noise_e: NotNegative
    read_noise_short_e: NotNegative
    dark_e_s: NotNegative
    sky_e_s: NotNegative
    wavelength_nm: Annotated[tuple[Positive, ...], Field(min_length=2, max_length=1000)]
    throughput: Annotated[tuple[NotNegative, ...], Field(max_length=1000)]
    pupil: Pupil
    detector_kernel: tuple[KernelRow, KernelRow, KernelRow]
    noise_author: AuthorNoise | None = None

    @model_validator(mode="after")
    def _band_and_kernel(self) -> Camera:
        wavelengths = self.wavelength_nm
        if any(b <= a for a, b in pairwise(wavelengths)):
            raise SpecError("wavelength_nm", wavelengths, "wavelengths that increase")
        if len(self.throughput) != len(wavelengths):
            raise SpecError("throughput", f"{len(self.throughput)} values", f"one for each of {len(wavelengths)} nm")
        if not sum(self.throughput) > 0:
            raise SpecError("throughput", self.throughput, "values of which one at least is positive")
        if not sum(map(sum, self.detector_kernel)) > 0:
            raise SpecError("detector_kernel", self.detector_kernel, "a kernel with a positive sum")
        return self


CameraChoice = Annotated[
    Annotated[Identifier, Tag(NAME_TAG)] | Annotated[Camera, Tag(OBJECT_TAG)], Discriminator(name_or_object)
]


@dataclass(frozen=True, config=_STRICT)
class LensSystem:
    """A lensed AGN as observed: camera, exposures, AGN images, deflector light and mass models by name and l_eta.

    ``camera`` names one of the catalogue or is one; ``coordinates`` are RA and Dec [deg, ICRS] of the centre of the
    image, None where they do not matter. ``priors`` are those of the lens parameters, by name, where they differ from
    the wide ones that hold otherwise.
    """

    name: Identifier
    camera: CameraChoice
    exposures: ExposurePlan
    agn: Annotated[tuple[AgnImage, ...], Field(max_length=16)]
    host_q: AxisRatio
    host_position_angle: Angle
    mass_models: Annotated[
        dict[Identifier, Annotated[dict[SlopeKey, MassModel], Field(max_length=32)]], Field(min_length=1, max_length=32)
    ]
    deflector: SersicLight | None = None
    coordinates: tuple[RightAscension, Declination] | None = None
    priors: Priors = Field(default_factory=dict)

    @model_validator(mode="after")
    def _names_and_slopes(self) -> LensSystem:
        names = [image.name for image in self.agn]
        if len(set(names)) != len(names):
            raise SpecError("agn", names, "images of different names")
        for model, by_slope in self.mass_models.items():
            if not by_slope:
                raise SpecError(field_path(("mass_models", model)), by_slope, "a model for one l_eta at least")
            for key, mass in by_slope.items():
                place = field_path(("mass_models", model, key))
                if not abs(float(key) + 1.0 - mass.slope) <= _SLOPE_TOLERANCE:
                    raise SpecError(place, key, f"l_eta of its slope, {round(mass.slope - 1.0, 9)}")
                if any(other != key and abs(float(other) - float(key)) <= _SLOPE_TOLERANCE for other in by_slope):
                    raise SpecError(place, key, "one model for each l_eta")
        return self

    @property
    def camera_name(self) -> str:
        """Name of the camera, whether from the catalogue or the system's own."""
        return self.camera if isinstance(self.camera, str) else self.camera.name

    def mass_model(self, name: str, l_eta: float) -> MassModel:
        """The mass model called ``name`` at slope l_eta; a SpecError names what there is."""
        if name not in self.mass_models:
            raise SpecError("mass_model", name, f"one of {sorted(self.mass_models)} for {self.name}")
        by_slope = {float(key): mass for key, mass in self.mass_models[name].items()}
        for slope, mass in by_slope.items():
            if abs(slope - l_eta) <= _SLOPE_TOLERANCE:
                return mass
        raise SpecError("l_eta", l_eta, f"one of {sorted(by_slope)} for {self.name}/{name}")


SystemChoice = Annotated[
    Annotated[Identifier, Tag(NAME_TAG)] | Annotated[LensSystem, Tag(OBJECT_TAG)], Discriminator(name_or_object)
]


@dataclass(frozen=True, config=_STRICT)
class Host:
    """The host galaxy to be recovered. q and position angle [deg] are the system's where None."""

    n: SersicIndex
    r_eff: Radius
    magnitude: Magnitude
    q: AxisRatio | None = None
    position_angle: Angle | None = None


@dataclass(frozen=True, config=_STRICT)
class Optics:
    """How the telescope departs from its nominal PSF, for simulating a PSF that the analysis does not know.

    ``defocus_nm`` is the focus error [nm rms of wavefront]; 1 micron of HST's secondary mirror is 6 nm, its breathing
    about 15 nm. ``jitter`` is the pointing jitter [arcsec rms an axis].
    """

    defocus_nm: Annotated[Number, Field(ge=-500.0, le=500.0), _UNSIGNED] = 0.0
    jitter: Annotated[Number, Field(ge=0.0, le=0.5), _UNSIGNED] = 0.0


NOMINAL_OPTICS = Optics()


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


@dataclass(frozen=True, config=_STRICT)
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
    """

    profile: ProfileName = "standard"
    source_pixels: tuple[Annotated[Count, Field(ge=2, le=80)], Annotated[Count, Field(ge=2, le=80)]] = (20, 20)
    regularisation: RegularisationName = "curvature"
    noise_treatment: NoiseTreatment = "covariance"
    mask_inner: Annotated[Number, Field(ge=0.0, lt=1.0), _UNSIGNED] = 0.4
    mask_outer: Annotated[Number, Field(gt=1.0, le=5.0)] = 1.65
    core_radius: Annotated[Number, Field(ge=0.0, le=2.0), _UNSIGNED] = 0.25
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


@dataclass(frozen=True, config=_STRICT)
class Realization:
    """One run of the study: a system at one slope, a host, a noise level, a study seed and how it is analysed.

    ``system`` names a catalogue entry or is a :class:`LensSystem` of the user's own; ``camera`` likewise, and is the
    system's own where None. ``optics`` spoils the PSF of the simulation, not the one that the analysis is given.
    Equal realizations have equal digests and give the same bits.
    """

    system: SystemChoice
    l_eta: Slope
    host: Host
    seed: Seed = 0
    noise_level: NoiseLevel = "author"
    mass_model: Identifier = "recommended"
    camera: CameraChoice | None = None
    optics: Optics | None = None
    analysis: Analysis = Field(default_factory=Analysis)

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready form; :func:`realization_from_dict` reads it back."""
        dumped = _REALIZATION.dump_python(self, mode="json")
        if not isinstance(dumped, dict):  # pragma: no cover - a dataclass always dumps to a mapping
            raise TypeError(type(dumped))
        # Left out where it is not used, so that realizations from before there was such a field keep their digests.
        if dumped["optics"] is None:
            del dumped["optics"]
        dumped["analysis"] |= _GONE
        for name in ("agn_position_sd", "background_sd"):
            if dumped["analysis"][name] is None:
                del dumped["analysis"][name]
        for holder in (dumped["analysis"], dumped["system"]):
            if isinstance(holder, dict) and not holder["priors"]:
                del holder["priors"]
        return dumped

    @property
    def digest(self) -> str:
        """SHA-256 (hex) of the canonical JSON: the identity of the run."""
        return spec_digest(self.to_dict())

    @property
    def observation_digest(self) -> str:
        """SHA-256 (hex) of all but analysis and priors: realizations that differ in these alone are the same image."""
        document = self.to_dict()
        del document["analysis"]
        if isinstance(document["system"], dict):
            document["system"].pop("priors", None)
        return spec_digest(document)

    @property
    def system_name(self) -> str:
        """Name of the lens system, whether from the catalogue or the user's own."""
        return self.system if isinstance(self.system, str) else self.system.name


_GONE = {"source_softening": None}
"""Fields that an analysis once had, with the only value that they can still have: digests are made with them."""
_REALIZATION = TypeAdapter(Realization)
_SYSTEM = TypeAdapter(LensSystem)
_CAMERA = TypeAdapter(Camera)


def spec_digest(document: dict[str, Any]) -> str:
    """SHA-256 (hex) of the canonical JSON of a realization's JSON-ready form: its digest, without reading it back."""
    canonical = json.dumps(document, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()


def realization_from_dict(document: object) -> Realization:
    """Read a realization from its JSON form; a SpecError names the field that is wrong."""
    if isinstance(document, Mapping) and isinstance(analysis := document.get("analysis"), Mapping):
        kept = {name: value for name, value in analysis.items() if value is not None or name not in _GONE}
        document = {**document, "analysis": kept}
    try:
        return _REALIZATION.validate_python(document)
    except ValidationError as error:
        raise spec_error(error) from error


def system_from_mapping(document: Mapping[str, Any]) -> LensSystem:
    """Read a lens system from its JSON or TOML form; a SpecError names the field that is wrong, as ``agn[1].name``."""
    return _read(_SYSTEM, document)


def camera_from_mapping(document: Mapping[str, Any]) -> Camera:
    """Read a camera from its JSON or TOML form; a SpecError names the field that is wrong."""
    return _read(_CAMERA, document)


def _read(adapter: TypeAdapter[_Read], document: Mapping[str, Any]) -> _Read:
    try:
        return adapter.validate_python(document)
    except ValidationError as error:
        raise spec_error(error) from error
