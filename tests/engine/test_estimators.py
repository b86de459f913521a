"""The estimators on sources and data whose Sersic profile is known."""

import math
from dataclasses import replace

import numpy as np
import pytest

from engine.comparison import estimate_beside
from engine.conventions import rate_to_magnitude
from engine.estimators.aperture import aperture_flux
from engine.estimators.draws import SourceDraw, source_draw
from engine.estimators.least_squares import fit_shapes, scatter
from engine.estimators.projected import ProjectedMetric
from engine.estimators.refit import Refit, SersicFit, refit_draws
from engine.estimators.summaries import summarise, summarise_all, summarise_aperture
from engine.light.cell_means import N, columns_on_grid, profile_on_grid
from engine.light.sersic import SersicProfile, flux_in_circle, profile_of, shape_of, surface_brightness
from engine.likelihood.evidence import invert
from engine.source.grid import SourceGrid
from engine.source.regularisation import SourceModel
from engine.spec.analysis import EstimatorName
from tests.engine.dense_oracle import LENS, Case

GRID = SourceGrid(np.linspace(-0.8, 0.8, 31), np.linspace(-0.7, 0.75, 29))
TRUTH = SersicProfile(50.0, 0.3, 2.0, 0.7, 0.6, 0.02, 0.03)
ON_MAPS: tuple[EstimatorName, ...] = ("paper", "covariance", "projected")
HOST = SersicProfile(400.0, 0.25, 1.5, 0.8, 0.3, 0.05, 0.02)


def on_grid(profile: SersicProfile, grid: SourceGrid = GRID) -> np.ndarray:
    return profile_on_grid(profile, grid.x_edges, grid.y_edges)


def draw_of(source: np.ndarray, grid: SourceGrid = GRID, precision: float = 1.0) -> SourceDraw:
    """A draw whose map is also what the data say, with equal noise in every cell."""
    n = source.size
    values = source.reshape(grid.shape)
    return SourceDraw(
        LENS, grid, values, values, np.eye(n) * precision**0.5, np.eye(n) * precision, precision * source.ravel()
    )


def refits(
    draws: list[SourceDraw], estimators: tuple[EstimatorName, ...] = ON_MAPS, n: float | None = None
) -> dict[tuple[str, str], Refit]:
    found = refit_draws(draws, estimators, n, np.random.default_rng(0))
    return {(refit.estimator, refit.index_prior): refit for refit in found}


def test_the_mean_over_a_cell_is_the_profile_averaged() -> None:
    for n in (0.5, 2.0, 4.0):
        profile = replace(TRUTH, n=n)
        values = on_grid(profile).reshape(GRID.shape)
        xe, ye = GRID.x_edges, GRID.y_edges
        for j, i in ((14, 15), (3, 25), (13, 16)):
            x = np.linspace(xe[i], xe[i + 1], 1601)[:-1] + 0.5 * (xe[i + 1] - xe[i]) / 1600
            y = np.linspace(ye[j], ye[j + 1], 1601)[:-1] + 0.5 * (ye[j + 1] - ye[j]) / 1600
            mean = surface_brightness(profile, *np.meshgrid(x, y)).mean()
            # The core that is not cut any further holds 0.3 % of the flux; it is off by a tenth of that at most.
            assert values[j, i] == pytest.approx(mean, rel=2e-3)


@pytest.mark.parametrize("n", [0.5, 1.0, 2.0, 4.0])
def test_derivatives_are_those_of_the_brightness(n: float) -> None:
    shape = shape_of(replace(TRUTH, n=n))
    edges = np.linspace(0.2, 0.8, 13), np.linspace(-0.7, -0.1, 12)
    columns = columns_on_grid(shape, *edges)
    for k in range(6):
        step = 1e-5 * np.eye(6)[k]
        difference = (columns_on_grid(shape + step, *edges) - columns_on_grid(shape - step, *edges))[:, -1] / 2e-5
        # Central differences: 1e-10 of curvature, 1e-16 / 1e-5 of rounding.
        assert np.abs(columns[:, k] - difference).max() < 1e-7 * np.abs(difference).max()


