"""The engine of hostlens: one realization in, one result out; pure functions on arrays and frozen dataclasses.

This module is the engine's public face: everything that ``service`` or a user may import. What may be asked for
is there at once; what computes is loaded when its name is first used, so that a mistake is told within a second.
"""

from importlib import import_module
from typing import TYPE_CHECKING

import engine.home  # noqa: F401 - before Astropy is imported

# isort: split

from engine.catalogue import camera_names, load_camera, load_system, system_facts, system_names
from engine.digest import engine_digest, engine_versions
from engine.errors import (
    AccuracyError,
    EngineError,
    FigureError,
    InversionError,
    LensEquationError,
    NothingToShowError,
    ObservationError,
    PosteriorError,
    SpecError,
    StudyError,
)
from engine.grid import (
    Deflectors,
    Expansion,
    FirstSeed,
    Grid,
    GridRun,
    Hosts,
    Indices,
    Magnitudes,
    Radii,
    Replicates,
    Slopes,
    Systems,
    expand,
    preset_names,
)
from engine.result import (
    Aperture,
    ChainSummary,
    Estimate,
    ImagePlane,
    LensParameter,
    Products,
    Quantity,
    RunResult,
    SourcePlane,
    StageTime,
)
from engine.spec.analysis import PROFILES, Analysis
from engine.spec.deflector import USUAL_DEFLECTOR, Deflector
from engine.spec.host import Host, HostImage, HostShape, MadeGalaxy
from engine.spec.instrument import NOMINAL_OPTICS, Camera, CameraChoice, NoiseLevel, Optics, OpticsChoice
from engine.spec.json_text import read_json
from engine.spec.priors import ParameterPrior
from engine.spec.quantities import Identifier
from engine.spec.realization import (
    Realization,
    camera_from_mapping,
    realization_from_dict,
    spec_digest,
    system_from_mapping,
)
from engine.spec.sky import LensSystem, SystemChoice
from engine.spec.validation import PRINTABLE, complaint, field_path, path_steps, spec_error
from engine.stages import ACCURACY_STAGES, STAGES
from engine.user_files import read_camera, read_mapping, read_system
from engine.work import Work

if TYPE_CHECKING:
    from engine.acceptance import check_realization
    from engine.accuracy.curves import AccuracyReport, report_from_dict
    from engine.accuracy.report import accuracy_markdown, accuracy_page, accuracy_rows, measure_accuracy
    from engine.accuracy.subject import hardest_realization
    from engine.biases import (
        BIN_WIDTH,
        GROUPINGS,
        HOST_QUANTITIES,
        TRENDS,
        BiasPoint,
        Configuration,
        CoverageCurve,
        Grouping,
        HostQuantity,
        PullSummary,
        Spread,
        Trend,
        TrendBin,
        TrendSeries,
        bias_points,
        configuration_of,
        coverage_curve,
        group_points,
        mean_bias,
        pull_summary,
        serial_numbers,
        trend_series,
    )
    from engine.calibration import Calibration, calibrate
    from engine.codes.compare import Comparison, compare_codes
    from engine.codes.coolest import write_coolest
    from engine.comparison import compare
    from engine.experiment import inspect_simulation, run
    from engine.host_files import read_host_image
    from engine.imaging.external import observation_from_arrays
    from engine.imaging.external_files import read_external_observation
    from engine.imaging.fits import read_observation, write_observation
    from engine.imaging.noise_from_image import NoiseFromImage
    from engine.imaging.observation import Observation
    from engine.imaging.readings import Reading, readings
    from engine.inspection import InversionView, inspect_inversion
    from engine.measure import ImageMeasurement, measure_image
    from engine.prediction.from_image import traits_of_image
    from engine.prediction.predictor import (
        NEAR,
        PREDICTED,
        EstimatorPrediction,
        Predictor,
        QuantityPrediction,
        Range,
        SimulatedRun,
    )
    from engine.prediction.traits import LensTraits, resolution_of, traits_of
    from engine.reconstruction import Reconstruction, analyse
    from engine.simulation.scene import check_analysis, check_system
    from engine.simulation.seeds import generator
    from engine.simulation.simulate import Simulation, simulate_realization
    from engine.study import (
        STUDY_FORMAT,
        STUDY_METADATA_KEY,
        Conclusion,
        Study,
        conclusions_markdown,
        read_study,
        study_conclusions,
        verdict,
    )
