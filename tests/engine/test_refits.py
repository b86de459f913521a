"""The estimators on sources and data whose Sersic profile is known."""

import math
from dataclasses import replace

import numpy as np
import pytest

from engine.conventions import rate_to_magnitude
from engine.imaging.blurring import convolve
from engine.inversion.blurring import pixel_kernel
from engine.inversion.evidence import invert
from engine.inversion.mapping import RayBundle, SourceGrid, cast_rays
from engine.inversion.operator import LinearData, Operator, build_operator
from engine.inversion.problem import ring_mask
from engine.inversion.regularisation import SourceModel
from engine.light.sersic import SersicProfile, flux_in_circle, surface_brightness
from engine.refits.aperture import aperture_flux
from engine.refits.draws import DrawSet, SourceDraw, source_draw
from engine.refits.estimators import Refit, SersicFit, refit_draws
from engine.refits.image import ImageMetric, RayTracedModel
from engine.refits.least_squares import fit_shapes, scatter
from engine.refits.profiles import columns_on_grid, profile_of, profile_on_grid, shape_of
from engine.refits.projected import ProjectedMetric
from engine.refits.summaries import summarise, summarise_aperture
from engine.result import ESTIMATORS, EstimatorName
from engine.run import Truth, _refit
from engine.simulation import Simulation
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


@pytest.fixture(scope="module")
def operator() -> Operator:
    return Case(amplitudes=1).operator()


def refits(
    draws: list[SourceDraw], operator: Operator, estimators: tuple[EstimatorName, ...] = ON_MAPS, n: float | None = None
) -> dict[tuple[str, str], Refit]:
    found = refit_draws(DrawSet(operator, tuple(draws)), estimators, n, np.random.default_rng(0))
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
def test_a_perfect_source_map_gives_the_profile_back(n: float, operator: Operator) -> None:
    truth = replace(TRUTH, n=n)
    found = refits([draw_of(on_grid(truth) * 1e6)], operator, n=n)
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


def ray_traced(case: Case, host: SersicProfile, *, noise: float = 0.0, seed: int = 0) -> Operator:
    """The operator of a case whose data are a ray-traced host and its amplitude columns."""
    operator = case.operator()
    arc = operator.blurring @ RayTracedModel(operator, LENS).columns(shape_of(host))[:, -1] * host.flux
    sigma = 1e-3 * np.sqrt(case.covariance)
    data = arc + case.columns.sum(axis=1) + noise * sigma * np.random.default_rng(seed).standard_normal(arc.size)
    case.linear = replace(case.linear, data=data, covariance=sigma**2)
    return case.operator()


@pytest.mark.parametrize("n", [1.0, 1.5, 4.0])
def test_noise_free_data_give_the_profile_back_by_the_image(n: float) -> None:
    host = replace(HOST, n=n)
    operator = ray_traced(Case(amplitudes=2), host)
    rng = np.random.default_rng(0)
    draws = [source_draw(invert(operator, LENS, -2.0, SourceModel((14, 14))), LENS, rng)]
    metric = ImageMetric(operator, draws)
    low, high = draws[0].bounds((0.3, 8.0))
    start = shape_of(replace(host, r_eff=0.35, n=2.5, q=0.6, x=0.02))
    fits = fit_shapes(metric, np.array([0]), start[None], low[None], high[None])
    # It ends within 0.05 of a standard deviation, and these are 1e-3 at most here.
    assert fits.converged.all()
    assert fits.fluxes[0] == pytest.approx(400.0, rel=2e-4)
    assert np.abs(fits.shapes[0] - shape_of(host)).max() < 1e-3


def test_the_image_metric_is_the_chi2_of_the_data_with_free_amplitudes() -> None:
    case = Case(amplitudes=3, correlated=True)
    operator = case.operator()
    draw = draw_of(on_grid(HOST))
    shape = shape_of(HOST)
    found = ImageMetric(operator, [draw]).normal_equations(np.array([0]), shape[None])
    columns = operator.blurring @ RayTracedModel(operator, LENS).columns(shape)
    inverse = np.linalg.inv(case.covariance)
    u = case.columns
    projector = inverse - inverse @ u @ np.linalg.inv(u.T @ inverse @ u) @ u.T @ inverse
    assert np.allclose(found.gram[0], columns.T @ projector @ columns, rtol=1e-8)
    assert np.allclose(found.right[0], columns.T @ projector @ case.data, rtol=1e-8)


