"""A first lens from the positions of the AGN images alone: the isothermal ellipsoid that maps them closest together."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.optimize import least_squares

from engine.conventions import FloatArray, axis_ratio_and_angle
from engine.errors import PosteriorError
from engine.lensing.power_law import PowerLawLens, magnification, source_position

_AXIS_RATIO_PRIOR = (0.8, 0.15)
_START_ANGLES = 6


def lens_from_positions(
    positions: Sequence[tuple[float, float]], slope: float = 2.0, centre: tuple[float, float] = (0.0, 0.0)
) -> tuple[PowerLawLens, FloatArray, float]:
    """An elliptical power law of fixed slope about ``centre`` that brings the images together in the source plane.

    The misfit is the scatter of the mapped images, weighted by the square root of their magnification so that it
    measures distances in the image plane; a weak prior on q keeps doubles, which have fewer constraints than
    parameters, from extreme shapes. The best of several starting angles is returned with its source position (2,)
    and its misfit [arcsec rms].

    Raises
    ------
    PosteriorError
        Fewer than two images.
    """
    if len(positions) < 2:
        raise PosteriorError(f"agn: {len(positions)} images, at least two are needed to start a lens from")
    x, y = (np.array(positions) - np.array(centre)).T
    radius = float(np.mean(np.hypot(x, y)))

    def lens_of(values: FloatArray) -> PowerLawLens:
        theta_E, e1, e2 = map(float, values[:3])
        return PowerLawLens(theta_E, *axis_ratio_and_angle(e1, e2), slope)

    def misfit(values: FloatArray) -> FloatArray:
        lens = lens_of(values)
        bx, by = source_position(lens, x, y)
        stretch = np.sqrt(np.minimum(np.abs(magnification(lens, x, y)), 100.0))
        prior = (lens.q - _AXIS_RATIO_PRIOR[0]) / _AXIS_RATIO_PRIOR[1]
        return np.concatenate([(bx - values[3]) * stretch, (by - values[4]) * stretch, [0.003 * prior]])

    best = None
    for k in range(_START_ANGLES):
        angle = math.pi * k / _START_ANGLES
        start = np.array([radius, 0.1 * math.cos(2 * angle), 0.1 * math.sin(2 * angle), x.mean() / 2, y.mean() / 2])
        low = [0.3 * radius, -0.55, -0.55, -radius, -radius]
        high = [2.0 * radius, 0.55, 0.55, radius, radius]
        fit = least_squares(misfit, np.clip(start, np.array(low) * 0.99, np.array(high) * 0.99), bounds=(low, high))
        if best is None or fit.cost < best.cost:
            best = fit
    if best is None:
        raise PosteriorError("lens: no start")
    misfit_rms = math.sqrt(2.0 * best.cost / len(positions))
    return lens_of(best.x).with_values(x=centre[0], y=centre[1]), best.x[3:] + np.array(centre), misfit_rms
