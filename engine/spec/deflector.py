"""What a deflector has beside the profile of its system and the power law of its mass model."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from engine.spec.host import Label
from engine.spec.light import SersicLight
from engine.spec.quantities import STRICT, UNSIGNED, Angle, AxisRatio, Number, Position

USUAL_DEFLECTOR = "plain"
"""Label of a deflector that has nothing more."""


@dataclass(frozen=True, config=STRICT)
class MassMultipole:
    """Departure of the mass from ellipses: isodensity contours move by ``amplitude`` times their radius.

    ``m`` = 3 is lopsided, 4 discy (amplitude above zero at the mass's position angle) or boxy (below).
    ``position_angle`` [deg] is where it is greatest; the mass model's where None.
    """

    m: Literal[3, 4]
    amplitude: Annotated[Number, Field(ge=-0.2, le=0.2), UNSIGNED]
    position_angle: Angle | None = None


@dataclass(frozen=True, config=STRICT)
class MassSatellite:
    """A singular isothermal satellite beside the lens: theta_E [arcsec, intermediate axis] and position [arcsec]."""

    theta_E: Annotated[Number, Field(ge=0.001, le=2.0)]
    position: Position
    q: AxisRatio = 1.0
    position_angle: Angle = 0.0


@dataclass(frozen=True, config=STRICT)
class Deflector:
    """Light and mass beside the system's own; ``name`` is what results are told apart by, of its own where None.

    ``light`` are profiles beside the system's, of a second component or of a satellite. The source moves by what the
    ``satellites`` deflect at the centre of the lens, so that the images stay about where they were observed.
    """

    light: Annotated[tuple[SersicLight, ...], Field(max_length=4)] = ()
    multipoles: Annotated[tuple[MassMultipole, ...], Field(max_length=4)] = ()
    satellites: Annotated[tuple[MassSatellite, ...], Field(max_length=4)] = ()
    name: Label | None = None

    @property
    def is_plain(self) -> bool:
        """Whether it has nothing beside the system's own."""
        return not (self.light or self.multipoles or self.satellites)

    @property
    def label(self) -> str:
        """What results are told apart by: its name, else what it has."""
        if self.name is not None:
            return self.name
        parts = [f"light{len(self.light)}"] if self.light else []
        parts += [f"m{one.m}" for one in self.multipoles]
        parts += [f"satellite{len(self.satellites)}"] if self.satellites else []
        return "+".join(parts) or USUAL_DEFLECTOR
