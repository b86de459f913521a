"""The forward simulation as a whole: its noise is what its noise map says, from empty sky to the AGN cores."""

from dataclasses import replace

import numpy as np
import pytest

from engine.imaging.drizzling import drizzle
from engine.imaging.noise import draw_noise
from engine.simulation.scene import build_scene
from engine.simulation.simulate import (
    blurred_host,
    combine,
    high_resolution_host,
    high_resolution_image,
    scene_geometry,
    simulate,
    simulate_exposures,
)
from engine.spec.host import Host
from engine.spec.instrument import Optics
from engine.spec.realization import Realization

SPEC = Realization(system="HE0435", l_eta=1.0, host=Host(n=4.0, r_eff=0.39, magnitude=20.5))
DRAWS = 80


@pytest.fixture(scope="module")
def scene():
    return build_scene(SPEC)


@pytest.fixture(scope="module")
def light(scene):
    geometry = scene_geometry(scene)
    return high_resolution_image(scene, geometry, blurred_host(scene, geometry, high_resolution_host(scene, geometry)))


@pytest.mark.parametrize("level", ["author", "handbook"])
def test_exposures_scatter_as_their_noise_map_says_from_empty_sky_to_the_agn_cores(scene, light, level):
    exposures = simulate_exposures(scene, scene_geometry(scene), light, level, np.random.default_rng(0))
    noise, rng = exposures.noise, np.random.default_rng(11)
    # The darkest sky, the deflector's wings, the arc, wings of the AGN, their cores [e-/s].
    classes = np.digitize(exposures.noiseless, [np.quantile(exposures.noiseless, 0.2), 0.2, 1.0, 8.0])
    sums, squares, counts = np.zeros(5), np.zeros(5), np.bincount(classes.ravel(), minlength=5)
    for _ in range(DRAWS):
        residual = (draw_noise(noise, rng) / np.sqrt(noise.variance)).ravel()
        sums += np.bincount(classes.ravel(), residual, minlength=5)
        squares += np.bincount(classes.ravel(), residual**2, minlength=5)
    mean = sums / (counts * DRAWS)
    deviation = np.sqrt(squares / (counts * DRAWS) - mean**2)
    # The smallest class, the cores, has 500 pixels x 80 draws: its mean is known to 0.005, its deviation to 0.004.
    assert counts.min() >= 500
    assert np.abs(mean).max() < 0.02
    assert np.abs(deviation - 1).max() < 0.015


def test_drizzled_noise_and_its_correlations_are_those_of_the_covariance_matrix(scene, light):
    # Through the drizzle package, not through the matrix W that the covariance is made of.
    exposures = simulate_exposures(scene, scene_geometry(scene), light, "handbook", np.random.default_rng(0))
    observation, rng = combine(scene, exposures), np.random.default_rng(5)
    ny, nx = observation.shape
    index = np.arange(ny * nx).reshape(ny, nx)
    lags = {(0, 1): 0.0, (1, 0): 0.0, (1, 1): 0.0, (0, 2): 0.0}
    variance = np.zeros((ny, nx))
    draws = 50
    for _ in range(draws):
        residual = drizzle(draw_noise(exposures.noise, rng), exposures.geometry) / observation.noise
        variance += residual**2
        for row, column in lags:
            lags[row, column] += np.mean(residual[row:, column:] * residual[: ny - row, : nx - column])
    # 9,604 correlated pixels x 50 draws: the mean variance is known to 0.4 %, a correlation to 0.004.
    assert variance.mean() / draws == pytest.approx(1, abs=0.015)
    sky = observation.noise < np.median(observation.noise)
    assert variance[sky].mean() / draws == pytest.approx(1, abs=0.015)
    assert variance[~sky].mean() / draws == pytest.approx(1, abs=0.015)
    sigma = observation.noise.ravel()
    for (row, column), total in lags.items():
        here, there = index[row:, column:].ravel(), index[: ny - row, : nx - column].ravel()
        wanted = np.asarray(observation.covariance[here, there]).ravel() / (sigma[here] * sigma[there])
        assert total / draws == pytest.approx(wanted.mean(), abs=0.02 * max(wanted.mean(), 0.2))


def test_a_pixel_that_saturates_even_in_the_short_exposure_is_not_used(scene):
    bright = replace(scene, agn=tuple(replace(source, flux=100 * source.flux) for source in scene.agn))
    observation = simulate(bright, "handbook", np.random.default_rng(0)).observation
    x = np.arange(98) - 48.5
    for source in bright.agn:
        distance = np.hypot(x - source.x / 0.08, x[:, None] - source.y / 0.08)
        assert not observation.valid[distance < 1].any()
    assert observation.valid.mean() > 0.95
    assert simulate(scene, "handbook", np.random.default_rng(0)).observation.valid.all()


def test_spoilt_optics_change_the_image_and_not_the_psf_that_the_analysis_is_given(scene):
    nominal = simulate(scene, "author", np.random.default_rng(0)).observation
    spoilt_scene = build_scene(replace(SPEC, optics=Optics(defocus_nm=80.0, jitter=0.02)))
    spoilt = simulate(spoilt_scene, "author", np.random.default_rng(0)).observation
    np.testing.assert_array_equal(spoilt.psf, nominal.psf)
    np.testing.assert_array_equal(spoilt.response.psf, nominal.response.psf)
    assert spoilt.image.max() < 0.95 * nominal.image.max()
    assert spoilt.image.sum() == pytest.approx(nominal.image.sum(), rel=2e-3)
    assert (spoilt.provenance["DEFOCUS"], spoilt.provenance["JITTER"]) == (80.0, 0.02)
    same = simulate(build_scene(replace(SPEC, optics=Optics())), "author", np.random.default_rng(0)).observation
    np.testing.assert_array_equal(same.image, nominal.image)


def test_a_realization_without_optics_keeps_the_digest_that_it_had_before_there_were_any():
    assert "optics" not in SPEC.to_dict()
    assert replace(SPEC, optics=Optics(jitter=0.01)).digest != SPEC.digest