def test_what_the_draws_share_does_not_move_their_fits() -> None:
    operator = ray_traced(Case(amplitudes=2), HOST, noise=30.0)
    rng = np.random.default_rng(0)
    lenses = [LENS.with_values(theta_E=LENS.theta_E + 2e-3 * k, slope=LENS.slope + 0.01 * k) for k in (-1, 0, 2)]
    draws = [source_draw(invert(operator, lens, -2.0, SourceModel((14, 14))), lens, rng) for lens in lenses]
    low, high = (np.array(side) for side in zip(*(draw.bounds((0.3, 8.0)) for draw in draws), strict=True))
    start = np.repeat(shape_of(HOST)[None], 3, axis=0)
    together = ImageMetric(operator, draws)
    together.normal_equations(np.array([0]), start[:1])
    shared = fit_shapes(together, np.arange(3), start, low, high)
    for k in range(3):
        own = fit_shapes(ImageMetric(operator, [draws[k]]), np.array([0]), start[:1], low[k : k + 1], high[k : k + 1])
        sd = np.sqrt(np.diag(np.linalg.inv(own.hessian[0])))
        # Each ends within 0.05 of a standard deviation of the minimum; the curvature is the first draw's.
        assert np.abs((shared.shapes[k] - own.shapes[0]) / sd).max() < 0.1
        assert np.sqrt(np.diag(np.linalg.inv(shared.hessian[k]))) == pytest.approx(sd, rel=0.15)


@pytest.mark.parametrize("shift", [0.005, 0.01])
def test_a_peaked_host_is_found_behind_lenses_that_move_it(shift: float) -> None:
    """Each lens moves the source by some of its cores: a fit that begins elsewhere blunts the peak."""
    host = replace(HOST, n=4.0)
    operator = ray_traced(Case(amplitudes=2), host)
    rng = np.random.default_rng(0)
    lenses = [
        LENS.with_values(x=LENS.x + shift * i, y=LENS.y + shift * j) for i, j in ((0, 0), (2, 1), (-2, 1), (1, -2))
    ]
    draws = [source_draw(invert(operator, lens, -2.0, SourceModel((14, 14))), lens, rng) for lens in lenses]
    together = refits(draws, operator, ESTIMATORS)
    for k, draw in enumerate(draws):
        alone = refits([draw], operator, ESTIMATORS)["image", "wide"].fits[0]
        fit = together["image", "wide"].fits[k]
        assert fit is not None
        assert alone is not None
        assert fit.profile.r_eff == pytest.approx(alone.profile.r_eff, rel=0.05)
        assert fit.profile.n == pytest.approx(alone.profile.n, abs=0.2)


def test_the_ray_traced_model_is_the_noise_free_arc(simulation: Simulation) -> None:
    observation, scene = simulation.observation, simulation.scene
    shape, scale = observation.image.shape, observation.pixel_scale
    x, y = ((np.arange(size) - (size - 1) / 2) * scale for size in shape[::-1])
    every = np.ones(shape, dtype=np.bool_)
    rays = cast_rays(every, every, x, y, scale, 2)
    model = RayTracedModel(_only(rays), scene.lens).columns(shape_of(scene.host))[:, -1].reshape(shape)
    image = scene.host.flux * convolve(model, pixel_kernel(observation.psf, 2))
    ring = ring_mask(shape, scale, (scene.lens.x, scene.lens.y), 0.4 * scene.lens.theta_E, 1.65 * scene.lens.theta_E)
    cores = np.any([ring_mask(shape, scale, (agn.x, agn.y), 0.0, 0.25) for agn in scene.agn], axis=0)
    seen = ring & ~cores
    error = (image - simulation.arc)[seen]
    # The drizzled response to a cusp is not the PSF: exact pixel integrals are off by 0.7 % of the peak as well.
    assert np.abs(error).max() < 0.012 * simulation.arc[seen].max()
    assert error.sum() == pytest.approx(0.0, abs=2e-3 * simulation.arc[seen].sum())


def _only(rays: RayBundle) -> Operator:
    """An operator of which only the rays are looked at: it sees nothing of them."""
    pixels = rays.pixels
    return build_operator(LinearData(np.zeros(1), np.ones(1), np.zeros((1, 0))), np.zeros((1, pixels)), rays)


def test_brighter_by_a_factor_is_brighter_and_nothing_else(operator: Operator) -> None:
    noise = np.random.default_rng(4).standard_normal(GRID.x.size * GRID.y.size)
    source = on_grid(TRUTH) + 2.0 * noise
    one = refits([draw_of(source)], operator, ("paper", "covariance"))
    ten = refits([draw_of(10.0 * source)], operator, ("paper", "covariance"))
    for key, refit in one.items():
        first, second = refit.fits[0], ten[key].fits[0]
        assert first is not None
        assert second is not None
        # Both end within 0.05 of a standard deviation, which is 1 % here.
        assert second.profile.flux == pytest.approx(10.0 * first.profile.flux, rel=2e-3)
        assert second.profile.r_eff == pytest.approx(first.profile.r_eff, rel=2e-3)
        assert second.profile.n == pytest.approx(first.profile.n, abs=0.01)


