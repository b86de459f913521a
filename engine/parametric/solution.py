"""A minimum of the residuals between bounds, and how it is reached."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from engine.conventions import FloatArray
from engine.lensing.power_law import PowerLawLens
from engine.parametric.model import ImageModel
from engine.parametric.parameters import HOST_FLUX, ParameterSpace
from engine.parametric.point_sources import Detection
from engine.parametric.shared_error import ModelError
from engine.parametric.starts import Start

TOLERANCE = 1e-6
"""Relative change of cost or parameters at which a fit of integrated light ends."""
NEAR_STEPS = 15
"""Of a fit that begins next to where another one ended."""
_ROOM = 1e-6
"""How far inside its bounds a fit begins."""


@dataclass(frozen=True)
class Solution:
    """A minimum between bounds: the model it belongs to, its parameters, bounds and cost (chi^2 and priors).

    ``start`` is where the search for it began; ``stamp_error`` is the error of the light of AGN images that its noise
    map holds, in units of what the optics allow for; ``error`` are the errors of the model that it marginalises.
    ``noise`` (ny, nx) is the model's without the error of the arcs, where that has one, ``arc_error`` that part of
    their light: no host is a Sersic profile.
    """

    model: ImageModel
    values: FloatArray
    low: FloatArray
    high: FloatArray
    cost: float
    start: Start
    stamp_error: float = 1.0
    noise: FloatArray | None = None
    arc_error: float = 0.0
    error: ModelError | None = None

    @property
    def space(self) -> ParameterSpace:
        """The space of its parameters."""
        return self.model.space

    @property
    def lens(self) -> PowerLawLens:
        """The lens."""
        return self.space.lens(self.values)

    @property
    def host_flux(self) -> float:
        """Flux of the host [e-/s], of any sign."""
        return float(self.model.amplitudes(self.values)[0][HOST_FLUX])

    @property
    def information(self) -> float:
        """The BIC less what is common to all solutions on one image."""
        return self.cost + 3 * self.space.n_agn * math.log(self.model.pixels)

    @property
    def at_bound(self) -> tuple[str, ...]:
        """Names of the parameters that ended at a bound, of the last fit or of the search as a whole.

        Each fit has its bounds round where it begins, so that a parameter may stray fit by fit: it is told as well
        where it left the bounds round the start of the first.
        """
        space, model = self.space, self.model
        first = self.start.vector(space)
        widest = space.bounds(first, model.observation.pixel_scale, model.priors)
        told = {*space.at_bound(self.values, self.low, self.high), *space.at_bound(self.values, *widest)}
        return tuple(name for name in space.names if name in told)

    def agn(self) -> tuple[Detection, ...]:
        """The AGN images as they are fitted."""
        amplitudes, _, _ = self.model.amplitudes(self.values)
        return tuple(
            Detection(float(x), float(y), float(flux), found.significance)
            for (x, y), flux, found in zip(
                self.space.agn(self.values), amplitudes[: self.space.n_agn], self.start.agn, strict=True
            )
        )


def minimise(
    model: ImageModel,
    start: Start,
    values: FloatArray,
    steps: int,
    tolerance: float,
    *,
    stamp_error: float = 1.0,
) -> Solution:
    """Least squares from ``values``, at most ``steps`` of them.

    A PosteriorError tells of a component that puts no light on the image.
    """
    low, high = model.space.bounds(values, model.observation.pixel_scale, model.priors)
    fit = least_squares(
        model.residuals,
        np.clip(values, low + _ROOM, high - _ROOM),
        model.jacobian,
        (low, high),
        x_scale="jac",
        xtol=tolerance,
        ftol=tolerance,
        max_nfev=steps,
    )
    return Solution(model, fit.x, low, high, 2.0 * float(fit.cost), start, stamp_error)


def minimise_held(solution: Solution, values: FloatArray, at: int, held: float) -> Solution:
    """The minimum with parameter ``at`` held, from other values of the rest."""
    model = solution.model
    low, high = (np.delete(side, at) for side in (solution.low, solution.high))

    def whole(free: FloatArray) -> FloatArray:
        return np.insert(free, at, held)

    fit = least_squares(
        lambda free: model.residuals(whole(free)),
        np.clip(np.delete(values, at), low + _ROOM, high - _ROOM),
        lambda free: np.delete(model.jacobian(whole(free)), at, axis=1),
        (low, high),
        x_scale="jac",
        xtol=TOLERANCE,
        ftol=TOLERANCE,
        max_nfev=NEAR_STEPS,
    )
    return replace(solution, values=whole(fit.x), cost=2.0 * float(fit.cost))
