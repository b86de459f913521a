"""Specifications: what a run is asked to do. Frozen, validated at the door, written and read as JSON.

Everything here is in the sky frame of :mod:`engine.conventions` (East/North arcsec, position angles East of North);
:mod:`engine.scene` turns a :class:`Realization` into arrays.
"""

from __future__ import annotations

import hashlib
import json
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from engine.errors import SpecError

_STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)

AxisRatio = Annotated[float, Field(ge=0.05, le=1.0)]
Angle = Annotated[float, Field(ge=-360.0, le=360.0)]
Magnitude = Annotated[float, Field(ge=5.0, le=40.0)]
SersicIndex = Annotated[float, Field(ge=0.3, le=10.0)]
Radius = Annotated[float, Field(gt=1e-4, le=60.0)]
Coordinate = Annotated[float, Field(ge=-60.0, le=60.0)]
Position = tuple[Coordinate, Coordinate]
Identifier = Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[A-Za-z0-9][A-Za-z0-9+._/-]*$")]
NoiseLevel = Literal["author", "handbook"]
NoiseTreatment = Literal["diagonal", "covariance", "paper_code"]
RegularisationName = Literal["zeroth", "gradient", "curvature"]


@dataclass(frozen=True, config=_STRICT)
class MassModel:
    """Elliptical power law with optional external shear, and where it puts the source.

    ``theta_E`` [arcsec] is on the intermediate axis; ``slope`` is gamma' = l_eta + 1; ``shear`` is (gamma1, gamma2)
    in the East/North axes, None where the system has none; ``source_position`` is the AGN's (and host's) position
    behind the lens [arcsec].
    """

    theta_E: Annotated[float, Field(gt=0.0, le=30.0)]
    q: AxisRatio
    position_angle: Angle
    slope: Annotated[float, Field(ge=1.2, le=2.8)]
    source_position: Position
    centre: Position = (0.0, 0.0)
    shear: tuple[float, float] | None = None


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

    name: Annotated[str, Field(min_length=1, max_length=8)]
    position: Position
    magnitude: Magnitude


@dataclass(frozen=True, config=_STRICT)
class ExposurePlan:
    """What is taken at each dither position: ``n_long`` exposures of ``long_s`` and one of ``short_s`` seconds.

    ``field_pixels`` is the side of the drizzled image.
    """

    field_pixels: Annotated[int, Field(ge=16, le=1000)]
    dither: Identifier
    long_s: Annotated[float, Field(gt=0.0, le=1e5)]
    n_long: Annotated[int, Field(ge=1, le=100)]
    short_s: Annotated[float, Field(gt=0.0, le=1e5)]


@dataclass(frozen=True, config=_STRICT)
class LensSystem:
    """A lensed AGN as observed: camera, exposures, AGN images, deflector light and mass models by name and l_eta."""

    name: Identifier
    camera: Identifier
    exposures: ExposurePlan
    agn: tuple[AgnImage, ...]
    deflector: SersicLight | None
    host_q: AxisRatio
    host_position_angle: Angle
    mass_models: dict[str, dict[str, MassModel]]

    def mass_model(self, name: str, l_eta: float) -> MassModel:
        """The mass model called ``name`` at slope l_eta; a SpecError names what there is."""
        if name not in self.mass_models:
            raise SpecError("mass_model", name, f"one of {sorted(self.mass_models)} for {self.name}")
        by_slope = self.mass_models[name]
        key = f"{l_eta:.1f}"
        if key not in by_slope or abs(float(key) - l_eta) > 1e-9:
            raise SpecError("l_eta", l_eta, f"one of {sorted(map(float, by_slope))} for {self.name}/{name}")
        return by_slope[key]


@dataclass(frozen=True, config=_STRICT)
class AuthorNoise:
    """Background level as the paper's scripts used it: e-/s per native pixel of one long and one short exposure."""

    std_long_e_s: Annotated[float, Field(gt=0.0)]
    std_short_e_s: Annotated[float, Field(gt=0.0)]
    bright_threshold_e_s: Annotated[float, Field(gt=0.0)]


@dataclass(frozen=True, config=_STRICT)
class ColdMask:
    """Cold stop of WFC3-IR: obscurations in fractions of the primary's radius."""

    secondary: float
    spider_width: float
    outer_radius: float


@dataclass(frozen=True, config=_STRICT)
class Pupil:
    """Telescope pupil: primary diameter [m]; the other lengths in fractions of the primary's radius."""

    primary_diameter_m: float
    secondary: float
    spider_width: float
    pads: tuple[tuple[float, float, float], ...]
    rotation_deg: float
    cold_mask: ColdMask | None = None
    zernike_waves_at_547nm: tuple[tuple[int, float], ...] = ()