def test_parameters_and_profile_are_one_and_the_same() -> None:
    again = profile_of(shape_of(TRUTH), TRUTH.flux)
    for name in ("flux", "r_eff", "n", "q", "phi", "x", "y"):
        assert getattr(again, name) == pytest.approx(getattr(TRUTH, name), rel=1e-12)
    assert profile_of(shape_of(replace(TRUTH, q=1.0)), 1.0).q == 1.0


@pytest.mark.parametrize("n", [1.5, 2.0, 3.5])
def test_a_perfect_source_map_gives_the_profile_back(n: float) -> None:
    truth = replace(TRUTH, n=n)
    found = refits([draw_of(on_grid(truth) * 1e6)], n=n)
    assert len(found) == 9
    for refit in found.values():
        (fit,) = refit.fits
        assert fit is not None
        # The scatter of the projected fit is of order 1e-6: the map is 1e6 times its unit noise.
        assert fit.profile.flux == pytest.approx(50e6, rel=1e-3)
        assert fit.profile.r_eff == pytest.approx(0.3, rel=1e-3)
        assert fit.profile.n == pytest.approx(n, abs=0.005)
        assert fit.profile.q == pytest.approx(0.7, abs=0.001)
        assert math.remainder(fit.profile.phi - 0.6, math.pi) == pytest.approx(0.0, abs=0.002)
        assert (fit.profile.x, fit.profile.y) == pytest.approx((0.02, 0.03), abs=1e-4)
        assert (fit.n_at_bound, fit.r_eff_at_bound) == (False, False)


def test_brighter_by_a_factor_is_brighter_and_nothing_else() -> None:
    noise = np.random.default_rng(4).standard_normal(GRID.x.size * GRID.y.size)
    source = on_grid(TRUTH) + 2.0 * noise
    one = refits([draw_of(source)], ("paper", "covariance"))
    ten = refits([draw_of(10.0 * source)], ("paper", "covariance"))
    for key, refit in one.items():
        first, second = refit.fits[0], ten[key].fits[0]
        assert first is not None
        assert second is not None
        # Both end within 0.05 of a standard deviation, which is 1 % here.
        assert second.profile.flux == pytest.approx(10.0 * first.profile.flux, rel=2e-3)
        assert second.profile.r_eff == pytest.approx(first.profile.r_eff, rel=2e-3)
        assert second.profile.n == pytest.approx(first.profile.n, abs=0.01)


def test_a_shifted_frame_shifts_the_centre_and_nothing_else() -> None:
    moved = SourceGrid(GRID.x + 0.5, GRID.y - 0.25)
    source = on_grid(TRUTH) + 2.0 * np.random.default_rng(4).standard_normal(GRID.x.size * GRID.y.size)
    here, there = refits([draw_of(source)]), refits([draw_of(source, moved)])
    for key, refit in here.items():
        first, second = refit.fits[0], there[key].fits[0]
        assert first is not None
        assert second is not None
        expected = replace(first.profile, x=first.profile.x + 0.5, y=first.profile.y - 0.25)
        for name in ("flux", "r_eff", "n", "q", "x", "y"):
            # The same steps but for rounding.
            assert getattr(second.profile, name) == pytest.approx(getattr(expected, name), rel=1e-5), (key, name)


def test_an_index_beyond_the_range_ends_at_the_bound_and_is_flagged() -> None:
    found = refits([draw_of(on_grid(replace(TRUTH, n=6.0)))], ("paper",))
    free, wide = found["paper", "free"].fits[0], found["paper", "wide"].fits[0]
    assert free is not None
    assert wide is not None
    assert (free.n_at_bound, free.r_eff_at_bound) == (True, False)
    assert free.profile.n == pytest.approx(4.0, abs=1e-2)
    assert not wide.n_at_bound
    assert wide.profile.n == pytest.approx(6.0, abs=0.05)


