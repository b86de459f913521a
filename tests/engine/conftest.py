"""One simulated observation for all tests that need one: HE0435 with a bright host of n = 2."""

from dataclasses import replace

import numpy as np
import pytest
from lenstronomy.Util import numba_util

from engine.catalogue import load_system
from engine.parametric.fit import ParametricFit, fit_parametric
from engine.simulation.scene import Scene, build_scene
from engine.simulation.simulate import Simulation, simulate
from engine.spec.analysis import Analysis
from engine.spec.host import Host
from engine.spec.realization import Realization
from engine.spec.sky import LensSystem

# As plain Python: to compile what the tests ask of lenstronomy takes fifteen seconds, and saves a tenth of one.
numba_util.numba_enabled = False

QUICK = Analysis(source_pixels=(12, 12), subrays=1, psf_radius=8, max_steps=10, draws=4)
"""An analysis of seconds, for what does not depend on its quality."""
FIELD_PIXELS = 64
"""Pixels a side that are enough for HE0435, with its PSF and a sky that can be seen: a fit takes half as long."""
HELD_INDEX = 2.02
"""Where the fit of the session holds n beside leaving it free: some deviations from the n = 2 of the simulation."""


def cut(name: str = "HE0435", pixels: int = FIELD_PIXELS) -> LensSystem:
    """A system of the catalogue in a field of that many pixels a side."""
    system = load_system(name)
    return replace(system, exposures=replace(system.exposures, field_pixels=pixels))


@pytest.fixture(scope="session")
def realization() -> Realization:
    return Realization(system=cut(), l_eta=1.0, host=Host(n=2.0, r_eff=0.39, magnitude=20.5), analysis=QUICK)


@pytest.fixture(scope="session")
def scene(realization: Realization) -> Scene:
    return build_scene(realization)


@pytest.fixture(scope="session")
def simulation(scene: Scene) -> Simulation:
    return simulate(scene, "author", np.random.default_rng(1))


@pytest.fixture(scope="session")
def wide(realization: Realization) -> Simulation:
    """The same host in the field of the paper: with sky whose scatter can be measured, and the deflector's wings."""
    return simulate(build_scene(replace(realization, system="HE0435")), "author", np.random.default_rng(1))


@pytest.fixture(scope="session")
def fit(scene: Scene, simulation: Simulation) -> ParametricFit:
    """Of the simulation, its four AGN known; made once for all tests."""
    return fit_parametric(simulation.observation, agn_images=len(scene.agn), fixed_index=HELD_INDEX)