else:
    _LATE = {
        "engine.acceptance": "check_realization",
        "engine.accuracy.curves": "AccuracyReport report_from_dict",
        "engine.accuracy.report": "accuracy_markdown accuracy_page accuracy_rows measure_accuracy",
        "engine.accuracy.subject": "hardest_realization",
        "engine.biases": (
            "BIN_WIDTH GROUPINGS HOST_QUANTITIES TRENDS BiasPoint Configuration CoverageCurve Grouping "
            "HostQuantity PullSummary Spread Trend TrendBin TrendSeries bias_points configuration_of "
            "coverage_curve group_points mean_bias pull_summary serial_numbers trend_series"
        ),
        "engine.calibration": "Calibration calibrate",
        "engine.codes.compare": "Comparison compare_codes",
        "engine.codes.coolest": "write_coolest",
        "engine.comparison": "compare",
        "engine.experiment": "inspect_simulation run",
        "engine.host_files": "read_host_image",
        "engine.imaging.external": "observation_from_arrays",
        "engine.imaging.external_files": "read_external_observation",
        "engine.imaging.fits": "read_observation write_observation",
        "engine.imaging.noise_from_image": "NoiseFromImage",
        "engine.imaging.observation": "Observation",
        "engine.imaging.readings": "Reading readings",
        "engine.inspection": "InversionView inspect_inversion",
        "engine.measure": "ImageMeasurement measure_image",
        "engine.prediction.from_image": "traits_of_image",
        "engine.prediction.predictor": (
            "NEAR PREDICTED EstimatorPrediction Predictor QuantityPrediction Range SimulatedRun"
        ),
        "engine.prediction.traits": "LensTraits resolution_of traits_of",
        "engine.reconstruction": "Reconstruction analyse",
        "engine.simulation.scene": "check_analysis check_system",
        "engine.simulation.seeds": "generator",
        "engine.simulation.simulate": "Simulation simulate_realization",
        "engine.study": (
            "STUDY_FORMAT STUDY_METADATA_KEY Conclusion Study conclusions_markdown read_study study_conclusions verdict"
        ),
    }
    _HOME = {name: module for module, names in _LATE.items() for name in names.split()}

    def __getattr__(name):
        """Load the module that a name is of; mypy reads the imports above instead."""
        if name not in _HOME:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        found = globals()[name] = getattr(import_module(_HOME[name]), name)
        return found

    def __dir__():
        """All names, loaded or not."""
        return sorted({*globals(), *_HOME})


__all__ = [
    "ACCURACY_STAGES",
    "BIN_WIDTH",
    "GROUPINGS",
    "HOST_QUANTITIES",
    "NEAR",
    "NOMINAL_OPTICS",
    "PREDICTED",
    "PRINTABLE",
    "PROFILES",
    "STAGES",
    "STUDY_FORMAT",
    "STUDY_METADATA_KEY",
    "TRENDS",
    "USUAL_DEFLECTOR",
    "AccuracyError",
    "AccuracyReport",
    "Analysis",
    "Aperture",
    "BiasPoint",
    "Calibration",
    "Camera",
    "CameraChoice",
    "ChainSummary",
    "Comparison",
    "Conclusion",
    "Configuration",
    "CoverageCurve",
    "Deflector",
    "Deflectors",
    "EngineError",
    "Estimate",
    "EstimatorPrediction",
    "Expansion",
    "FigureError",
    "FirstSeed",
    "Grid",
    "GridRun",
    "Grouping",
    "Host",
    "HostImage",
    "HostQuantity",
    "HostShape",
    "Hosts",
    "Identifier",
    "ImageMeasurement",
    "ImagePlane",
    "Indices",
    "InversionError",
    "InversionView",
    "LensEquationError",
    "LensParameter",
    "LensSystem",
    "LensTraits",
    "MadeGalaxy",
    "Magnitudes",
    "NoiseFromImage",
    "NoiseLevel",
    "NothingToShowError",
    "Observation",
    "ObservationError",
    "Optics",
    "OpticsChoice",
    "ParameterPrior",
    "PosteriorError",
    "Predictor",
    "Products",
    "PullSummary",
    "Quantity",
    "QuantityPrediction",
    "Radii",
    "Range",
    "Reading",
    "Realization",
    "Reconstruction",
    "Replicates",
    "RunResult",
    "SimulatedRun",
    "Simulation",
    "Slopes",
    "SourcePlane",
    "SpecError",
    "Spread",
    "StageTime",
    "Study",
    "StudyError",
    "SystemChoice",
    "Systems",
    "Trend",
    "TrendBin",
    "TrendSeries",
    "Work",
    "accuracy_markdown",
    "accuracy_page",
    "accuracy_rows",
    "analyse",
    "bias_points",
    "calibrate",
    "camera_from_mapping",
    "camera_names",
    "check_analysis",
    "check_realization",
    "check_system",
    "compare",
    "compare_codes",
    "complaint",
    "conclusions_markdown",
    "configuration_of",
    "coverage_curve",
    "engine_digest",
    "engine_versions",
    "expand",
    "field_path",
    "generator",
    "group_points",
    "hardest_realization",
    "inspect_inversion",
    "inspect_simulation",
    "load_camera",
    "load_system",
    "mean_bias",
    "measure_accuracy",
    "measure_image",
    "observation_from_arrays",
    "path_steps",
    "preset_names",
    "pull_summary",
    "read_camera",
    "read_external_observation",
    "read_host_image",
    "read_json",
    "read_mapping",
    "read_observation",
    "read_study",
    "read_system",
    "readings",
    "realization_from_dict",
    "report_from_dict",
    "resolution_of",
    "run",
    "serial_numbers",
    "simulate_realization",
    "spec_digest",
    "spec_error",
    "study_conclusions",
    "system_facts",
    "system_from_mapping",
    "system_names",
    "traits_of",
    "traits_of_image",
    "trend_series",
    "verdict",
    "write_coolest",
    "write_observation",
]
