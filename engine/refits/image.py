"""``image``: the ray-traced Sersic fitted to the data themselves, at the lens of each draw.

chi^2 = f^2 x^T W x - 2 f x^T B^T P d + d^T P d, with x(p) the flux in each image pixel of the ray-traced profile of
unit flux, W = B^T P B, and amplitudes marginalised as in the inversion. There is no source grid, no regularisation.

A pixel's flux is the mean over its rays, which is what the blurring is made for; where a ray's share of the pixel comes
near the centre of the profile, that share is integrated. The share maps to a parallelogram by the lens' Jacobian.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from engine.compiled import kernel
from engine.conventions import FloatArray
from engine.inversion.operator import Operator
from engine.lensing.power_law import PowerLawLens, convergence_and_shear, source_position
from engine.refits.draws import SourceDraw
from engine.refits.least_squares import NormalEquations
from engine.refits.profiles import COLUMNS, add_cell, add_point, new_stack, shape_arguments, shape_of

_CLEARANCE = 6.0
"""Distance of a share from the centre, in units of its size, from which its ray stands for it.

An integral is smoother than rays by the share itself, which shows where the one ends and the other begins. The arc of
HE0435 (n = 4, R_eff = 0.39 arcsec) comes out 0.3-0.4 % too faint with 1.5 to 3, 0.07 % with 6."""


@kernel
def _image_columns(
    x: FloatArray, y: FloatArray, sides: FloatArray, per_pixel: int, weight: float, clearance: float, c: FloatArray
) -> FloatArray:
    """Derivatives and flux (pixels, COLUMNS); ``sides`` (rays, 4) are half the sides of each ray's parallelogram."""
    pixels = x.size // per_pixel
    out = np.empty((pixels, COLUMNS))
    total, stack = np.empty(COLUMNS), new_stack()
    limit = 2.0 * clearance * clearance
    for pixel in range(pixels):
        total[:] = 0.0
        for ray in range(pixel * per_pixel, (pixel + 1) * per_pixel):
            ax, ay, bx, by = sides[ray, 0], sides[ray, 1], sides[ray, 2], sides[ray, 3]
            dx, dy = x[ray] - c[6], y[ray] - c[7]
            if dx * dx + dy * dy > limit * (ax * ax + ay * ay + bx * bx + by * by):
                add_point(x[ray], y[ray], weight, c, total)
            else:
                add_cell(x[ray], y[ray], ax, ay, bx, by, weight, c, total, stack)
        out[pixel] = total
    return out


class RayTracedModel:
    """Rays of an observation at one lens, and images of profiles by them."""

    def __init__(self, operator: Operator, lens: PowerLawLens, defect: FloatArray | None = None) -> None:
        rays = operator.rays
        self._defect = defect
        self._per_pixel = rays.subrays**2
        self._weight = rays.pixel_area / self._per_pixel
        self._x, self._y = source_position(lens, rays.x, rays.y)
        kappa, gamma1, gamma2 = convergence_and_shear(lens, rays.x, rays.y)
        half = 0.5 * np.sqrt(self._weight)
        self._sides = half * np.stack([1.0 - kappa - gamma1, -gamma2, -gamma2, 1.0 - kappa + gamma1], axis=1)

    def columns(self, shape: FloatArray) -> FloatArray:
        """Derivatives and flux (P, COLUMNS) per image pixel, before the PSF, of a profile of unit flux.

        P counts the defect of the blurring too, where one is given.
        """
        columns = _image_columns(
            self._x, self._y, self._sides, self._per_pixel, self._weight, _CLEARANCE, shape_arguments(shape)
        )
        if self._defect is None:
            return np.asarray(columns)
        columns = np.vstack([columns, np.zeros((1, COLUMNS))])
        columns[:, -1] += self._defect
        return columns


def _defect(operator: Operator) -> FloatArray | None:
    """What the columns lack (P,) of the exact image of a host of unit flux like that of the parametric fit.

    The defect column of the blurring is what the plain rays of that host lack; the integrals here differ from them.
    """
    rays = operator.rays
    if rays.envelope is None:
        return None
    host = rays.envelope.host
    integrals = RayTracedModel(operator, rays.envelope.lens).columns(shape_of(host))[:, -1]
    return np.append(rays.of_envelope() / host.flux - integrals, 1.0 / host.flux)


class ImageMetric:
    """The data themselves.

    The curvature by the shape is expensive. It is computed where a single draw is asked for, which the first is, and
    serves for all where several are: it only steers the steps and scales the scatter. Gradients, fluxes and chi^2 are
    each draw's own.
    """

    def __init__(self, operator: Operator, draws: Sequence[SourceDraw]) -> None:
        self._operator = operator
        defect = _defect(operator)
        self._models = [RayTracedModel(operator, draw.lens, defect) for draw in draws]
        self._shared: FloatArray | None = None

    def normal_equations(self, which: NDArray[np.intp], shapes: FloatArray) -> NormalEquations:
        """See :class:`~.least_squares.Metric`."""
        columns = [self._models[k].columns(shape) for k, shape in zip(which, shapes, strict=True)]
        right = np.array([found.T @ self._operator.wd for found in columns])
        units = np.ones(len(columns))
        if self._shared is None or len(columns) == 1:
            wide = self._operator.couple(np.concatenate(columns, axis=1))
            gram = np.array([found.T @ wide[:, COLUMNS * k : COLUMNS * (k + 1)] for k, found in enumerate(columns)])
            self._shared = gram[0]
            return NormalEquations(gram, gram[:, :, -1], right, units)
        weighed = self._operator.couple(np.stack([found[:, -1] for found in columns], axis=1))
        cross = np.array([found.T @ weighed[:, k] for k, found in enumerate(columns)])
        return NormalEquations(np.repeat(self._shared[None], len(columns), axis=0), cross, right, units)
