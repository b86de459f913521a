"""What the metrics in the source plane have in common."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from engine.conventions import FloatArray
from engine.estimators.least_squares import NormalEquations

_ROUNDING = 1e-12
"""Part of the map's own square below which no residual is told from rounding."""


def rest_per_point(gram: FloatArray, right: FloatArray, norm: float, points: int) -> float:
    """Mean squared residual of the best flux: the scatter of a map whose noise is not known otherwise."""
    explained = float(right[-1] ** 2 / gram[-1, -1]) if gram[-1, -1] > 0 else 0.0
    return max((norm - explained) / points, _ROUNDING * norm)


def stacked(found: Sequence[tuple[FloatArray, FloatArray, float]]) -> NormalEquations:
    """Normal equations of several draws as one."""
    grams, rights, units = zip(*found, strict=True)
    return NormalEquations(np.array(grams), np.array(rights), np.array(units))
