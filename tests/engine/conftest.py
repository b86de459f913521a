"""One simulated observation for all tests that need one: HE0435 with a bright host of n = 2."""

import numpy as np
import pytest

from engine.parametric.fit import ParametricFit, fit_parametric
from engine.simulation.scene import Scene, build_scene
from engine.simulation.simulate import Simulation, simulate
from engine.spec.analysis import Analysis
from engine.spec.realization import Realization
from engine.spec.sky import Host

QUICK = Analysis(source_pixels=(12, 12), max_steps=10, draws=4)
"""An analysis of seconds, for what does not depend on its quality."""
HELD_INDEX = 2.02
"""Where the fit of the session holds n beside leaving it free: some deviations from the n = 2 of the simulation."""


@pytest.fixture(scope="session")
def realization() -> Realization:
    return Realization(system="HE0435", l_eta=1.0, host=Host(n=2.0, r_eff=0.39, magnitude=20.5), analysis=QUICK)


@pytest.fixture(scope="session")
def scene(realization: Realization) -> Scene:
    return build_scene(realization)


@pytest.fixture(scope="session")
def simulation(scene: Scene) -> Simulation:
    return simulate(scene, "author", np.random.default_rng(1))


@pytest.fixture(scope="session")
def fit(scene: Scene, simulation: Simulation) -> ParametricFit:
    """Of the simulation, its four AGN known; made once for all tests."""
    return fit_parametric(simulation.observation, agn_images=len(scene.agn), fixed_index=HELD_INDEX)
