"""What a code finds in an image."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from engine.conventions import rate_to_magnitude
from engine.lensing.power_law import PowerLawLens
from engine.light.sersic import SersicProfile
from engine.parametric.point_sources import Detection


@dataclass(frozen=True)
class CodeAnswer:
    """The best model of an image by one code.

    ``errors`` are standard deviations by name: ``magnitude``, ``r_eff`` and ``n`` of the host, and of the lens by the
    names of its fields. ``chi2_per_dof`` counts the same pixels with the same noise for each code. ``limits`` say in
    words what the code was not asked to do. ``evaluations`` is how many models were computed.
    """

    code: str
    version: str
    lens: PowerLawLens
    host: SersicProfile
    deflector: SersicProfile | None
    agn: tuple[Detection, ...]
    background: float
    errors: Mapping[str, float]
    chi2_per_dof: float
    zero_point: float
    seconds: float
    evaluations: int
    limits: tuple[str, ...] = ()

    @property
    def magnitude(self) -> float:
        """AB magnitude of the host."""
        return rate_to_magnitude(self.host.flux, self.zero_point)

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready form."""
        return {**asdict(self), "magnitude": self.magnitude, "errors": dict(self.errors)}
