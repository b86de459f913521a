"""What is found in an observation before the inversion, without the truth."""

import math
from dataclasses import replace

import numpy as np
import pytest

from engine.conventions import pixel_centres, rate_to_magnitude
from engine.errors import ObservationError, PosteriorError
from engine.imaging.observation import Observation
from engine.imaging.optics.spline import spline_coefficients
from engine.imaging.optics.stamp import StampOptics
from engine.imaging.optics.stamp_blur import StampBlur
from engine.lensing.lens_equation import solve_lens_equation
from engine.lensing.power_law import PowerLawLens
from engine.light.rendering import render_sersic
from engine.light.sersic import SersicProfile, surface_brightness
from engine.likelihood.problem import CORE_BOOST, prepare_problem, ring_mask
from engine.parametric.fit import GOOD_START, ParametricFit
from engine.parametric.lens_start import lens_from_positions
from engine.parametric.model import ImageModel
from engine.parametric.parameters import ParameterSpace
from engine.parametric.point_sources import find_point_sources
from engine.parametric.refine import polished
from engine.parametric.residual_noise import measured_stamp_error
from engine.parametric.search import Task, find_starts, quick_fits
from engine.parametric.starts import ring_radii
from engine.simulation.scene import Scene
from engine.simulation.simulate import Simulation
from engine.spec.analysis import Analysis


def test_the_agn_images_are_found_within_a_tenth_of_a_pixel(scene: Scene, simulation: Simulation) -> None:
    observation = simulation.observation
    found = find_point_sources(
        observation.image, observation.noise, observation.psf, observation.pixel_scale, len(scene.agn)
    )
    for source in scene.agn:
        nearest = min(found, key=lambda d: math.hypot(d.x - source.x, d.y - source.y))
        # A parabola through three pixels of a blended image: 0.008 arcsec is a tenth of a pixel.
        assert math.hypot(nearest.x - source.x, nearest.y - source.y) < 0.008
        # The host's own light under the AGN counts with it here.
        assert nearest.flux == pytest.approx(source.flux, rel=0.15)


def test_more_images_than_there_are_is_refused(simulation: Simulation) -> None:
    flat = replace(simulation.observation, image=np.zeros(simulation.observation.shape))
    with pytest.raises(ObservationError, match="agn: found 0 point sources of 2"):
        find_starts(task_of(flat), 2, None, None)


def test_a_lens_is_found_from_the_positions_of_a_quad_and_of_a_double() -> None:
    lens = PowerLawLens(1.2, 0.8, 0.7, 2.0)
    for x, y, number in ((0.02, 0.03, 4), (0.3, 0.25, 2)):
        images = solve_lens_equation(lens, x, y)
        assert len(images) == number
        found, source, misfit = lens_from_positions([(image.x, image.y) for image in images])
        # A double leaves the shape free: the prior decides it, and theta_E absorbs some: 7 % here.
        assert found.theta_E == pytest.approx(1.2, rel=1e-3 if number == 4 else 0.1)
        assert misfit < 0.01
        if number == 4:
            assert found.q == pytest.approx(0.8, abs=0.01)
            assert math.remainder(found.phi - 0.7, math.pi) == pytest.approx(0.0, abs=0.02)
            assert np.allclose(source, (x, y), atol=3e-3)


def test_one_image_is_too_few_for_a_lens() -> None:
    with pytest.raises(PosteriorError, match="agn"):
        lens_from_positions([(1.0, 0.0)])


def test_the_parametric_fit_recovers_lens_host_and_agn(scene: Scene, fit: ParametricFit) -> None:
    # Three standard deviations, and what a drizzled image has no exact PSF for: of the same size.
    sd = dict(zip(fit.lens_names, np.sqrt(np.diag(fit.lens_covariance)), strict=True))
    assert fit.lens.theta_E == pytest.approx(scene.lens.theta_E, abs=3 * sd["theta_E"] + 1e-4)
    assert fit.lens.q == pytest.approx(scene.lens.q, abs=3 * sd["q"] + 1e-3)
    assert fit.lens.slope == pytest.approx(scene.lens.slope, abs=3 * sd["slope"] + 2e-3)
    assert math.remainder(fit.lens.phi - scene.lens.phi, math.pi) == pytest.approx(0.0, abs=3 * sd["phi"] + 2e-3)
    assert sd["slope"] < 0.02
    magnitude = rate_to_magnitude(fit.host.flux, 25.9463)
    assert magnitude == pytest.approx(20.5, abs=0.02)
    assert fit.host.r_eff == pytest.approx(0.39, rel=0.02)
    assert fit.host.n == pytest.approx(2.0, abs=0.05)
    assert 0.9 < fit.chi2 / fit.degrees_of_freedom < 1.1
    for source in scene.agn:
        nearest = min(fit.agn, key=lambda d: math.hypot(d.x - source.x, d.y - source.y))
        assert math.hypot(nearest.x - source.x, nearest.y - source.y) < 1e-3
        assert nearest.flux == pytest.approx(source.flux, rel=0.01)