@dataclass(frozen=True, config=_STRICT)
class Camera:
    """A camera with one filter: sampling, zero point, noise, pupil, band pass and detector kernel.

    ``pixel_scale`` and ``drizzled_scale`` in arcsec; ``detector_kernel`` is 3 x 3 on native pixels; noise in e- per
    native pixel (per second where named so).
    """

    name: Identifier
    pixel_scale: Annotated[float, Field(gt=0.0, le=1.0)]
    drizzled_scale: Annotated[float, Field(gt=0.0, le=1.0)]
    pixfrac: Annotated[float, Field(gt=0.0, le=1.0)]
    drizzle_kernel: Literal["square", "turbo", "gaussian", "point"]
    oversampling: Annotated[int, Field(ge=1, le=12)]
    zero_point: Magnitude
    gain: float
    full_well_e: float
    read_noise_e: float
    read_noise_short_e: float
    dark_e_s: float
    sky_e_s: float
    noise_author: AuthorNoise | None
    wavelength_nm: tuple[float, ...]
    throughput: tuple[float, ...]
    pupil: Pupil
    detector_kernel: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True, config=_STRICT)
class Dither:
    """Dither pattern: (x, y) shifts in sub-pixels, ``subpixels`` to the native pixel."""

    name: Identifier
    subpixels: Annotated[int, Field(ge=1, le=12)]
    shifts: tuple[tuple[int, int], ...]


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

    defocus_nm: Annotated[float, Field(ge=-500.0, le=500.0)] = 0.0
    jitter: Annotated[float, Field(ge=0.0, le=0.5)] = 0.0


NOMINAL_OPTICS = Optics()


@dataclass(frozen=True, config=_STRICT)
class Analysis:
    """How a run is analysed. Nothing here knows the truth.

    ``mask_inner`` and ``mask_outer`` bound the ring of fitted pixels in units of the measured Einstein radius;
    ``core_radius`` [arcsec] is the region round each AGN image whose noise is boosted to be effectively infinite;
    ``subrays`` rays are traced along each side of an image pixel; ``ray_margin`` [pixels] is how far outside the
    mask rays still count because the PSF carries their light in; ``source_pixels`` is (ny, nx) of the source grid,
    evenly spaced where ``source_softening`` is None, else crowded round the AGN within that fraction of its half-width;
    ``walkers`` walk the chain, or twice as many as there are parameters where that is more.
    """

    source_pixels: tuple[Annotated[int, Field(ge=2, le=80)], Annotated[int, Field(ge=2, le=80)]] = (30, 30)
    source_softening: Annotated[float, Field(gt=0.01, le=1e3)] | None = 0.5
    regularisation: RegularisationName = "curvature"
    noise_treatment: NoiseTreatment = "diagonal"
    mask_inner: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.4
    mask_outer: Annotated[float, Field(gt=1.0, le=5.0)] = 1.65
    core_radius: Annotated[float, Field(ge=0.0, le=2.0)] = 0.25
    subrays: Annotated[int, Field(ge=1, le=8)] = 2
    ray_margin: Annotated[int, Field(ge=0, le=40)] = 4
    psf_radius: Annotated[int, Field(ge=1, le=80)] = 15
    walkers: Annotated[int, Field(ge=4, le=1000)] = 14
    max_steps: Annotated[int, Field(ge=10, le=200_000)] = 300
    draws: Annotated[int, Field(ge=2, le=1000)] = 30


@dataclass(frozen=True, config=_STRICT)
class Realization:
    """One run of the study: a system at one slope, a host, a noise level, a study seed and how it is analysed.

    ``system`` names a catalogue entry or is a :class:`LensSystem` of the user's own; ``camera`` likewise, and is the
    system's own where None. ``optics`` spoils the PSF of the simulation, not the one that the analysis is given.
    Equal realizations have equal digests and give the same bits.
    """

    system: Identifier | LensSystem
    l_eta: Annotated[float, Field(ge=0.2, le=1.8)]
    host: Host
    seed: Annotated[int, Field(ge=0, le=2**63 - 1)] = 0
    noise_level: NoiseLevel = "author"
    mass_model: Identifier = "recommended"
    camera: Identifier | Camera | None = None
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
        return dumped

    @property
    def digest(self) -> str:
        """SHA-256 (hex) of the canonical JSON: the identity of the run."""
        return spec_digest(self.to_dict())

    @property
    def system_name(self) -> str:
        """Name of the lens system, whether from the catalogue or the user's own."""
        return self.system if isinstance(self.system, str) else self.system.name


_REALIZATION = TypeAdapter(Realization)


def spec_digest(document: dict[str, Any]) -> str:
    """SHA-256 (hex) of the canonical JSON of a realization's JSON-ready form: its digest, without reading it back."""
    canonical = json.dumps(document, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()


def spec_error(error: ValidationError, prefix: str = "") -> SpecError:
    """The first complaint of a pydantic validation as a SpecError with field, value and what is allowed."""
    first = error.errors()[0]
    field = ".".join([prefix] * bool(prefix) + [str(part) for part in first["loc"]])
    return SpecError(field or "specification", first.get("input"), first["msg"])


def realization_from_dict(document: object) -> Realization:
    """Read a realization from its JSON form; a SpecError names the field that is wrong."""
    try:
        return _REALIZATION.validate_python(document)
    except ValidationError as error:
        raise spec_error(error) from error
