"""The engine of hostlens: one realization in, one result out; pure functions on arrays and frozen dataclasses.

This module is the engine's public face: everything that ``service`` or a user may import.
"""

from engine.catalogue import camera_names, load_camera, load_system, system_facts, system_names
from engine.digest import engine_digest, engine_versions
from engine.errors import (
    EngineError,
    InversionError,
    LensEquationError,
    ObservationError,
    PosteriorError,
    SpecError,
)
from engine.grid import Grid, GridRun, expand, preset_names
from engine.result import ChainSummary, Estimate, LensParameter, Products, Quantity, RunResult, StageTime
from engine.run import STAGES, Measurement, Truth, generator, measure, run
from engine.spec import (
    Analysis,
    Camera,
    Host,
    LensSystem,
    NoiseLevel,
    Optics,
    Realization,
    realization_from_dict,
    spec_digest,
    spec_error,
)

__all__ = [
    "STAGES",
    "Analysis",
    "Camera",
    "ChainSummary",
    "EngineError",
    "Estimate",
    "Grid",
    "GridRun",
    "Host",
    "InversionError",
    "LensEquationError",
    "LensParameter",
    "LensSystem",
    "Measurement",
    "NoiseLevel",
    "ObservationError",
    "Optics",
    "PosteriorError",
    "Products",
    "Quantity",
    "Realization",
    "RunResult",
    "SpecError",
    "StageTime",
    "Truth",
    "camera_names",
    "engine_digest",
    "engine_versions",
    "expand",
    "generator",
    "load_camera",
    "load_system",
    "measure",
    "preset_names",
    "realization_from_dict",
    "run",
    "spec_digest",
    "spec_error",
    "system_facts",
    "system_names",
]
