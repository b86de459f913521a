"""Light profiles of a specification."""

from __future__ import annotations

from pydantic.dataclasses import dataclass

from engine.spec.quantities import STRICT, Angle, AxisRatio, Magnitude, Position, Radius, SersicIndex


@dataclass(frozen=True, config=STRICT)
class SersicLight:
    """A Sersic profile: total AB magnitude, r_eff [arcsec, intermediate axis], index, axis ratio, position angle."""

    magnitude: Magnitude
    r_eff: Radius
    n: SersicIndex
    q: AxisRatio
    position_angle: Angle
    centre: Position = (0.0, 0.0)
