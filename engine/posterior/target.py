"""The target: ln evidence of the inversion plus ln prior, as a function of a parameter vector."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from engine.conventions import FloatArray
from engine.errors import InversionError, SpecError
from engine.lensing.power_law import PowerLawLens
from engine.likelihood.amplitudes import MarginalLikelihood
from engine.likelihood.evidence import Inversion, invert, ln_evidences
from engine.parametric.parameters import LENS, SHEAR, SHEAR_RANGE, SLOPE_RANGE
from engine.posterior.agn_positions import AgnPositions
from engine.source.regularisation import SourceModel
from engine.spec.priors import LensParameterName, ParameterPrior

STRENGTH = "ln_lambda"


# What the lens model can be at all; priors that are asked for end here.
_LIMITS = {
    "theta_E": (1e-3, math.inf),
    "q": (0.05, 1.0),
    "slope": (1.2, 2.8),
    "gamma1": (-0.7, 0.7),
    "gamma2": (-0.7, 0.7),
}
_START_MARGIN = 0.02
"""How far inside the prior a start is moved, in units of its width."""

_STEP_SHARE = 0.1


@dataclass(frozen=True)
class Prior:
    """Flat between bounds, times a Gaussian where ``sd`` is finite; arrays (d,) in the order of the parameters."""

    names: tuple[str, ...]
    low: FloatArray
    high: FloatArray
    mean: FloatArray
    sd: FloatArray

    @classmethod
    def flat(cls, names: tuple[str, ...], low: FloatArray, high: FloatArray) -> Prior:
        """Flat in every parameter."""
        return cls(names, low, high, np.zeros_like(low), np.full_like(low, math.inf))

    def holds(self, values: FloatArray) -> bool:
        """Whether the values lie inside."""
        return bool(np.all(values > self.low) and np.all(values < self.high))

    def ln_density(self, values: FloatArray) -> float:
        """Ln of the prior inside its bounds, up to a constant."""
        return float(-0.5 * (((values - self.mean) / self.sd) ** 2).sum())

    def inside(self, values: FloatArray) -> FloatArray:
        """The values, moved inside where they are not."""
        margin = _START_MARGIN * (self.high - self.low)
        return np.asarray(np.clip(values, self.low + margin, self.high - margin))

    def no_wider(self, covariance: FloatArray) -> FloatArray:
        """A covariance (d, d) shrunk where it is wider than the prior, so that steps of one deviation stay inside."""
        sd = np.sqrt(np.diag(covariance))
        shrunk = np.minimum(1.0, np.minimum(_STEP_SHARE * (self.high - self.low), self.sd) / sd)
        return np.asarray(covariance * np.outer(shrunk, shrunk))

    def restricted(self, priors: Mapping[LensParameterName, ParameterPrior]) -> Prior:
        """The same with the prior of some parameters replaced; an angle is taken modulo pi, nearest to the middle.

        Raises
        ------
        SpecError
            A parameter is not one of these, or nothing is left between its bounds.
        """
        low, high, mean, sd = (array.copy() for array in (self.low, self.high, self.mean, self.sd))
        for name, prior in priors.items():
            if name not in self.names:
                raise SpecError("priors", name, f"one of {', '.join(self.names)} for this lens model")
            k = self.names.index(name)
            middle = 0.5 * (self.low[k] + self.high[k])
            given = [value for value in (prior.low, prior.high) if value is not None]
            turn = _turns(prior.mean if prior.mean is not None else sum(given) / len(given), middle, name)
            least, most = _LIMITS.get(name, (-math.inf, math.inf))
            low[k] = max(self.low[k] if prior.low is None else prior.low + turn, least)
            high[k] = min(self.high[k] if prior.high is None else prior.high + turn, most)
            if prior.mean is not None and prior.sd is not None:
                mean[k], sd[k] = prior.mean + turn, prior.sd
            if not low[k] < high[k]:
                raise SpecError(f"priors.{name}", (float(low[k]), float(high[k])), "bounds with something between them")
        return Prior(self.names, low, high, mean, sd)


def _turns(value: float, middle: float, name: str) -> float:
    """What brings an angle within half a turn of the middle; nothing for other parameters."""
    return middle + math.remainder(value - middle, math.pi) - value if name == "phi" else 0.0


LN_LAMBDA_RANGE = (-30.0, 10.0)
"""ln lambda [lambda has the units of the source's inverse square] strays that far in no scene."""


def wide_prior(lens: PowerLawLens, *, shear: bool) -> Prior:
    """The prior round a starting lens where nothing else is asked for.

    theta_E within 30 %, q in (0.2, 1), the angle within 90 degrees, slope in (1.3, 2.7), the centre within 0.3
    arcsec, shear components within 0.4, ln lambda in (-30, 10): far wider than any posterior of the study.
    """
    sides = [(0.7 * lens.theta_E, 1.3 * lens.theta_E), (0.2, 1.0), (lens.phi - math.pi / 2, lens.phi + math.pi / 2)]
    sides += [SLOPE_RANGE, (lens.x - 0.3, lens.x + 0.3), (lens.y - 0.3, lens.y + 0.3)]
    sides += [SHEAR_RANGE, SHEAR_RANGE] if shear else []
    low, high = np.array([*sides, LN_LAMBDA_RANGE]).T
    return Prior.flat((*LENS, *(SHEAR if shear else ()), STRENGTH), low, high)


@dataclass
class Target:
    """ln posterior up to a constant; counts its evidence evaluations and the inversions that were refused.

    With ``agn``, the positions of the AGN images are data too.
    """

    likelihood: MarginalLikelihood
    prior: Prior
    source: SourceModel
    agn: AgnPositions | None = None
    evaluations: int = field(default=0, init=False)
    refused: int = field(default=0, init=False)

    def lens(self, values: FloatArray) -> PowerLawLens:
        """The lens of a parameter vector."""
        return PowerLawLens(*map(float, values[:-1]))

    def vector(self, lens: PowerLawLens, ln_lambda: float) -> FloatArray:
        """The parameter vector of a lens."""
        return np.array([*(getattr(lens, name) for name in self.prior.names[:-1]), ln_lambda])

    def __call__(self, values: FloatArray) -> float:
        """Ln Z + ln prior, and that of the AGN positions; minus infinity outside, or if refused (counted)."""
        return float(self.many(values[None, :])[0])

    def many(self, places: FloatArray) -> FloatArray:
        """The same (n,) at places (n, d), which costs less than one by one."""
        out = np.full(len(places), -math.inf)
        inside = [k for k, values in enumerate(places) if self.prior.holds(values)]
        self.evaluations += len(inside)
        lenses = [self.lens(places[k]) for k in inside]
        found = ln_evidences(self.likelihood, lenses, [float(places[k, -1]) for k in inside], self.source)
        for k, lens, ln_z in zip(inside, lenses, found, strict=True):
            if isinstance(ln_z, InversionError):
                self.refused += 1
                continue
            agn = 0.0 if self.agn is None else self.agn.ln_likelihood(lens)
            out[k] = self.prior.ln_density(places[k]) + agn + ln_z
        return out

    def invert(self, values: FloatArray) -> Inversion:
        """The full inversion at a parameter vector."""
        return invert(self.likelihood, self.lens(values), float(values[-1]), self.source)


@dataclass
class Recorded:
    """A target that remembers where it was evaluated and what it was there, minus infinity left out."""

    target: Callable[[FloatArray], float]
    points: list[FloatArray] = field(default_factory=list)
    values: list[float] = field(default_factory=list)

    def __call__(self, values: FloatArray) -> float:
        """Ln of the target."""
        found = self.target(values)
        self.remember(values, found)
        return found

    def many(self, places: FloatArray) -> FloatArray:
        """Ln of the target (n,) at places (n, d)."""
        if isinstance(self.target, Target):
            found = self.target.many(places)
        else:
            found = np.array([self.target(values) for values in places])
        for values, ln in zip(places, found, strict=True):
            self.remember(values, float(ln))
        return found

    def remember(self, values: FloatArray, found: float) -> None:
        """Take note of ln of the target at a place once more, as of the latest that is known."""
        if math.isfinite(found):
            self.points.append(np.array(values))
            self.values.append(found)

    def latest(self, most: int) -> tuple[FloatArray, FloatArray]:
        """The last points (n, d) and ln of the target (n,) there."""
        return np.array(self.points[-most:]), np.array(self.values[-most:])