def test_exact_point_sources_beat_shifted_stamps_beside_the_agn(
    scene: Scene, simulation: Simulation, fit: ParametricFit
) -> None:
    observation = simulation.observation
    source = scene.agn[0]
    stamped = replace(observation, response=None)
    exact, shifted = observation.point_source(source.x, source.y), stamped.point_source(source.x, source.y)
    near = ring_mask(observation.shape, 0.08, (source.x, source.y), 0.0, 0.6)
    error = source.flux * np.abs(exact - shifted)[near] / observation.noise[near]
    # The reason why an observation carries its exposures: many sigma in the core, one sigma and more around it.
    assert error.max() > 3.0
    assert exact.sum() == pytest.approx(shifted.sum(), rel=0.01)


def test_the_mask_is_a_ring_with_its_cores_boosted(simulation: Simulation, fit: ParametricFit) -> None:
    observation = simulation.observation
    problem = prepare_problem(observation, fit, Analysis(noise_treatment="diagonal"))
    radius = 1.65 * fit.lens.theta_E
    assert problem.mask.sum() * 0.08**2 == pytest.approx(math.pi * radius**2 * (1 - (0.4 / 1.65) ** 2), rel=0.02)
    variance = problem.likelihood.whitened.covariance**2
    boosted = problem.core[problem.mask]
    noise = observation.noise[problem.mask]
    assert np.allclose(variance[~boosted], noise[~boosted] ** 2)
    assert np.allclose(variance[boosted], noise[boosted] ** 2 * (1 + CORE_BOOST**2))
    assert problem.amplitude_names == ("agn1", "agn2", "agn3", "agn4", "deflector", "background")


def test_what_a_fit_misses_is_noise_to_the_inversion_where_stars_are_stamps(
    simulation: Simulation, fit: ParametricFit
) -> None:
    stamped = replace(simulation.observation, response=None)
    poor = replace(fit, chi2=4.0 * fit.degrees_of_freedom)
    good = replace(fit, chi2=0.9 * fit.degrees_of_freedom)
    assert (poor.misfit, good.misfit) == (4.0, 1.0)
    analysis = Analysis(noise_treatment="diagonal", source_envelope=False)
    sigma = [prepare_problem(stamped, found, analysis).likelihood.whitened.covariance for found in (good, poor)]
    assert np.allclose(sigma[1], 2.0 * sigma[0])
    exact = [prepare_problem(simulation.observation, found, analysis) for found in (good, poor)]
    assert np.array_equal(*(problem.likelihood.whitened.covariance for problem in exact))


def _lensed(observation: Observation, *, shear: bool = False) -> tuple[ImageModel, np.ndarray]:
    """A model of a host's arc and a deflector, without AGN, on an image of its own; and its parameters."""
    space = ParameterSpace(0, deflector=True, shear=shear)
    whole = (slice(0, observation.shape[0]), slice(0, observation.shape[1]))
    model = ImageModel(observation, space, observation.noise, whole, subrays=2, exact=True)
    deflector = [math.log(0.9), 3.0, 0.05, 0.02, 0.0, 0.0]
    lens = [1.1, 0.09, 0.02, 1.95, 0.0, 0.0, *([0.03, -0.02] if shear else [])]
    return model, np.array([*deflector, *lens, math.log(0.25), 2.5, 0.1, 0.0, 0.03, 0.02])


@pytest.fixture(scope="module")
def stamped(simulation: Simulation) -> Observation:
    """Nothing but noise map and stamp of the simulation: an image of 61 x 61 pixels."""
    psf = simulation.observation.psf
    noise = np.full((61, 61), 2e-3)
    return Observation(np.zeros(noise.shape), noise, psf / psf.sum(), 0.08, 25.9463)


def test_the_smoothing_by_sub_rays_is_not_counted_beside_that_of_the_psf(stamped: Observation) -> None:
    model, values = _lensed(stamped)
    space = model.space
    host, lens = space.host(values), space.lens(values)
    arc = model.unwhitened(model.columns(values)[:, space.amplitudes - 2, None], np.ones(1))
    # Ten times as many rays, whose own smoothing is a hundredth.
    x = pixel_centres(61, 0.08)
    fine = StampBlur(spline_coefficients(stamped.psf), x, x, 0.08, 20, 0)
    truth = fine(render_sersic(host, fine.x, fine.y, fine.side, lens), integrated=True)
    assert arc.sum() == pytest.approx(truth.sum(), rel=1e-3)
    # What two rays a pixel leave is 0.0012 of the light; the rays' own smoothing, if it stays, makes it 0.0034.
    assert np.linalg.norm(arc - truth) < 2e-3 * np.linalg.norm(truth)


