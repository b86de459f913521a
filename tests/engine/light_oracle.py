"""What a rendering promises, and a source on a fold; pixel fluxes made in other ways are in engine.accuracy."""

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from engine.lensing.power_law import PowerLawLens, convergence_and_shear, source_position
from engine.light.rendering import DEFAULT_TOLERANCE

HE0435 = PowerLawLens(1.2171, 0.85, 1.29, 2.0)
GRID = (np.arange(41) - 20) * 0.08
ORACLE = 2e-5
"""What the graded oracle is good to, as a fraction of the peak (it differs so much from itself on a finer mesh)."""


def assert_as_promised(ours: np.ndarray, reference: np.ndarray, tolerance: float = DEFAULT_TOLERANCE) -> None:
    """The tolerance holds for the worst pixel as a fraction of the peak, and for the flux; no pixel is negative."""
    assert np.isfinite(ours).all()
    assert ours.min() >= 0.0
    assert np.abs(ours - reference).max() <= (tolerance + ORACLE) * reference.max()
    assert ours.sum() == pytest.approx(reference.sum(), rel=tolerance)


def fold(lens: PowerLawLens, angle: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """The outermost critical point in a direction from the lens, and its source position."""

    def at(r: float) -> tuple[np.ndarray, np.ndarray]:
        return np.array([lens.x + r * math.cos(angle)]), np.array([lens.y + r * math.sin(angle)])

    def determinant(r: float) -> float:
        kappa, gamma1, gamma2 = convergence_and_shear(lens, *at(r))
        return float(((1 - kappa) ** 2 - gamma1**2 - gamma2**2)[0])

    radii = np.linspace(3.0, 0.2, 300)
    signs = np.sign([determinant(r) for r in radii])
    k = int(np.flatnonzero(signs[1:] != signs[:-1])[0])
    point = at(brentq(determinant, radii[k + 1], radii[k], xtol=1e-15))
    source = source_position(lens, *point)
    return (point[0].item(), point[1].item()), (source[0].item(), source[1].item())
