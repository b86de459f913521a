from dataclasses import replace

import numpy as np
import pytest

from engine.catalogue import load_camera, load_system
from engine.errors import ObservationError
from engine.imaging.noise import draw_noise, exposure_noise
from engine.spec.instrument import ExposurePlan

F160W = load_camera("WFC3-IR_F160W")
PLAN = ExposurePlan(field_pixels=98, dither="eight_point_quarter_pixel", long_s=599.0, n_long=2, short_s=43.98)


def test_author_level_is_the_formula_of_the_papers_script():
    rate = np.array([0.0, 0.5, 29.9, 30.1, 400.0])
    noise = exposure_noise(rate, F160W, PLAN, "author")
    faint = rate / (2 * 599 + 43.98) + (43.98 / (2 * 599)) ** 2 * 0.265**2 + 2 * 0.016**2 / 4
    bright = rate / 43.98 + 0.265**2
    np.testing.assert_allclose(noise.variance, np.where(rate > 30, bright, faint), rtol=1e-12)
    assert noise.level == noise.requested == "author"
    assert noise.short.tolist() == [False, False, False, True, True]


def test_handbook_level_is_the_photon_count_in_each_exposure():
    rate = np.array([0.0, 5.0, 200.0])
    noise = exposure_noise(rate, F160W, PLAN, "handbook")
    background = 0.7 + 0.048
    faint = ((rate + background) * 599 + 12.0**2) / (2 * 599**2)
    bright = ((rate + background) * 43.98 + 20.7**2) / 43.98**2
    saturates = (rate + background) * 599 > 77900
    assert saturates.tolist() == [False, False, True]
    np.testing.assert_allclose(noise.variance, np.where(saturates, bright, faint), rtol=1e-12)


def test_camera_without_author_level_says_that_the_handbook_was_used():
    noise = exposure_noise(np.ones((2, 2)), load_camera("WFC3-UVIS_F814W"), PLAN, "author")
    assert (noise.requested, noise.level) == ("author", "handbook")


def test_pixels_beyond_full_well_in_the_short_exposure_are_told():
    noise = exposure_noise(np.array([1.0, 2000.0]), F160W, PLAN)
    assert noise.saturated.tolist() == [False, True]


def test_every_system_of_the_catalogue_has_positive_noise():
    for name in ("HE0435", "HE1104", "SDSS1206", "WFI2033", "HE0047", "SDSS0246", "HS2209", "RXJ1131"):
        system = load_system(name)
        for level in ("author", "handbook"):
            noise = exposure_noise(np.array([-1e-9, 0, 1e3]), load_camera(system.camera), system.exposures, level)
            assert (noise.variance > 0).all()


@pytest.mark.parametrize("level", ["author", "handbook"])
def test_noise_draws_match_their_noise_map_from_empty_sky_to_the_cores(level):
    # 200 draws of 5 classes x 2000 pixels: the mean of 4e5 residuals is known to 0.0016, their deviation to
    # 0.0011; asked for is 0.01.
    rates = np.repeat([0.0, 1.0, 29.0, 31.0, 1000.0], 2000).reshape(5, 2000)
    noise = exposure_noise(rates, F160W, PLAN, level)
    rng = np.random.default_rng(7)
    residuals = np.array([draw_noise(noise, rng) / np.sqrt(noise.variance) for _ in range(200)])
    assert np.abs(residuals.mean(axis=(0, 2))).max() < 0.01
    assert np.abs(residuals.std(axis=(0, 2)) - 1).max() < 0.01


def test_photons_are_counted_one_by_one():
    # 2 e-/s for 10 s and no other noise: whole electrons, and the skewness 1/sqrt(20) of a Poisson variable.
    noise = exposure_noise(np.full(200_000, 2.0), F160W, PLAN, "author")
    bare = replace(noise, seconds=np.full(200_000, 10.0), gaussian_variance=np.zeros(200_000))
    counts = 10.0 * draw_noise(bare, np.random.default_rng(4)) + 20.0
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-9)
    deviation = (counts - 20.0) / np.sqrt(20.0)
    assert np.mean(deviation**3) == pytest.approx(1 / np.sqrt(20.0), abs=0.03)  # known to 0.006


def test_the_same_generator_gives_the_same_noise():
    noise = exposure_noise(np.full((3, 4, 5), 0.1), F160W, PLAN)
    first, second = (draw_noise(noise, np.random.default_rng(3)) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_bad_input_is_refused():
    noise = exposure_noise(np.ones(1), F160W, PLAN)
    with pytest.raises(ObservationError, match="negative"):
        draw_noise(replace(noise, gaussian_variance=np.array([-1.0])), np.random.default_rng(0))
    with pytest.raises(ObservationError, match="not finite"):
        draw_noise(replace(noise, photon_rate=np.array([np.inf])), np.random.default_rng(0))
    with pytest.raises(ObservationError, match="not finite"):
        exposure_noise(np.array([np.nan]), F160W, PLAN)
