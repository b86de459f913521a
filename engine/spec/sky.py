"""What stands in the sky: lens systems as they were observed."""

from __future__ import annotations

from typing import Annotated

from pydantic import Discriminator, Field, Tag, model_validator
from pydantic.dataclasses import dataclass

from engine.errors import SpecError
from engine.spec.instrument import CameraChoice, ExposurePlan
from engine.spec.light import SersicLight
from engine.spec.priors import Priors
from engine.spec.quantities import (
    STRICT,
    UNSIGNED,
    Angle,
    AxisRatio,
    Identifier,
    Magnitude,
    Number,
    Position,
    Shear,
    SlopeKey,
)
from engine.spec.validation import NAME_TAG, OBJECT_TAG, PRINTABLE, field_path, name_or_object

RightAscension = Annotated[Number, Field(ge=0.0, lt=360.0), UNSIGNED]
Declination = Annotated[Number, Field(ge=-90.0, le=90.0), UNSIGNED]
_SLOPE_TOLERANCE = 1e-9


@dataclass(frozen=True, config=STRICT)
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


@dataclass(frozen=True, config=STRICT)
class AgnImage:
    """One image of the AGN: its name, its observed position [arcsec] and its AB magnitude."""

    name: Annotated[str, Field(min_length=1, max_length=8, pattern=PRINTABLE)]
    position: Position
    magnitude: Magnitude


@dataclass(frozen=True, config=STRICT)
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
