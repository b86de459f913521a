"""Priors of the parameters of a chain."""

from __future__ import annotations

from typing import Literal

from pydantic import model_validator
from pydantic.dataclasses import dataclass

from engine.errors import SpecError
from engine.spec.quantities import STRICT, Bound, Positive

LensParameterName = Literal["theta_E", "q", "phi", "slope", "x", "y", "gamma1", "gamma2", "ln_lambda"]


@dataclass(frozen=True, config=STRICT)
class ParameterPrior:
    """Prior of one parameter of the chain: flat from ``low`` to ``high``, times a Gaussian of ``mean`` and ``sd``.

    A bound that is None stays where it is by default. Units and frame are those of the result: arcsec, radians, image
    frame of :mod:`engine.conventions`.
    """

    low: Bound | None = None
    high: Bound | None = None
    mean: Bound | None = None
    sd: Positive | None = None

    @model_validator(mode="after")
    def _says_something(self) -> ParameterPrior:
        if (self.mean is None) != (self.sd is None):
            raise SpecError("", (self.mean, self.sd), "mean, sd: both or neither")
        if self.low is None and self.high is None and self.mean is None:
            raise SpecError("", None, "low, high, mean, sd: a bound, or a mean with its sd")
        if self.low is not None and self.high is not None and not self.low < self.high:
            raise SpecError("", (self.low, self.high), "low, high: the lower bound below the upper")
        return self


Priors = dict[LensParameterName, ParameterPrior]
