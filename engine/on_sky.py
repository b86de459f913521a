"""Answers on the sky: what a fit says in the frame of its image, turned by how the image stands."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from astropy import units
from astropy.coordinates import SkyCoord

from engine.conventions import Orientation
from engine.imaging.observation import Observation
from engine.result import Estimate, Quantity


def turned(estimate: Estimate, orientation: Orientation) -> Estimate:
    """An estimate whose position angle was told as if North were up and East to the left."""
    found = estimate.position_angle
    angle = orientation.position_angle(math.radians(found.mean + 90.0))
    # Zero and 180 degrees are the same axis: what is turned by nothing stays as it was.
    if abs(math.remainder(angle - found.mean, 180.0)) < 1e-9:
        return estimate
    return replace(estimate, position_angle=replace(found, mean=angle))


def lens_on_sky(lens: Mapping[str, Quantity], orientation: Orientation) -> dict[str, Quantity]:
    """Position angle [deg East of North], place (East, North) [arcsec from the middle] and shear of a lens.

    ``lens`` has phi, x, y, and gamma1 and gamma2 where there is shear, in the image frame. Errors of x and y are taken
    for equal and independent, as those of the components of the shear.
    """
    east, north = orientation.on_sky(lens["x"].mean, lens["y"].mean)
    place_sd = math.hypot(lens["x"].sd, lens["y"].sd) / math.sqrt(2.0)
    out = {
        "position_angle": Quantity(orientation.position_angle(lens["phi"].mean), math.degrees(lens["phi"].sd)),
        "east": Quantity(east, place_sd),
        "north": Quantity(north, place_sd),
    }
    if "gamma1" in lens:
        one, two = lens["gamma1"], lens["gamma2"]
        strength, sd = math.hypot(one.mean, two.mean), math.hypot(one.sd, two.sd) / math.sqrt(2.0)
        angle = orientation.position_angle(0.5 * math.atan2(two.mean, one.mean))
        out["shear"] = Quantity(strength, sd)
        # Beyond half a turn an angle says nothing.
        out["shear_position_angle"] = Quantity(angle, min(90.0, math.degrees(0.5 * sd / max(strength, 1e-9))))
    return out


def places_on_sky(positions: Sequence[tuple[float, float]], observation: Observation) -> list[dict[str, Any]]:
    """East and North [arcsec from the middle] of image-frame positions [arcsec]; RA and Dec [deg] where known."""
    out = []
    middle = None if observation.centre is None else SkyCoord(*observation.centre, unit=units.deg)
    for x, y in positions:
        east, north = observation.orientation.on_sky(x, y)
        place: dict[str, Any] = {"east": east, "north": north, "ra": None, "dec": None}
        if middle is not None:
            there = middle.spherical_offsets_by(east * units.arcsec, north * units.arcsec)
            place |= {"ra": float(there.ra.deg), "dec": float(there.dec.deg)}
        out.append(place)
    return out


def orientation_document(orientation: Orientation) -> dict[str, Any]:
    """How an image stands: degrees from up to North, counter-clockwise, and on which side of it East is."""
    return {
        "north": math.remainder(math.degrees(orientation.north) - 90.0, 360.0),
        "east": "right of North" if orientation.mirrored else "left of North",
    }
