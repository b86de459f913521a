"""``projected``: the Sersic on the source grid with the least image-plane chi^2, s^T F s - 2 s^T D and a constant.

The regularisation has no say in it. What the grid cannot represent, above all the cusp, it cannot fit.
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


class ProjectedMetric:
    """The data as the source grid sees them."""

    def __init__(self, draws: Sequence[SourceDraw]) -> None:
        self._edges = [(draw.grid.x_edges, draw.grid.y_edges) for draw in draws]
        self._curvatures = [np.asfortranarray(draw.curvature.T) for draw in draws]
        self._data = [draw.data_vector for draw in draws]

    def normal_equations(self, which: NDArray[np.intp], shapes: FloatArray) -> NormalEquations:
        """See :class:`~.least_squares.Metric`."""
        found = []
        for k, shape in zip(which, shapes, strict=True):
            columns = columns_on_grid(shape, *self._edges[k])
            seen = blas.dsymm(1.0, self._curvatures[k], np.asfortranarray(columns))
            found.append((columns.T @ seen, columns.T @ self._data[k], 1.0))
        return stacked(found)
