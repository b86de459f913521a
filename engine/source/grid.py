"""The grid of source pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from engine.conventions import FloatArray


@dataclass(frozen=True)
class SourceGrid:
    """Nodes of the source at the crossings of ``x`` (nx,) and ``y`` (ny,) [arcsec], both increasing."""

    x: FloatArray
    y: FloatArray

    @property
    def shape(self) -> tuple[int, int]:
        """(ny, nx)."""
        return self.y.size, self.x.size

    @property
    def x_edges(self) -> FloatArray:
        """Edges (nx + 1,) of the cells round the nodes: half-way to the neighbours."""
        return _edges(self.x)

    @property
    def y_edges(self) -> FloatArray:
        """Edges (ny + 1,) of the cells round the nodes."""
        return _edges(self.y)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Outer edges: left, right, bottom, top [arcsec]."""
        return tuple(map(float, (*self.x_edges[[0, -1]], *self.y_edges[[0, -1]])))  # type: ignore[return-value]

    @property
    def cell_areas(self) -> FloatArray:
        """Areas (ny, nx) of the cells [arcsec^2]."""
        return np.outer(np.diff(self.y_edges), np.diff(self.x_edges))


def _edges(nodes: FloatArray) -> FloatArray:
    middle = 0.5 * (nodes[1:] + nodes[:-1])
    return np.concatenate([[2 * nodes[0] - middle[0]], middle, [2 * nodes[-1] - middle[-1]]])
