"""The evidence has no jumps where the ray that defines an edge of the source grid changes, or a ray leaves the grid."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest

from engine.lensing.power_law import PowerLawLens, source_position
from engine.likelihood.amplitudes import MarginalLikelihood
from engine.likelihood.evidence import ln_evidence
from engine.likelihood.problem import prepare_problem
from engine.likelihood.strength import find_strength
from engine.simulation.scene import Scene
from engine.simulation.simulate import Simulation
from engine.source.lensing_matrix import RayBundle
from engine.source.regularisation import SourceModel
from engine.spec.analysis import Analysis
from tests.engine.true_fit import true_fit

# A few standard deviations of the posterior of each parameter, where the extreme ray or a crossing is sure to change.
RANGES = {"theta_E": 0.01, "q": 0.03, "phi": 0.05, "slope": 0.05, "x": 0.01, "y": 0.01}
Signature = Callable[[PowerLawLens], bytes]


@dataclass(frozen=True)
class Fitted:
    likelihood: MarginalLikelihood
    lens: PowerLawLens


@pytest.fixture(scope="module")
def fitted(scene: Scene, simulation: Simulation) -> Fitted:
    return Fitted(
        prepare_problem(simulation.observation, true_fit(scene), Analysis(noise_treatment="diagonal")).likelihood,
        scene.lens,
    )


def extremes(rays: RayBundle, lens: PowerLawLens) -> bytes:
    """Which rays of the mask define the four edges."""
    x, y = _traced(rays, lens)
    chosen = np.repeat(rays.in_mask, rays.subrays**2)
    x, y = np.where(chosen, x, x[chosen].mean()), np.where(chosen, y, y[chosen].mean())
    return np.array([x.argmin(), x.argmax(), y.argmin(), y.argmax()]).tobytes()


def outside(rays: RayBundle, lens: PowerLawLens) -> bytes:
    """Which rays of the margin are beyond the edges."""
    x, y = _traced(rays, lens)
    chosen = np.repeat(rays.in_mask, rays.subrays**2)
    inside = (x >= x[chosen].min()) & (x <= x[chosen].max()) & (y >= y[chosen].min()) & (y <= y[chosen].max())
    return np.packbits(inside | chosen).tobytes()


def _traced(rays: RayBundle, lens: PowerLawLens) -> tuple[np.ndarray, np.ndarray]:
    return source_position(lens, rays.x, rays.y)


def changes(rays: RayBundle, lens: PowerLawLens, name: str, signature: Callable) -> list[tuple[float, float]]:
    """Pairs of values 1e-8 apart between which the signature changes, at most three along the range of a parameter."""
    centre = getattr(lens, name)
    values = centre + np.linspace(-1.0, 1.0, 24) * RANGES[name]
    found = [signature(rays, lens.with_values(**{name: float(v)})) for v in values]
    pairs = []
    for k in np.flatnonzero([a != b for a, b in pairwise(found)])[:3]:
        low, high, at_low = float(values[k]), float(values[k + 1]), found[k]
        while high - low > 1e-8:
            middle = 0.5 * (low + high)
            if signature(rays, lens.with_values(**{name: middle})) == at_low:
                low = middle
            else:
                high = middle
        pairs.append((low, high))
    return pairs


@pytest.mark.parametrize("signature", [extremes, outside])
def test_the_evidence_does_not_jump(fitted: Fitted, signature: Callable) -> None:
    model = SourceModel((20, 20))
    strength = find_strength(fitted.likelihood, fitted.lens, model).ln_lambda
    jumps = []
    for name in RANGES:
        for pair in changes(fitted.likelihood.rays, fitted.lens, name, signature):
            low, high = (
                ln_evidence(fitted.likelihood, fitted.lens.with_values(**{name: value}), strength, model)
                for value in pair
            )
            jumps.append(abs(high - low))
    assert len(jumps) >= 5
    # Below 1 is asked for. ln Z changes by less than 1e5 for a change of one in any parameter, so by 1e-3 over 1e-8.
    assert max(jumps) < 1e-2
