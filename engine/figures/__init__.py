"""Figures of runs, inversions, simulations. Not numeric: arrays become pictures, only their stretch is computed."""

from engine.figures.inversion import inversion_figure
from engine.figures.measurement import measurement_figure
from engine.figures.run import run_figure
from engine.figures.simulation import gallery_figure, montage_figure, simulation_figure

__all__ = [
    "gallery_figure",
    "inversion_figure",
    "measurement_figure",
    "montage_figure",
    "run_figure",
    "simulation_figure",
]
