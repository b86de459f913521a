"""A row of a stored estimate becomes the engine's record of a bias."""

import pytest

from engine import FigureError
from engine.figures import bias_figure
from service.domain.bias_points import bias_point, point_columns

ROW = {
    "run_id": "r_1", "system": "HE0435", "configuration": "quad", "n": 2.0, "r_eff": 0.39, "magnitude": 21.5,
    "l_eta": 1.0, "seed": 7, "estimator": "image", "index_prior": "wide", "arc_magnitude": 18.7, "agn_contrast": None,
    "surface_brightness": 21.4, "magnitude_mean": 21.6, "magnitude_sd": 0.02, "magnitude_bias": 0.1, "r_eff_mean": 0.4,
    "r_eff_sd": 0.01, "r_eff_bias": 0.01, "n_mean": 2.2, "n_sd": 0.3, "n_bias": 0.2, "q_mean": 0.7, "q_sd": 0.1,
    "q_bias": None, "x_mean": None, "x_sd": None, "x_bias": None, "host_kind": "sersic", "host_label": "sersic",
    "deflector": "plain",
}  # fmt: skip


def test_a_row_gives_input_and_recovered_quantities():
    quantities = ("magnitude", "r_eff", "n", "q", "x")
    assert set(point_columns(quantities)) == set(ROW)
    point = bias_point(ROW, quantities)
    assert (point.run_id, point.system, point.configuration, point.seed) == ("r_1", "HE0435", "quad", 7)
    assert (point.setting[:3], point.magnitude) == ((1.0, 0.39, 2.0), 21.5)
    assert (point.estimator, point.index_prior) == ("image", "wide")
    assert (point.arc_magnitude, point.agn_contrast, point.surface_brightness) == (18.7, None, 21.4)
    assert (point.bias("magnitude"), point.sd("magnitude")) == (pytest.approx(0.1), 0.02)
    assert point.bias("n") == pytest.approx(0.2)
    assert point.recovered["q"].truth is None
    assert "x" not in point.recovered
    for missing in ("q", "x"):
        with pytest.raises(FigureError, match=f"{missing}: run r_1 has none with a truth"):
            point.bias(missing)


def test_points_of_rows_can_be_drawn():
    quantities = ("magnitude", "r_eff", "n")
    profile = bias_point(ROW, quantities)
    assert len(bias_figure([profile]).axes) == 5
    # A host without an index has a number of its own and no point in (c), alone and beside others.
    spiral = bias_point({**ROW, "n": None, "n_bias": None, "host_kind": "spiral", "host_label": "spiral-3"}, quantities)
    for points in ([spiral], [spiral, profile]):
        told = [text.get_text() for text in bias_figure(points).axes[4].texts]
        assert "spiral-3" in told
        assert ("2" in told) == (profile in points)
