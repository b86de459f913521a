"""Cameras, dither patterns and exposures."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, SerializerFunctionWrapHandler, Tag, model_serializer, model_validator
from pydantic.dataclasses import dataclass

from engine.errors import SpecError
from engine.spec.quantities import (
    STRICT,
    UNSIGNED,
    Angle,
    Count,
    Fraction,
    Identifier,
    Magnitude,
    NotNegative,
    Number,
    Positive,
    Scale,
    Shift,
)
from engine.spec.validation import LIST_TAG, NAME_TAG, OBJECT_TAG, name_or_object, one_or_list

PupilCoordinate = Annotated[Number, Field(ge=-2.0, le=2.0), UNSIGNED]
Waves = Annotated[Number, Field(ge=-10.0, le=10.0), UNSIGNED]
ZernikeTerm = Literal[4, 5, 6, 7, 8, 9, 10, 11, 22]
KernelRow = tuple[NotNegative, NotNegative, NotNegative]
Exposure = Annotated[Number, Field(gt=0.0, le=1e5)]
NoiseLevel = Literal["author", "handbook"]


@dataclass(frozen=True, config=STRICT)
class Dither:
    """Dither pattern: (x, y) shifts in sub-pixels, ``subpixels`` to the native pixel."""

    name: Identifier
    subpixels: Annotated[Count, Field(ge=1, le=12)]
    shifts: Annotated[tuple[tuple[Shift, Shift], ...], Field(min_length=1, max_length=64)]


DitherChoice = Annotated[
    Annotated[Identifier, Tag(NAME_TAG)] | Annotated[Dither, Tag(OBJECT_TAG)], Discriminator(name_or_object)
]


@dataclass(frozen=True, config=STRICT)
class ExposurePlan:
    """What is taken at each dither position: ``n_long`` exposures of ``long_s`` and one of ``short_s`` seconds.

    ``field_pixels`` is the side of the drizzled image; ``dither`` names a pattern of the catalogue or is one.
    """

    field_pixels: Annotated[Count, Field(ge=16, le=1000)]
    dither: DitherChoice
    long_s: Exposure
    n_long: Annotated[Count, Field(ge=1, le=100)]
    short_s: Exposure


@dataclass(frozen=True, config=STRICT)
class AuthorNoise:
    """Background level as the paper's scripts used it: e-/s per native pixel of one long and one short exposure."""

    std_long_e_s: Positive
    std_short_e_s: Positive
    bright_threshold_e_s: Positive


@dataclass(frozen=True, config=STRICT)
class ColdMask:
    """Cold stop of WFC3-IR: obscurations in fractions of the primary's radius."""

    secondary: Fraction
    spider_width: Fraction
    outer_radius: Scale


@dataclass(frozen=True, config=STRICT)
class Pupil:
    """Telescope pupil: primary diameter [m]; the other lengths in fractions of the primary's radius."""

    primary_diameter_m: Annotated[Number, Field(gt=0.0, le=100.0)]
    secondary: Fraction
    spider_width: Fraction
    pads: Annotated[tuple[tuple[PupilCoordinate, PupilCoordinate, Fraction], ...], Field(max_length=16)]
    rotation_deg: Angle
    cold_mask: ColdMask | None = None
    zernike_waves_at_547nm: Annotated[tuple[tuple[ZernikeTerm, Waves], ...], Field(max_length=16)] = ()


@dataclass(frozen=True, config=STRICT)
class Camera:
    """A camera with one filter: sampling, zero point, noise, pupil, band pass and detector kernel.

    ``pixel_scale`` and ``drizzled_scale`` in arcsec; ``detector_kernel`` is 3 x 3 on native pixels; noise in e- per
    native pixel (per second where named so).
    """

    name: Identifier
    pixel_scale: Scale
    drizzled_scale: Scale
    pixfrac: Scale
    drizzle_kernel: Literal["square"]
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


@dataclass(frozen=True, config=STRICT)
class Optics:
    """How the PSF of the sky departs from the one that the analysis is given.

    ``defocus_nm`` is the focus error [nm rms of wavefront]; 1 micron of HST's secondary mirror is 6 nm, its breathing
    about 15 nm. ``jitter`` is the pointing jitter [arcsec rms an axis]. ``colour`` is how much bluer than the star of
    the analysis's PSF the sky is: its photons per nm go as wavelength^-colour beside the star's. ``residual`` is a
    smooth random error of the PSF, rms as a part of its light, drawn by ``residual_seed``. ``coarse`` is the side
    [sub-pixels of the simulation] of the pixels on which the analysis knows its PSF: it is the mean over them.
    """

    defocus_nm: Annotated[Number, Field(ge=-500.0, le=500.0), UNSIGNED] = 0.0
    jitter: Annotated[Number, Field(ge=0.0, le=0.5), UNSIGNED] = 0.0
    colour: Annotated[Number, Field(ge=-20.0, le=20.0), UNSIGNED] = 0.0
    residual: Annotated[Number, Field(ge=0.0, le=0.2), UNSIGNED] = 0.0
    residual_seed: Annotated[Count, Field(ge=0, le=2**32 - 1)] = 0
    coarse: Annotated[Count, Field(ge=1, le=12)] = 1

    @property
    def label(self) -> str:
        """What tells it apart, in short: ``d20_j0.005``; ``nominal`` where nothing is spoilt."""
        parts = (
            f"{letter}{getattr(self, name):g}"
            for letter, name in _LETTERS.items()
            if getattr(self, name) != getattr(NOMINAL_OPTICS, name)
        )
        return "_".join(parts) or "nominal"

    @model_serializer(mode="wrap")
    def _without_what_came_later(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """As it was before there were more than two fields, where the others are not used: digests and keys stay."""
        document: dict[str, Any] = handler(self)
        later = ("colour", "residual", "residual_seed", "coarse")
        return {
            name: value
            for name, value in document.items()
            if name not in later or value != getattr(NOMINAL_OPTICS, name)
        }


_LETTERS = {
    "d": "defocus_nm", "j": "jitter", "c": "colour", "r": "residual", "s": "residual_seed", "k": "coarse"
}  # fmt: skip
OpticsChoice = Annotated[
    Annotated[Optics, Tag(OBJECT_TAG)]
    | Annotated[tuple[Optics, ...], Field(min_length=1, max_length=100), Tag(LIST_TAG)],
    Discriminator(one_or_list),
]
"""One way in which the PSF is spoilt, or several."""
NOMINAL_OPTICS = Optics()
