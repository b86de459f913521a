"""What is known of the parameters besides the image: priors, and that the AGN images come from the host's centre."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from engine.conventions import FloatArray
from engine.lensing.power_law import source_position
from engine.parametric.parameters import ParameterSpace, own_parameter
from engine.spec.priors import LensParameterName, ParameterPrior

POSITION_ERROR = 0.01
"""Image-plane accuracy [arcsec] asked of the AGN images as images of one source."""
SLOPE_PRIOR = (2.0, 0.3)
"""Mean and standard deviation; elliptical lenses have 2.08 +- 0.16 (Auger et al. 2010)."""
SHEAR_PRIOR = 0.15
ELLIPTICITY_PRIOR = 0.25
CENTRE_PRIOR = 0.1
"""Offset [arcsec] of the lens from the deflector's light, or from the frame where it has none."""
_BOUND_ERROR = 1e-3
"""How far q or phi may stray beyond a bound that is asked for, which is no bound of an ellipticity."""


def constraints(
    space: ParameterSpace, values: FloatArray, priors: Mapping[LensParameterName, ParameterPrior]
) -> FloatArray:
    """Departures from the priors, each in its own error; last the AGN images in the source plane about the host."""
    lens, host = values[space.lens_slice], values[space.host_slice]
    slope_free = "slope" not in priors or priors["slope"].mean is None
    out: list[FloatArray] = [
        _misfits(space, values, priors),
        lens[1:3] / ELLIPTICITY_PRIOR,
        (lens[3:4] - SLOPE_PRIOR[0]) / (SLOPE_PRIOR[1] if slope_free else math.inf),
        (lens[4:6] - (values[space.deflector_slice][4:6] if space.deflector else 0.0)) / CENTRE_PRIOR,
        lens[6:8] / SHEAR_PRIOR,
    ]
    if space.n_agn:
        bx, by = source_position(space.lens(values), *space.agn(values).T)
        out += [(bx - host[4]) / POSITION_ERROR, (by - host[5]) / POSITION_ERROR]
    return np.concatenate(out)


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
