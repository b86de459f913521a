"""The target: ln evidence of the inversion plus ln prior, as a function of a parameter vector."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from engine.conventions import FloatArray
from engine.errors import InversionError
from engine.inversion.evidence import Inversion, invert, ln_evidence
from engine.inversion.operator import Operator
from engine.inversion.regularisation import SourceModel
from engine.lensing.power_law import PowerLawLens

LENS_NAMES = ("theta_E", "q", "phi", "slope", "x", "y")
SHEAR_NAMES = ("gamma1", "gamma2")
STRENGTH = "ln_lambda"


@dataclass(frozen=True)
class Prior:
    """Flat between ``low`` and ``high`` (arrays in the order of the parameters)."""

    names: tuple[str, ...]
    low: FloatArray
    high: FloatArray

    def holds(self, values: FloatArray) -> bool:
        """Whether the values lie inside."""
        return bool(np.all(values > self.low) and np.all(values < self.high))


def flat_prior(lens: PowerLawLens, ln_lambda: float, *, shear: bool) -> Prior:
    """The prior round a starting lens.

    theta_E within 30 %, q in (0.2, 1), the angle within 90 degrees, slope in (1.3, 2.7), the centre within 0.3
    arcsec, shear components within 0.4, ln lambda within 20 of the start: far wider than any posterior of the study.
    """
    low = [0.7 * lens.theta_E, 0.2, lens.phi - math.pi / 2, 1.3, lens.x - 0.3, lens.y - 0.3]
    high = [1.3 * lens.theta_E, 1.0, lens.phi + math.pi / 2, 2.7, lens.x + 0.3, lens.y + 0.3]
    names: tuple[str, ...] = LENS_NAMES
    if shear:
        names, low, high = names + SHEAR_NAMES, [*low, -0.4, -0.4], [*high, 0.4, 0.4]
    return Prior((*names, STRENGTH), np.array([*low, ln_lambda - 20.0]), np.array([*high, ln_lambda + 20.0]))


@dataclass
class Target:
    """ln posterior up to a constant; counts its evidence evaluations and the inversions that were refused."""

    operator: Operator
    prior: Prior
    source: SourceModel
    evaluations: int = field(default=0, init=False)
    refused: int = field(default=0, init=False)

    def lens(self, values: FloatArray) -> PowerLawLens:
        """The lens of a parameter vector."""
        return PowerLawLens(*map(float, values[:-1]))

    def vector(self, lens: PowerLawLens, ln_lambda: float) -> FloatArray:
        """The parameter vector of a lens."""
        return np.array([*(getattr(lens, name) for name in self.prior.names[:-1]), ln_lambda])

    def __call__(self, values: FloatArray) -> float:
        """Ln Z + ln prior; minus infinity outside the prior, and where the inversion is refused (counted)."""
        if not self.prior.holds(values):
            return -math.inf
        self.evaluations += 1
        try:
            return ln_evidence(self.operator, self.lens(values), float(values[-1]), self.source)
        except InversionError:
            self.refused += 1
            return -math.inf

    def invert(self, values: FloatArray) -> Inversion:
        """The full inversion at a parameter vector."""
        return invert(self.operator, self.lens(values), float(values[-1]), self.source)
