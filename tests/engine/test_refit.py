"""The estimators on source maps whose Sersic profile is known."""

import math

import numpy as np
import pytest

from engine.conventions import rate_to_magnitude
from engine.errors import InversionError
from engine.inversion.evidence import Inversion, invert
from engine.inversion.mapping import SourceGrid
from engine.inversion.regularisation import SourceModel
from engine.light.sersic import SersicProfile, surface_brightness
from engine.refit import SersicFit, SourceDraw, fit_draws, profile_on_grid, summarise
from tests.engine.dense_oracle import LENS, Case

GRID = SourceGrid(np.linspace(-0.8, 0.8, 31), np.linspace(-0.7, 0.75, 29))
TRUTH = SersicProfile(50.0, 0.3, 2.0, 0.7, 0.6, 0.02, 0.03)


def draw_of(source: np.ndarray, grid: SourceGrid = GRID) -> SourceDraw:
    n = source.size
    inversion = Inversion(0.0, grid, None, source.reshape(grid.shape), np.eye(n), np.eye(n), source.ravel().copy(), 1.0)  # type: ignore[arg-type]
    return SourceDraw(inversion, source.reshape(grid.shape))


def test_the_mean_over_a_cell_is_the_profile_averaged() -> None:
    values = profile_on_grid(TRUTH, GRID).reshape(GRID.shape)
    xe, ye = GRID.x_edges, GRID.y_edges
    for j, i in ((14, 15), (3, 25), (13, 16)):
        x = np.linspace(xe[i], xe[i + 1], 401)[:-1] + 0.5 * (xe[i + 1] - xe[i]) / 400
        y = np.linspace(ye[j], ye[j + 1], 401)[:-1] + 0.5 * (ye[j + 1] - ye[j]) / 400
        mean = surface_brightness(TRUTH, *np.meshgrid(x, y)).mean()
        # 9 x 9 points in the central cells resolve n = 2 to half a per cent.
        assert values[j, i] == pytest.approx(mean, rel=5e-3)


@pytest.mark.parametrize("n", [1.5, 2.0, 3.5])
@pytest.mark.parametrize("estimator", ["paper", "projected"])
def test_a_perfect_source_map_gives_the_profile_back(estimator: str, n: float) -> None:
    truth = SersicProfile(50.0, 0.3, n, 0.7, 0.6, 0.02, 0.03)
    draw = draw_of(profile_on_grid(truth, GRID) * 1e6)
    rng = np.random.default_rng(0)
    for index in (None, n):
        (fit,), failed = fit_draws([draw], estimator, index, rng)  # type: ignore[arg-type]
        assert failed == 0
        # The projected scatter is of order 1e-6: the map is 1e6 times its unit noise.
        assert fit.profile.flux == pytest.approx(50e6, rel=2e-3)
        assert fit.profile.r_eff == pytest.approx(0.3, rel=2e-3)
        assert fit.profile.n == pytest.approx(n, abs=0.01)
        assert fit.profile.q == pytest.approx(0.7, abs=0.002)
        assert math.remainder(fit.profile.phi - 0.6, math.pi) == pytest.approx(0.0, abs=0.005)


def test_an_index_beyond_the_range_ends_at_the_bound_and_is_flagged() -> None:
    draw = draw_of(profile_on_grid(SersicProfile(50.0, 0.3, 6.0, 0.7, 0.6), GRID))
    (fit,), _ = fit_draws([draw], "paper", None, np.random.default_rng(0))
    assert fit.at_bound
    assert fit.profile.n == pytest.approx(4.0, abs=1e-2)


def test_the_projected_metric_is_the_chi2_of_the_data() -> None:
    # On an inversion without regularisation worth mentioning, the projected estimator sees the data, not the map.
    scene = Case(amplitudes=0, mask="ring")
    truth = SersicProfile(400.0, 0.25, 1.5, 0.8, 0.3, 0.05, 0.02)
    operator = scene.operator()
    strong = invert(operator, LENS, 12.0, SourceModel((16, 16)))
    source = profile_on_grid(truth, strong.grid)
    scene.linear = type(scene.linear)(
        operator.blurring @ strong.mapping.apply(source), scene.covariance * 1e-6, scene.columns
    )
    oversmoothed = invert(scene.operator(), LENS, 12.0, SourceModel((16, 16)))
    draw = SourceDraw(oversmoothed, oversmoothed.source)
    rng = np.random.default_rng(0)
    (projected,), _ = fit_draws([draw], "projected", None, rng)
    assert projected.profile.flux == pytest.approx(400.0, rel=0.01)
    assert projected.profile.r_eff == pytest.approx(0.25, rel=0.02)


def test_the_projected_scatter_covers_the_noise() -> None:
    rng = np.random.default_rng(2)
    clean = profile_on_grid(TRUTH, GRID)
    fluxes, spreads = [], []
    for _ in range(40):
        noisy = clean + 10.0 * rng.standard_normal(clean.size)
        n = clean.size
        inversion = Inversion(
            0.0, GRID, None, noisy.reshape(GRID.shape), np.eye(n), np.eye(n) / 100.0, noisy / 100.0, 1.0
        )  # type: ignore[arg-type]
        draws = [SourceDraw(inversion, inversion.source)] * 12
        fits, _ = fit_draws(draws, "projected", 2.0, rng)
        values = [fit.profile.flux for fit in fits]
        fluxes.append(np.mean(values))
        spreads.append(np.std(values, ddof=1))
    # Scatter of the estimate from noise to noise against the spread that one data set reports: 40 of them, 11 %.
    assert np.std(fluxes) / np.mean(spreads) == pytest.approx(1.0, abs=0.35)
    assert np.mean(fluxes) == pytest.approx(50.0, rel=0.01)


def test_a_map_without_light_is_refused() -> None:
    with pytest.raises(InversionError, match="paper"):
        fit_draws([draw_of(-np.ones(GRID.shape[0] * GRID.shape[1]))], "paper", None, np.random.default_rng(0))


def test_means_deviations_biases_and_flags_are_those_of_the_fits() -> None:
    shapes = [(40.0, 0.3, 2.0), (60.0, 0.5, 3.0)]
    fits = [SersicFit(SersicProfile(f, r, n, 0.7, 0.1), at_bound=n == 3.0) for f, r, n in shapes]
    estimate = summarise(fits, 1, "paper", "free", 25.0, TRUTH)
    magnitudes = [rate_to_magnitude(f, 25.0) for f, _, _ in shapes]
    assert estimate.magnitude.mean == pytest.approx(np.mean(magnitudes))
    assert estimate.magnitude.sd == pytest.approx(np.std(magnitudes, ddof=1))
    assert estimate.magnitude.bias == pytest.approx(np.mean(magnitudes) - rate_to_magnitude(50.0, 25.0))
    assert estimate.n.bias == pytest.approx(0.5)
    assert (estimate.draws, estimate.at_bound, estimate.failed) == (3, 1, 1)


def test_position_angles_either_side_of_north_average_to_north() -> None:
    fits = [
        SersicFit(SersicProfile(1.0, 0.3, 2.0, 0.7, phi), at_bound=False)
        for phi in (math.pi / 2 - 0.1, math.pi / 2 + 0.1)
    ]
    estimate = summarise(fits, 0, "paper", "free", 25.0, None)
    assert min(estimate.position_angle.mean % 180, 180 - estimate.position_angle.mean % 180) < 1e-6
    assert estimate.position_angle.bias is None
