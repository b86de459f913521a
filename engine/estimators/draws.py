"""What the estimators are given: draws of lens and source, in terms of surface brightness at the nodes of a grid.

:func:`source_draw` is the one place that knows how the inversion describes its source.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from engine.conventions import FloatArray
from engine.lensing.power_law import PowerLawLens
from engine.light.cell_means import MAX_ELLIPTICITY
from engine.likelihood.evidence import Inversion
from engine.source.grid import SourceGrid

_SMALLEST_RADIUS = 0.1
"""Bound of r_eff in units of the smallest node spacing."""
_LARGEST_RADIUS = 5.0
"""Bound of r_eff in units of the longer side of the grid."""


@dataclass(frozen=True)
class SourceDraw:
    """One draw of lens and source.

    Attributes
    ----------
    lens : PowerLawLens
        At a state of the chain.
    grid : SourceGrid
        N = ny nx nodes.
    mean, drawn : array (ny, nx)
        Source of highest posterior at that state, and a draw from its posterior [e-/s arcsec^-2].
    precision_factor : array (N, N)
        Upper triangular R with R^T R the inverse covariance of the source given lens and data; its lower triangle is
        not used.
    curvature, data_vector : arrays (N, N), (N,)
        F and D: the image-plane chi^2 of a source s is s^T F s - 2 s^T D and a constant, amplitudes marginalised.
    """

    lens: PowerLawLens
    grid: SourceGrid
    mean: FloatArray
    drawn: FloatArray
    precision_factor: FloatArray
    curvature: FloatArray
    data_vector: FloatArray

    def bounds(self, index_range: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest shape parameters (6,): the centre on the grid, n in ``index_range``."""
        left, right, bottom, top = self.grid.extent
        e = MAX_ELLIPTICITY
        pitch = math.sqrt(float(self.grid.cell_areas.min()))
        side = max(right - left, top - bottom)
        low = [math.log(_SMALLEST_RADIUS * pitch), index_range[0], -e, -e, left, bottom]
        high = [math.log(_LARGEST_RADIUS * side), index_range[1], e, e, right, top]
        return np.array(low), np.array(high)


def source_draw(inversion: Inversion, lens: PowerLawLens, rng: np.random.Generator) -> SourceDraw:
    """A draw of the source from the inversion at a state of the chain."""
    return SourceDraw(
        lens=lens,
        grid=inversion.grid,
        mean=inversion.source,
        drawn=inversion.draw_source(rng),
        precision_factor=inversion.factor,
        curvature=inversion.curvature,
        data_vector=inversion.data_vector,
    )
