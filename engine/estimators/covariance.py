"""``covariance``: least squares on the drawn source map, weighted by the posterior covariance of the source.

|R (s - s_draw)|^2 with R^T R = A the inverse of that covariance given the lens.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas

from engine.conventions import FloatArray
from engine.estimators.draws import SourceDraw
from engine.estimators.least_squares import NormalEquations
from engine.estimators.source_plane import stacked
from engine.light.cell_means import columns_on_grid


class CovarianceMetric:
    """The drawn maps in units of their own posterior noise."""

    def __init__(self, draws: Sequence[SourceDraw]) -> None:
        self._edges = [(draw.grid.x_edges, draw.grid.y_edges) for draw in draws]
        self._factors = [np.asfortranarray(draw.precision_factor) for draw in draws]
        self._targets = [
            blas.dtrmv(factor, draw.drawn.ravel(), lower=0) for factor, draw in zip(self._factors, draws, strict=True)
        ]

    def normal_equations(self, which: NDArray[np.intp], shapes: FloatArray) -> NormalEquations:
        """See :class:`~.least_squares.Metric`."""
        found = []
        for k, shape in zip(which, shapes, strict=True):
            columns = np.asfortranarray(columns_on_grid(shape, *self._edges[k]))
            white = blas.dtrmm(1.0, self._factors[k], columns, lower=0, overwrite_b=1)
            found.append((white.T @ white, white.T @ self._targets[k], 1.0))
        return stacked(found)
