"""Where the nodes of the source grid lie along one axis."""

from __future__ import annotations

import math

import numpy as np

from engine.conventions import FloatArray


def spaced_nodes(low: float, high: float, n: int, centre: float, softening: float | None) -> FloatArray:
    """N nodes from low to high: even, or crowded round ``centre``.

    With a softening the spacing is even within that fraction of the half-width and widens beyond it as cosh (the nodes
    are those of sinh).
    """
    if softening is None:
        return np.linspace(low, high, n)
    s = softening * 0.5 * (high - low)
    t = np.linspace(math.asinh((low - centre) / s), math.asinh((high - centre) / s), n)
    nodes = centre + s * np.sinh(t)
    nodes[0], nodes[-1] = low, high
    return np.asarray(nodes)
