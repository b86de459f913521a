"""Deflection, Jacobian and ray tracing against mpmath, lenstronomy and differences."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.errors import SpecError
from engine.lensing.power_law import (
    PowerLawLens,
    convergence_and_shear,
    deflection,
    magnification,
    series_coefficients,
    source_position,
)

lenses = st.builds(
    PowerLawLens,
    theta_E=st.floats(0.3, 2.5),
    q=st.floats(0.2, 1.0),
    phi=st.floats(-3.0, 3.0),
    slope=st.floats(1.3, 2.7),
    x=st.floats(-0.2, 0.2),
    y=st.floats(-0.2, 0.2),
    gamma1=st.floats(-0.2, 0.2),
    gamma2=st.floats(-0.2, 0.2),
)


def test_the_series_is_cut_where_its_tail_is_below_rounding() -> None:
    for q in (0.1, 0.3, 0.9):
        full = series_coefficients(q, 1.1, 1e-30)
        cut = series_coefficients(q, 1.1)
        assert np.abs(full[cut.size :]).sum() < 2e-16
    assert series_coefficients(1.0, 1.0).tolist() == [1.0]


def test_deflection_equals_lenstronomy() -> None:
    from lenstronomy.LensModel.lens_model import LensModel
    from lenstronomy.Util.param_util import phi_q2_ellipticity

    lens = PowerLawLens(1.2, 0.8, 0.5, 2.1, 0.03, -0.02, 0.05, -0.03)
    e1, e2 = phi_q2_ellipticity(lens.phi, lens.q)
    kwargs = [
        {"theta_E": 1.2, "gamma": 2.1, "e1": e1, "e2": e2, "center_x": 0.03, "center_y": -0.02},
        {"gamma1": 0.05, "gamma2": -0.03},
    ]
    x, y = np.random.default_rng(2).uniform(-2, 2, (2, 500))
    bx, by = LensModel(["EPL", "SHEAR"]).alpha(x, y, kwargs)
    ax, ay = deflection(lens, x, y)
    assert np.allclose(ax, bx, rtol=0, atol=1e-12)
    assert np.allclose(ay, by, rtol=0, atol=1e-12)


@settings(max_examples=60, deadline=None)
@given(lens=lenses, radius=st.floats(0.1, 3.0), angle=st.floats(0, 6.28))
def test_the_analytic_jacobian_is_the_derivative_of_the_deflection(
    lens: PowerLawLens, radius: float, angle: float
) -> None:
    x, y = lens.x + radius * math.cos(angle), lens.y + radius * math.sin(angle)
    h = 1e-5
    points = np.array([[x + h, y], [x - h, y], [x, y + h], [x, y - h]])
    ax, ay = deflection(lens, points[:, 0], points[:, 1])
    kappa, g1, g2 = (float(v) for v in convergence_and_shear(lens, np.array(x), np.array(y)))
    # Third derivatives over h^2 and rounding over h: both below 1e-7 of the scale of the second derivatives here.
    tolerance = 1e-6 * (1.0 + radius**-2)
    assert (ax[0] - ax[1]) / (2 * h) == pytest.approx(kappa + g1, abs=tolerance)
    assert (ay[2] - ay[3]) / (2 * h) == pytest.approx(kappa - g1, abs=tolerance)
    assert (ax[2] - ax[3]) / (2 * h) == pytest.approx(g2, abs=tolerance)
    assert (ay[0] - ay[1]) / (2 * h) == pytest.approx(g2, abs=tolerance)


@settings(max_examples=30, deadline=None)
@given(lens=lenses, turn=st.floats(-3, 3))
def test_turning_lens_and_position_together_turns_the_deflection(lens: PowerLawLens, turn: float) -> None:
    c, s = math.cos(turn), math.sin(turn)
    turned = PowerLawLens(
        lens.theta_E,
        lens.q,
        lens.phi + turn,
        lens.slope,
        c * lens.x - s * lens.y,
        s * lens.x + c * lens.y,
        lens.gamma1 * math.cos(2 * turn) - lens.gamma2 * math.sin(2 * turn),
        lens.gamma1 * math.sin(2 * turn) + lens.gamma2 * math.cos(2 * turn),
    )
    x, y = np.array([0.9]), np.array([-0.7])
    ax, ay = deflection(lens, x, y)
    bx, by = deflection(turned, c * x - s * y, s * x + c * y)
    assert bx[0] == pytest.approx(c * ax[0] - s * ay[0], abs=1e-12)
    assert by[0] == pytest.approx(s * ax[0] + c * ay[0], abs=1e-12)


def test_a_circular_isothermal_lens_has_the_textbook_magnification() -> None:
    lens = PowerLawLens(1.0, 1.0, 0.0, 2.0)
    r = np.array([0.5, 1.5, 3.0])
    assert np.allclose(magnification(lens, r, 0 * r), 1 / (1 - 1 / r), rtol=1e-13)


def test_source_position_is_position_less_deflection_for_any_shape() -> None:
    lens = PowerLawLens(1.0, 0.8, 0.1, 2.0)
    x, y = np.meshgrid(np.linspace(-1, 1, 7), np.linspace(-1, 1, 5))
    bx, by = source_position(lens, x, y)
    assert bx.shape == by.shape == (5, 7)
    ax, ay = deflection(lens, x, y)
    np.testing.assert_allclose(x - bx, ax, rtol=0, atol=1e-15)
    np.testing.assert_allclose(y - by, ay, rtol=0, atol=1e-15)
    # 5 x 7 points fill no block: the last block is cut, and every point still right.
    one = source_position(lens, x[3, 4], y[3, 4])
    assert (float(one[0]), float(one[1])) == (bx[3, 4], by[3, 4])


@pytest.mark.parametrize(
    ("field", "value"), [("theta_E", 0.0), ("theta_E", -1.0), ("q", 0.0), ("q", 1.1), ("slope", 1.0), ("slope", 3.0)]
)
def test_an_impossible_lens_is_refused_by_field(field: str, value: float) -> None:
    values = {"theta_E": 1.0, "q": 0.8, "phi": 0.0, "slope": 2.0} | {field: value}
    with pytest.raises(SpecError, match=field):
        PowerLawLens(**values)


def test_a_lens_with_a_nan_is_refused() -> None:
    with pytest.raises(SpecError):
        PowerLawLens(1.0, 0.8, math.nan, 2.0)
    with pytest.raises(SpecError):
        PowerLawLens(math.nan, 0.8, 0.0, 2.0)