def test_a_point_ends_at_the_bound_of_the_radius() -> None:
    source = np.zeros(GRID.shape)
    source[14, 15] = 1000.0
    fit = refits([draw_of(source.ravel())], ("paper",))["paper", "wide"].fits[0]
    assert fit is not None
    assert fit.r_eff_at_bound


def test_a_fit_within_the_narrower_range_is_the_same_in_both() -> None:
    source = on_grid(TRUTH) + 2.0 * np.random.default_rng(4).standard_normal(GRID.x.size * GRID.y.size)
    found = refits([draw_of(source)] * 3)
    for estimator in ON_MAPS:
        assert found[estimator, "wide"].fits == found[estimator, "free"].fits


def test_the_projected_metric_is_the_chi2_of_the_data() -> None:
    # However smooth the regularisation makes the map, the projected estimator sees the data.
    scene = Case(amplitudes=0, mask="ring")
    likelihood = scene.likelihood()
    strong = invert(likelihood, LENS, 12.0, SourceModel((16, 16)))
    source = on_grid(HOST, strong.grid)
    scene.linear = replace(
        scene.linear, data=likelihood.blurring @ strong.lensing.apply(source), covariance=scene.covariance * 1e-6
    )
    oversmoothed = invert(scene.likelihood(), LENS, 12.0, SourceModel((16, 16)))
    draw = source_draw(oversmoothed, LENS, np.random.default_rng(0))
    fit = refits([draw], ("projected",))["projected", "wide"].fits[0]
    assert fit is not None
    assert fit.profile.flux == pytest.approx(400.0, rel=0.01)
    assert fit.profile.r_eff == pytest.approx(0.25, rel=0.02)


def test_the_projected_scatter_covers_the_noise() -> None:
    rng = np.random.default_rng(2)
    clean = on_grid(TRUTH)
    fluxes, spreads = [], []
    for _ in range(24):
        noisy = clean + 10.0 * rng.standard_normal(clean.size)
        found = refits([draw_of(noisy, precision=0.01)] * 8, ("projected",), 2.0)["projected", "fixed"]
        values = [fit.profile.flux for fit in found.fits if fit is not None]
        fluxes.append(np.mean(values))
        spreads.append(np.std(values, ddof=1))
    # Scatter of the estimate from noise to noise against the spread that one data set reports: 24 of them, 14 %.
    assert np.std(fluxes) / np.mean(spreads) == pytest.approx(1.0, abs=0.35)
    assert np.mean(fluxes) == pytest.approx(50.0, rel=0.01)


def test_scatter_at_a_fixed_shape_is_the_noise_of_the_flux_and_stays_inside_bounds_else() -> None:
    draw = draw_of(on_grid(TRUTH), precision=0.01)
    metric, which = ProjectedMetric([draw]), np.zeros(400, dtype=np.intp)
    generators = [np.random.default_rng(seed) for seed in range(400)]
    shape = np.repeat(shape_of(TRUTH)[None], 400, axis=0)
    held = fit_shapes(metric, which, shape, shape, shape)
    shapes, fluxes = scatter(metric, which, held, shape, shape, generators)
    model = on_grid(TRUTH) / TRUTH.flux
    assert np.array_equal(shapes, shape)
    # 400 draws: 3.5 % of the deviation.
    assert fluxes.std() == pytest.approx(1.0 / math.sqrt(0.01 * model @ model), rel=0.12)
    low, high = (np.repeat(side[None], 400, axis=0) for side in draw.bounds((1.99, 4.0)))
    fits = fit_shapes(metric, which, shape, low, high)
    shapes, _ = scatter(metric, which, fits, low, high, generators)
    assert (shapes >= low).all()
    assert (shapes <= high).all()
    assert shapes[:, N].std() > 0.0


