"""Figures of runs, inversions, simulations, and of what many runs say. Not numeric: numbers become pictures."""

from engine.figures.accuracy import accuracy_figure
from engine.figures.biases import bias_figure
from engine.figures.calibration import coverage_figure, pull_figure
from engine.figures.hosts import hosts_figure
from engine.figures.inversion import inversion_figure
from engine.figures.measurement import measurement_figure
from engine.figures.output import FIGURE_FORMATS, FigureFormat, figure_bytes
from engine.figures.run import run_figure
from engine.figures.sample import sample_figure
from engine.figures.simulation import gallery_figure, montage_figure, simulation_figure
from engine.figures.style import LIMITS, Limits
from engine.figures.thumbnails import Pictures, Thumbnail, grid_figure, pictures_of
from engine.figures.trends import trend_figure

__all__ = [
    "FIGURE_FORMATS",
    "LIMITS",
    "FigureFormat",
    "Limits",
    "Pictures",
    "Thumbnail",
    "accuracy_figure",
    "bias_figure",
    "coverage_figure",
    "figure_bytes",
    "gallery_figure",
    "grid_figure",
    "hosts_figure",
    "inversion_figure",
    "measurement_figure",
    "montage_figure",
    "pictures_of",
    "pull_figure",
    "run_figure",
    "sample_figure",
    "simulation_figure",
    "trend_figure",
]
