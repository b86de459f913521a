"""The simulated observation of the engine's tests, for hard cases that begin with it."""

from tests.engine.conftest import realization, scene, simulation

__all__ = ["realization", "scene", "simulation"]
