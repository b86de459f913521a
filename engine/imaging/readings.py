"""What was read of an observation, and where it stood: kept in its provenance, told by the command and in the JSON."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

from engine.errors import ObservationError
from engine.imaging.observation import Observation

_FROM = "_from"


@dataclass(frozen=True)
class Reading:
    """A name, its value, and where it was read: a keyword of a plane of a file, an option, or an assumption."""

    name: str
    value: str | float | int
    origin: str


def recorded(readings: Iterable[Reading]) -> dict[str, str | float | int]:
    """As entries of a provenance."""
    out: dict[str, str | float | int] = {}
    for reading in readings:
        out |= {reading.name: reading.value, f"{reading.name}{_FROM}": reading.origin}
    return out


def readings(observation: Observation) -> tuple[Reading, ...]:
    """All that is known of where an observation's parts come from, its scale, zero point and orientation always."""
    record = observation.provenance
    told = [
        Reading(name.removesuffix(_FROM), record[name.removesuffix(_FROM)], str(origin))
        for name, origin in record.items()
        if name.endswith(_FROM) and name.removesuffix(_FROM) in record
    ]
    north = math.degrees(observation.orientation.north) - 90.0
    ny, nx = observation.shape
    always: dict[str, str | float | int] = {
        "image": f"{nx} x {ny} pixels",
        "pixel_scale": observation.pixel_scale,
        "zero_point": observation.zero_point,
        "north": math.remainder(north, 360.0),
        "east": "right of North" if observation.orientation.mirrored else "left of North",
    }
    known = {reading.name for reading in told}
    return (*told, *(Reading(name, value, "as given") for name, value in always.items() if name not in known))


@dataclass
class Findings:
    """Collects what is read, what is odd and what contradicts.

    ``trusting``: what is given overrules the file where the two contradict, with a note; else that is an error.
    """

    trusting: bool
    readings: list[Reading] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def read(self, name: str, value: str | float | int, origin: str) -> None:
        """Something was read."""
        self.readings.append(Reading(name, value, origin))

    def note(self, text: str) -> None:
        """Something is odd."""
        self.notes.append(text)

    def contradict(self, text: str) -> None:
        """Two things exclude each other; an ObservationError unless options are trusted."""
        if not self.trusting:
            raise ObservationError(f"{text}; --trust-options goes on nevertheless")
        self.note(text)
