"""Figures of runs and simulations. Not numeric: arrays become pictures and nothing is computed but their stretch."""

from engine.figures.measurement import measurement_figure
from engine.figures.run import run_figure
from engine.figures.simulation import gallery_figure, montage_figure, simulation_figure

__all__ = ["gallery_figure", "measurement_figure", "montage_figure", "run_figure", "simulation_figure"]