def test_a_shifted_frame_shifts_the_centre_and_nothing_else(operator: Operator) -> None:
    moved = SourceGrid(GRID.x + 0.5, GRID.y - 0.25)
    source = on_grid(TRUTH) + 2.0 * np.random.default_rng(4).standard_normal(GRID.x.size * GRID.y.size)
    here, there = refits([draw_of(source)], operator), refits([draw_of(source, moved)], operator)
    for key, refit in here.items():
        first, second = refit.fits[0], there[key].fits[0]
        assert first is not None
        assert second is not None
        expected = replace(first.profile, x=first.profile.x + 0.5, y=first.profile.y - 0.25)
        for name in ("flux", "r_eff", "n", "q", "x", "y"):
            # The same steps but for rounding.
            assert getattr(second.profile, name) == pytest.approx(getattr(expected, name), rel=1e-5), (key, name)


def test_an_index_beyond_the_range_ends_at_the_bound_and_is_flagged(operator: Operator) -> None:
    found = refits([draw_of(on_grid(replace(TRUTH, n=6.0)))], operator, ("paper",))
    free, wide = found["paper", "free"].fits[0], found["paper", "wide"].fits[0]
    assert free is not None
    assert wide is not None
    assert (free.n_at_bound, free.r_eff_at_bound) == (True, False)
    assert free.profile.n == pytest.approx(4.0, abs=1e-2)
    assert not wide.n_at_bound
    assert wide.profile.n == pytest.approx(6.0, abs=0.05)


def test_a_point_ends_at_the_bound_of_the_radius(operator: Operator) -> None:
    source = np.zeros(GRID.shape)
    source[14, 15] = 1000.0
    fit = refits([draw_of(source.ravel())], operator, ("paper",))["paper", "wide"].fits[0]
    assert fit is not None
    assert fit.r_eff_at_bound


def test_a_fit_within_the_narrower_range_is_the_same_in_both(operator: Operator) -> None:
    source = on_grid(TRUTH) + 2.0 * np.random.default_rng(4).standard_normal(GRID.x.size * GRID.y.size)
    found = refits([draw_of(source)] * 3, operator)
    for estimator in ON_MAPS:
        assert found[estimator, "wide"].fits == found[estimator, "free"].fits


def test_the_projected_metric_is_the_chi2_of_the_data() -> None:
    # However smooth the regularisation makes the map, the projected estimator sees the data.
    scene = Case(amplitudes=0, mask="ring")
    operator = scene.operator()
    strong = invert(operator, LENS, 12.0, SourceModel((16, 16)))
    source = on_grid(HOST, strong.grid)
    scene.linear = replace(
        scene.linear, data=operator.blurring @ strong.mapping.apply(source), covariance=scene.covariance * 1e-6
    )
    oversmoothed = invert(scene.operator(), LENS, 12.0, SourceModel((16, 16)))
    draw = source_draw(oversmoothed, LENS, np.random.default_rng(0))
    fit = refits([draw], operator, ("projected",))["projected", "wide"].fits[0]
    assert fit is not None
    assert fit.profile.flux == pytest.approx(400.0, rel=0.01)
    assert fit.profile.r_eff == pytest.approx(0.25, rel=0.02)


def test_the_projected_scatter_covers_the_noise(operator: Operator) -> None:
    rng = np.random.default_rng(2)
    clean = on_grid(TRUTH)
    fluxes, spreads = [], []
    for _ in range(40):
        noisy = clean + 10.0 * rng.standard_normal(clean.size)
        found = refits([draw_of(noisy, precision=0.01)] * 12, operator, ("projected",), 2.0)["projected", "fixed"]
        values = [fit.profile.flux for fit in found.fits if fit is not None]
        fluxes.append(np.mean(values))
        spreads.append(np.std(values, ddof=1))
    # Scatter of the estimate from noise to noise against the spread that one data set reports: 40 of them, 11 %.
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
    assert shapes[:, 5].std() > 0.0


def test_the_image_scatter_covers_the_noise() -> None:
    fluxes, spreads = [], []
    for seed in range(40):
        operator = ray_traced(Case(amplitudes=2), HOST, noise=300.0, seed=seed)
        coupling = replace(operator.coupling, blocks=operator.coupling.blocks / 9e4)
        operator = replace(
            operator, coupling=coupling, border=operator.border / 300.0, wd=operator.wd / 9e4, dd=operator.dd / 9e4
        )
        draws = [
            source_draw(invert(operator, LENS, 3.0, SourceModel((10, 10))), LENS, np.random.default_rng(seed))
        ] * 12
        values = [fit.profile.flux for fit in refits(draws, operator, ("image",), 1.5)["image", "fixed"].fits if fit]
        assert len(values) == 12
        fluxes.append(np.mean(values))
        spreads.append(np.std(values, ddof=1))
    # As above.
    assert np.std(fluxes) / np.mean(spreads) == pytest.approx(1.0, abs=0.35)
    assert np.mean(fluxes) == pytest.approx(400.0, abs=4 * np.std(fluxes) / 40**0.5)