def test_an_estimator_without_an_answer_is_missing_with_a_warning_and_the_others_stay() -> None:
    # The drawn map is dark, the data are not: what looks at maps has no answer, what looks at data has.
    lit = draw_of(on_grid(TRUTH) * 1e3)
    draws = [replace(lit, mean=-lit.mean, drawn=-lit.drawn)] * 3
    found = summarise_all(draws, list(refits(draws, n=2.0).values()), 25.0)
    names = {estimate.estimator for estimate in found.estimates}
    assert "projected" in names
    assert not {"paper", "covariance"} & names
    assert found.aperture is None
    for estimator in ("paper", "covariance"):
        for prior in ("wide", "free", "fixed"):
            assert any(warning.startswith(f"{estimator} estimator, n {prior}") for warning in found.warnings)
    assert any("aperture" in warning for warning in found.warnings)


def test_a_host_fainter_than_the_noise_gives_finite_numbers_and_counts_what_failed() -> None:
    case = Case(amplitudes=1)
    case.linear = replace(
        case.linear, data=np.sqrt(case.covariance) * np.random.default_rng(5).standard_normal(case.data.size)
    )
    likelihood = case.likelihood()
    rng = np.random.default_rng(6)
    draws = [source_draw(invert(likelihood, LENS, 2.0, SourceModel((10, 10))), LENS, rng) for _ in range(8)]
    found = summarise_all(draws, list(refits(draws, n=1.5).values()), 25.0)
    assert len(found.estimates) + len([warning for warning in found.warnings if "estimator" in warning]) == 9
    assert any(0 < estimate.failed < 8 for estimate in found.estimates)
    for estimate in found.estimates:
        assert estimate.draws == 8
        for name in ("magnitude", "r_eff", "r_eff_galfit", "n", "q", "position_angle", "x", "y"):
            quantity = getattr(estimate, name)
            assert math.isfinite(quantity.mean)
            assert math.isfinite(quantity.sd)
    if found.aperture is not None:
        assert math.isfinite(found.aperture.magnitude.mean)


def fit_of(profile: SersicProfile, *, n_at_bound: bool = False) -> SersicFit:
    return SersicFit(profile, n_at_bound, r_eff_at_bound=False)


def test_means_deviations_biases_and_flags_are_those_of_the_fits() -> None:
    shapes = [(40.0, 0.3, 2.0, 0.7), (60.0, 0.5, 3.0, 0.5)]
    fits = tuple(fit_of(SersicProfile(f, r, n, q, 0.1, 0.1, r), n_at_bound=n == 3.0) for f, r, n, q in shapes)
    blind = summarise(Refit("paper", "free", (*fits, None)), 25.0)
    assert blind is not None
    assert blind.magnitude.bias is None
    estimate = estimate_beside(blind, TRUTH, 25.0)
    magnitudes = [rate_to_magnitude(f, 25.0) for f, *_ in shapes]
    assert estimate.magnitude.mean == pytest.approx(np.mean(magnitudes))
    assert estimate.magnitude.sd == pytest.approx(np.std(magnitudes, ddof=1))
    assert estimate.magnitude.bias == pytest.approx(np.mean(magnitudes) - rate_to_magnitude(50.0, 25.0))
    assert estimate.n.bias == pytest.approx(0.5)
    assert (estimate.x.bias, estimate.y.bias) == pytest.approx((0.08, 0.37))
    assert (estimate.draws, estimate.at_bound, estimate.failed) == (3, 1, 1)
    assert (estimate.n_at_bound, estimate.r_eff_at_bound) == (1, 0)
    # GALFIT's radius is that of the major axis.
    assert estimate.r_eff_galfit.mean == pytest.approx(0.5 * (0.3 / 0.7**0.5 + 0.5 / 0.5**0.5))
    assert estimate.r_eff_galfit.truth == pytest.approx(0.3 / 0.7**0.5)
    assert summarise(Refit("paper", "free", (None, None)), 25.0) is None