def test_derivatives_of_the_final_fit_are_those_of_its_light(stamped: Observation) -> None:
    model, values = _lensed(stamped, shear=True)
    columns = model.columns(values)
    model.data = columns @ np.array([30.0, 2.0, 0.0]) + np.random.default_rng(0).normal(size=columns.shape[0])
    exact = model.jacobian(values)
    for k in range(values.size):
        step = np.zeros(values.size)
        step[k] = 3e-4
        slope = (model.residuals(values + step) - model.residuals(values - step)) / 6e-4
        # Kaufman's form leaves out what is proportional to the residuals, here noise.
        assert np.linalg.norm(exact[:, k] - slope) < 0.03 * np.linalg.norm(slope), k


def test_a_faint_ring_is_found_round_a_bright_flat_deflector() -> None:
    x, y = np.meshgrid(pixel_centres(83, 0.08), pixel_centres(83, 0.08))
    flat = SersicProfile(2500.0, 0.85, 3.8, 0.68, 1.4, 0.0, 0.0)
    ring = 0.5 * np.exp(-0.5 * ((np.hypot(x, y) - 1.3) / 0.12) ** 2) * (1.0 + np.cos(np.arctan2(y, x) - 1.0))
    image = surface_brightness(flat, x, y) * 0.08**2 + ring
    assert any(abs(radius / 1.3 - 1.0) < 0.15 for radius in ring_radii(image, 0.08, (0.0, 0.0)))


@pytest.mark.parametrize("error", [0.7, 1.0, 2.5])
def test_the_error_of_a_stamp_is_read_off_the_residuals(error: float) -> None:
    rng = np.random.default_rng(1)
    x, y = np.meshgrid(np.arange(-20.0, 21.0), np.arange(-20.0, 21.0))
    stamps, others = 50.0 * np.exp(-0.5 * (x**2 + y**2) / 16.0), np.ones(x.shape)
    residual = rng.normal(size=x.shape) * np.sqrt(others + error**2 * stamps)
    # 250 pixels: their mean square is known to 9 %, its root to half of that.
    assert measured_stamp_error(residual, stamps, others, StampOptics.error_range) == pytest.approx(error, rel=0.15)


def test_residuals_that_no_stamp_explains_change_its_error_by_no_more_than_is_allowed() -> None:
    stamps, others = np.full((9, 9), 10.0), np.ones((9, 9))
    assert measured_stamp_error(np.full((9, 9), 1e3), stamps, others, (0.5, 5.0)) == 5.0
    assert measured_stamp_error(np.zeros((9, 9)), stamps, others, (0.5, 5.0)) == 0.5
    assert measured_stamp_error(np.ones((9, 9)), 0.1 * others, others, (0.5, 5.0)) is None


def task_of(observation: Observation) -> Task:
    return Task(observation, deflector=True, shear=False, acceptance=GOOD_START, priors={})


def test_an_agn_image_that_would_leave_its_bounds_is_told(wide: Simulation) -> None:
    # Three pixels from where it is: its bounds are two pixels about where the fit begins.
    shift = 3.0 * wide.observation.pixel_scale
    places = [(agn.x + (shift if k == 0 else 0.0), agn.y) for k, agn in enumerate(wide.scene.agn)]
    task = task_of(wide.observation)
    (group,) = find_starts(task, None, None, places)
    (found,) = quick_fits(task, group)
    assert "agn1.x" in found.at_bound
    (group,) = find_starts(task, 4, None, None)
    (found,) = quick_fits(task, group)
    assert not found.at_bound


def test_what_strays_from_its_start_fit_by_fit_is_told(wide: Simulation) -> None:
    task = task_of(wide.observation)
    (group,) = find_starts(task, 4, None, None)
    start = group[0]
    (found,) = quick_fits(task, [start])
    space = found.space
    low, high = space.bounds(start.vector(space), wide.observation.pixel_scale, {})
    for name in ("agn1.x", "agn2.y", "lens.theta_E", "lens.x", "host.y", "deflector.x"):
        k = space.names.index(name)
        # One fit ends just inside its bounds, and the next one, whose bounds lie round that, goes on from there.
        away = found.values.copy()
        away[k] = low[k] + 0.01 * (high[k] - low[k])
        assert name not in replace(found, values=away).at_bound
        away[k] = low[k] - 0.1 * (high[k] - low[k])
        own_low, own_high = found.low.copy(), found.high.copy()
        own_low[k], own_high[k] = away[k] - 1.0, away[k] + 1.0
        again = replace(found, values=away, low=own_low, high=own_high)
        assert not space.at_bound(away, own_low, own_high)
        assert again.at_bound == (name,)


def test_what_one_candidate_shows_of_its_stamps_is_not_taken_over_by_the_next(simulation: Simulation) -> None:
    task = task_of(replace(simulation.observation, response=None, covariance=None))
    (group,) = find_starts(task, 4, None, None)
    (candidate,) = quick_fits(task, group)
    once, again = polished(task, candidate), polished(task, candidate)
    assert once.stamp_error != 1.0
    assert np.array_equal(once.values, again.values)
