"""The runs that a grid means, as they are handed to whoever stores them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

IMAGE = "image"
"""Kind of a run that measures an uploaded image."""

OPTICS_AXES = {"defocus_nm": 0.0, "jitter": 0.0, "colour": 0.0, "residual": 0.0, "coarse": 1}
"""What answers are grouped by of how a PSF is spoilt, and what it is where nothing is."""


class Kind(NamedTuple):
    """What the time that a run takes depends on most."""

    camera: str
    configuration: str
    profile: str | None


@dataclass(frozen=True)
class PlannedRun:
    """One run of a grid that is about to be stored."""

    label: str
    paper_run: int | None
    spec: dict[str, Any]
    inputs: dict[str, Any]
    digest: str
    kind: str = "realization"


class Plan(Protocol):
    """Runs whose number is known, made as they are asked for, the same each time."""

    def __len__(self) -> int:
        """How many there are."""

    def __iter__(self) -> Iterator[PlannedRun]:
        """Begin with the first."""