def test_position_angles_either_side_of_north_average_to_north() -> None:
    fits = tuple(fit_of(SersicProfile(1.0, 0.3, 2.0, 0.7, phi)) for phi in (math.pi / 2 - 0.1, math.pi / 2 + 0.1))
    estimate = summarise(Refit("paper", "free", fits), 25.0)
    assert estimate is not None
    assert min(estimate.position_angle.mean % 180, 180 - estimate.position_angle.mean % 180) < 1e-6
    # Beside a truth a degree to the other side of North the mean is on that side too.
    for truth in (179.0, 1.0):
        beside = estimate.position_angle.beside(truth, 180.0)
        assert beside.bias == pytest.approx(1.0 if truth == 179.0 else -1.0)


def test_flux_in_a_circle_is_the_integral_of_the_brightness() -> None:
    for n, q in ((1.0, 0.6), (2.0, 1.0), (4.0, 0.7)):
        profile = SersicProfile(50.0, 0.4, n, q, 0.3)
        u = (np.arange(20_000) + 0.5) / 20_000
        r = u**3
        t = 2 * math.pi * (np.arange(64) + 0.5) / 64
        values = surface_brightness(profile, np.outer(r, np.cos(t)), np.outer(r, np.sin(t))).mean(axis=1)
        total = 2 * math.pi * float((values * r * 3.0 * u**2).mean())
        # The quadrature of the reference, r = u^3 graded towards the cusp.
        assert flux_in_circle(profile, 1.0) == pytest.approx(total, rel=1e-5)
        assert flux_in_circle(profile, 1e6) == pytest.approx(50.0, rel=1e-9)
    round_one = SersicProfile(50.0, 1.0, 3.0, 1.0, 0.0)
    assert flux_in_circle(round_one, 1.0) == pytest.approx(25.0, rel=1e-12)


def test_the_aperture_adds_up_the_map() -> None:
    grid = SourceGrid(np.linspace(-1.5, 1.5, 121), np.linspace(-1.5, 1.5, 121))
    flat = np.ones(grid.shape)
    # The circle's area, and half of it at the edge of the map up to the width of a ring's points.
    assert aperture_flux(grid, flat, 0.0, 0.0, 1.0) == pytest.approx((math.pi, 1.0), rel=1e-9)
    flux, coverage = aperture_flux(grid, flat, 1.5, 0.0, 1.0)
    assert (flux, coverage) == pytest.approx((math.pi / 2, 0.5), rel=0.02)
    profile = SersicProfile(50.0, 0.4, 1.0, 0.7, 0.6, 0.02, 0.03)
    flux, _ = aperture_flux(grid, on_grid(profile, grid).reshape(grid.shape), 0.02, 0.03, 1.0)
    # Bilinear between cell means of 0.025 arcsec.
    assert flux == pytest.approx(flux_in_circle(profile, 1.0), rel=2e-3)


def test_the_aperture_magnitude_is_that_of_the_drawn_maps() -> None:
    grid = SourceGrid(np.linspace(-1.2, 1.2, 97), np.linspace(-1.2, 1.2, 97))
    profile = SersicProfile(50.0, 0.3, 1.0, 0.8, 0.6)
    none = np.empty((0, 0))
    maps = [factor * on_grid(profile, grid).reshape(grid.shape) for factor in (0.9, 1.1, -1.0)]
    draws = [SourceDraw(LENS, grid, values, values, none, none, none[0:0].ravel()) for values in maps]
    centres = Refit("paper", "wide", (fit_of(profile), fit_of(profile), None))
    found = summarise_aperture(draws, centres, 25.0)
    assert found is not None
    true = rate_to_magnitude(flux_in_circle(profile, 1.0), 25.0)
    # -2.5 log10(0.9 * 1.1) / 2 off, and 2e-3 for the bilinear map.
    assert found.magnitude.mean - true == pytest.approx(-1.25 * math.log10(0.99), abs=3e-3)
    assert found.magnitude.sd == pytest.approx(2.5 * math.log10(1.1 / 0.9) / 2**0.5, rel=1e-6)
    assert (found.draws, found.failed, found.coverage) == (3, 1, 1.0)
