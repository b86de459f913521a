"""What is known of the parameters besides the image: priors, and that the AGN images come from the host's centre."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from engine.conventions import FloatArray
from engine.lensing.power_law import source_position
from engine.parametric.parameters import ParameterSpace, own_parameter
from engine.spec.priors import LensParameterName, ParameterPrior

POSITION_ERROR = 0.01
"""Image-plane accuracy [arcsec] asked of the AGN images as images of one source."""


@dataclass(frozen=True)
class LensPriors:
    """Mean and standard deviation of the slope; deviations of shear, (e1, e2) and offset from the light [arcsec]."""

    slope: tuple[float, float]
    shear: float
    ellipticity: float
    centre: float

    @property
    def told(self) -> dict[str, float]:
        """By name, for a document."""
        return {
            "slope": self.slope[0],
            "slope_sd": self.slope[1],
            "shear_sd": self.shear,
            "ellipticity_sd": self.ellipticity,
            "centre_sd": self.centre,
        }


WIDE = LensPriors(slope=(2.0, 0.3), shear=0.15, ellipticity=0.25, centre=0.1)
"""Ellipticity about none; offset from the deflector's light, or from the middle of the frame where it has none."""
GALAXY = LensPriors(slope=(2.05, 0.16), shear=0.05, ellipticity=0.1, centre=0.03)
"""Behind a galaxy that is more than one profile: ellipticity about that of its light.

Arcs that no Sersic profile describes would take the lens anywhere. Elliptical lenses have a slope of 2.08 +- 0.16
(Auger et al. 2010), and their mass follows their light (Koopmans et al. 2006, Bolton et al. 2008).
"""
HOST_RADII = (0.5, 0.25)
"""Einstein radii from which on a host is too large to be one behind a bright galaxy, and error of its logarithm.

Without it the host describes what is left of the galaxy's wings.
"""
_BOUND_ERROR = 1e-3
"""How far q or phi may stray beyond a bound that is asked for, which is no bound of an ellipticity."""


def constraints(
    space: ParameterSpace, values: FloatArray, priors: Mapping[LensParameterName, ParameterPrior]
) -> FloatArray:
    """Departures from the priors, each in its own error; last the AGN images in the source plane about the host."""
    lens, host = values[space.lens_slice], values[space.host_slice]
    known = WIDE if space.light is None else GALAXY
    slope_free = "slope" not in priors or priors["slope"].mean is None
    out: list[FloatArray] = [
        _misfits(space, values, priors),
        _ellipticity(space, lens[1:3]),
        (lens[3:4] - known.slope[0]) / (known.slope[1] if slope_free else math.inf),
        (lens[4:6] - _centre(space, values)) / known.centre,
        lens[6:8] / known.shear,
    ]
    if space.light is not None:
        out.append(np.maximum(host[:1] - math.log(HOST_RADII[0] * lens[0]), 0.0) / HOST_RADII[1])
    if space.n_agn:
        bx, by = source_position(space.lens(values), *space.agn(values).T)
        out += [(bx - host[4]) / POSITION_ERROR, (by - host[5]) / POSITION_ERROR]
    return np.concatenate(out)


def _ellipticity(space: ParameterSpace, found: FloatArray) -> FloatArray:
    if space.light is None:
        return np.asarray(found / WIDE.ellipticity)
    return np.asarray((found - np.array(space.light.ellipticity)) / GALAXY.ellipticity)


def _centre(space: ParameterSpace, values: FloatArray) -> FloatArray:
    """Where the deflector shines [arcsec]; the middle of the frame where it does not."""
    if space.deflector:
        return values[space.deflector_slice][4:6]
    return np.array(space.middle if space.light is None else space.light.centre)


def worst_miss(space: ParameterSpace, values: FloatArray) -> float:
    """Farthest along an axis [arcsec] that an AGN image maps from the host; zero without AGN images."""
    if not space.n_agn:
        return 0.0
    return POSITION_ERROR * float(np.abs(constraints(space, values, {})[-2 * space.n_agn :]).max())


def _misfits(
    space: ParameterSpace, values: FloatArray, priors: Mapping[LensParameterName, ParameterPrior]
) -> FloatArray:
    """Departures from priors that are asked for in their deviations, of q and phi from bounds in _BOUND_ERROR."""
    out: list[float] = []
    lens = space.lens(values)
    for name, prior in priors.items():
        if name not in space.lens_names:
            continue
        value = float(getattr(lens, name))
        for bound, side in ((prior.low, -1.0), (prior.high, 1.0)):
            if bound is not None and not own_parameter(name):
                out.append(max(side * _away(name, value, bound), 0.0) / _BOUND_ERROR)
        if prior.mean is not None and prior.sd is not None:
            out.append(_away(name, value, prior.mean) / prior.sd)
    return np.array(out)


def _away(name: LensParameterName, value: float, other: float) -> float:
    """Difference of two values of a parameter; an angle has the period pi."""
    return math.remainder(value - other, math.pi) if name == "phi" else value - other
