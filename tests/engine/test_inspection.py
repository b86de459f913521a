"""One inversion looked at closely, and its picture."""

import math
from dataclasses import replace

import numpy as np
import pytest

from engine import InversionView, inspect_inversion
from engine.comparison import view_beside
from engine.figures import inversion_figure
from engine.simulation.simulate import Simulation
from tests.engine.conftest import QUICK
from tests.engine.true_fit import true_fit


@pytest.fixture(scope="module")
def view(simulation: Simulation) -> InversionView:
    scene = simulation.scene
    view = inspect_inversion(simulation.observation, QUICK, agn_images=4, fit=true_fit(scene))
    assert view.source_plane.source_truth is None
    assert all(trace.truth is None for trace in view.traces)
    return view_beside(view, scene)


def test_each_parameter_is_traced_through_the_maximum_of_the_evidence(view: InversionView) -> None:
    names = [trace.name for trace in view.traces]
    assert names == ["theta_E", "q", "phi", "slope", "x", "y", "ln_lambda"] == list(view.source_plane.parameter_names)
    for trace in view.traces:
        inner = np.abs(trace.offsets) <= 1.0
        # The Gaussian was measured over one standard deviation, where a coarse grid leaves 0.2 of roughness.
        assert np.allclose(trace.ln_evidence[inner], -0.5 * trace.offsets[inner] ** 2, atol=0.2)
        assert (trace.truth is None) == (trace.name == "ln_lambda")


def test_the_truth_of_a_trace_is_where_it_is(view: InversionView, simulation: Simulation) -> None:
    for name, away in (("q", 1.5), ("phi", -0.7)):
        (trace,) = (trace for trace in view.traces if trace.name == name)
        # The angle has the period pi.
        value = trace.centre + away * trace.sd + (math.pi if name == "phi" else 0.0)
        there = replace(simulation.scene, lens=simulation.scene.lens.with_values(**{name: value}))
        (moved,) = (trace for trace in view_beside(view, there).traces if trace.name == name)
        assert moved.truth == pytest.approx(away)


def test_resolution_and_maps_are_those_of_one_inversion(view: InversionView) -> None:
    assert view.resolution.data_share.shape == view.source_plane.source.shape == (12, 12)
    assert view.resolution.data_share.sum() == pytest.approx(view.effective_parameters, rel=1e-9)
    assert view.effective_parameters == pytest.approx(view.inversion.effective_parameters(), rel=1e-12)
    middle = view.resolution.width[4:8, 4:8]
    # HST's resolution over a magnification of a few, and not below a cell of the grid.
    assert 0.9 * np.diff(view.inversion.grid.x).min() < middle.min() < 0.3
    assert view.chi2 / view.degrees_of_freedom == pytest.approx(1.0, abs=0.15)


def test_the_picture_has_eight_maps_and_a_trace_for_each_parameter(view: InversionView) -> None:
    figure = inversion_figure(view)
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert len(titles) == 8 + len(view.traces)
    assert {"data", "model", "source", "resolution"} <= set(titles)
