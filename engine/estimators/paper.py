"""``paper``: unweighted least squares on the drawn source map, as GALFIT does without a sigma image."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from engine.conventions import FloatArray
from engine.estimators.draws import SourceDraw
from engine.estimators.least_squares import NormalEquations
from engine.estimators.source_plane import rest_per_point, stacked
from engine.light.cell_means import columns_on_grid


class PaperMetric:
    """Every part of the source plane counts alike: cells weigh by their areas."""

    def __init__(self, draws: Sequence[SourceDraw], maps: Sequence[FloatArray]) -> None:
        self._edges = [(draw.grid.x_edges, draw.grid.y_edges) for draw in draws]
        self._weights = [(draw.grid.cell_areas / draw.grid.cell_areas.mean()).ravel() for draw in draws]
        self._maps = [values.ravel() for values in maps]

    def normal_equations(self, which: NDArray[np.intp], shapes: FloatArray) -> NormalEquations:
        """See :class:`~.least_squares.Metric`."""
        found = []
        for k, shape in zip(which, shapes, strict=True):
            columns = columns_on_grid(shape, *self._edges[k])
            weighted = columns * self._weights[k][:, None]
            gram, right = weighted.T @ columns, weighted.T @ self._maps[k]
            norm = float((self._weights[k] * self._maps[k]) @ self._maps[k])
            found.append((gram, right, rest_per_point(gram, right, norm, self._maps[k].size)))
        return stacked(found)