def test_an_estimator_without_an_answer_is_missing_with_a_warning_and_the_others_stay(operator: Operator) -> None:
    # The drawn map is dark, the data are not: what looks at maps has no answer, what looks at data has.
    lit = draw_of(on_grid(TRUTH) * 1e3)
    draws = [replace(lit, mean=-lit.mean, drawn=-lit.drawn)] * 3
    drawn = DrawSet(operator, tuple(draws))
    _, estimates, aperture, warnings = _refit(drawn, 25.0, Truth(LENS, TRUTH), 2.0, np.random.default_rng(0))
    names = {estimate.estimator for estimate in estimates}
    assert "projected" in names
    assert not {"paper", "covariance"} & names
    assert aperture is None
    for estimator in ("paper", "covariance"):
        for prior in ("wide", "free", "fixed"):
            assert any(warning.startswith(f"{estimator} estimator, n {prior}") for warning in warnings)
    assert any("aperture" in warning for warning in warnings)


def test_a_host_fainter_than_the_noise_gives_finite_numbers_and_counts_what_failed() -> None:
    case = Case(amplitudes=1)
    case.linear = replace(
        case.linear, data=np.sqrt(case.covariance) * np.random.default_rng(5).standard_normal(case.data.size)
    )
    operator = case.operator()
    rng = np.random.default_rng(6)
    draws = [source_draw(invert(operator, LENS, 2.0, SourceModel((10, 10))), LENS, rng) for _ in range(8)]
    drawn = DrawSet(operator, tuple(draws))
    _, estimates, aperture, warnings = _refit(drawn, 25.0, Truth(LENS, HOST), 1.5, np.random.default_rng(0))
    assert len(estimates) + len([warning for warning in warnings if "estimator" in warning]) == 12
    assert any(0 < estimate.failed < 8 for estimate in estimates)
    for estimate in estimates:
        assert estimate.draws == 8
        for name in ("magnitude", "r_eff", "r_eff_galfit", "n", "q", "position_angle", "x", "y"):
            quantity = getattr(estimate, name)
            assert math.isfinite(quantity.mean)
            assert math.isfinite(quantity.sd)
    if aperture is not None:
        assert math.isfinite(aperture.magnitude.mean)


def fit_of(profile: SersicProfile, *, n_at_bound: bool = False) -> SersicFit:
    return SersicFit(profile, n_at_bound, r_eff_at_bound=False)


def test_means_deviations_biases_and_flags_are_those_of_the_fits() -> None:
    shapes = [(40.0, 0.3, 2.0, 0.7), (60.0, 0.5, 3.0, 0.5)]
    fits = tuple(fit_of(SersicProfile(f, r, n, q, 0.1, 0.1, r), n_at_bound=n == 3.0) for f, r, n, q in shapes)
    estimate = summarise(Refit("paper", "free", (*fits, None)), 25.0, TRUTH)
    assert estimate is not None
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
    assert summarise(Refit("paper", "free", (None, None)), 25.0, TRUTH) is None


def test_position_angles_either_side_of_north_average_to_north() -> None:
    fits = tuple(fit_of(SersicProfile(1.0, 0.3, 2.0, 0.7, phi)) for phi in (math.pi / 2 - 0.1, math.pi / 2 + 0.1))
    estimate = summarise(Refit("paper", "free", fits), 25.0, None)
    assert estimate is not None
    assert min(estimate.position_angle.mean % 180, 180 - estimate.position_angle.mean % 180) < 1e-6
    assert estimate.position_angle.bias is None


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
    found = summarise_aperture(draws, centres, 25.0, profile)
    assert found is not None
    true = rate_to_magnitude(flux_in_circle(profile, 1.0), 25.0)
    assert found.magnitude.truth == pytest.approx(true)
    # -2.5 log10(0.9 * 1.1) / 2 off, and 2e-3 for the bilinear map.
    assert found.magnitude.bias == pytest.approx(-1.25 * math.log10(0.99), abs=3e-3)
    assert found.magnitude.sd == pytest.approx(2.5 * math.log10(1.1 / 0.9) / 2**0.5, rel=1e-6)
    assert (found.draws, found.failed, found.coverage) == (3, 1, 1.0)
