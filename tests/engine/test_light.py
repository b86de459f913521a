"""The Sersic profile and its integration over pixels."""

import math

import numpy as np
import pytest

from engine.errors import SpecError
from engine.lensing.power_law import PowerLawLens, kernel_arguments, source_position
from engine.light.rendering import render_sersic, sample_lensed_sersic
from engine.light.sersic import SersicProfile, mean_surface_brightness, sersic_k, surface_brightness


def supersampled(profile: SersicProfile, x: np.ndarray, y: np.ndarray, h: float, n: int, lens=None) -> np.ndarray:
    """The converged reference: the plain mean over n x n points a pixel."""
    offset = ((np.arange(n) + 0.5) / n - 0.5) * h
    out = np.zeros((y.size, x.size))
    for dy in offset:
        for dx in offset:
            px, py = np.meshgrid(x + dx, y + dy)
            if lens is not None:
                px, py = source_position(lens, px, py)
            out += surface_brightness(profile, px, py)
    return out * (h / n) ** 2


def test_k_encloses_half_of_the_light() -> None:
    # Ciotti & Bertin (1999), eq. 18: the series is good to 1.2e-4 at n = 1 and better beyond.
    for n in (1.0, 2.0, 4.0, 8.0):
        series = 2 * n - 1 / 3 + 4 / (405 * n) + 46 / (25515 * n**2) + 131 / (1148175 * n**3)
        assert sersic_k(n) == pytest.approx(series, abs=2e-4 if n == 1.0 else 3e-5)


@pytest.mark.parametrize("n", [0.5, 1.0, 2.0, 4.0])
def test_total_flux_and_half_light_radius(n: float) -> None:
    profile = SersicProfile(7.0, 0.5, n, 0.7, 0.4)
    # Annuli in elliptical radius: the profile of q = 1 has the same total.
    r = np.geomspace(1e-8, 400.0, 200_001)
    round_profile = SersicProfile(7.0, 0.5, n, 1.0, 0.0)
    rings = 2 * np.pi * r * surface_brightness(round_profile, r, 0 * r)
    light = np.concatenate([[0], np.cumsum(np.diff(r) * 0.5 * (rings[1:] + rings[:-1]))])
    assert light[-1] == pytest.approx(profile.flux, rel=1e-5)
    assert np.interp(0.5, r, light) == pytest.approx(3.5, rel=1e-4)


@pytest.mark.parametrize("n", [0.5, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("r_eff", [0.05, 0.39])
def test_a_lensed_pixel_is_integrated_to_a_thousandth_of_the_peak(n: float, r_eff: float) -> None:
    lens = PowerLawLens(1.2, 0.8, 0.5, 2.0)
    profile = SersicProfile(10.0, r_eff, n, 0.7, 0.3, 0.03, 0.05)
    x = np.linspace(-1.6, 1.6, 41)
    h = float(x[1] - x[0])
    ours = render_sersic(profile, x, x, h, lens)
    # Where the reference at 48 x 48 points is not converged itself, the finest tolerance stands in for it.
    reference = render_sersic(profile, x, x, h, lens, tolerance=1e-8)
    plain = supersampled(profile, x, x, h, 48, lens)
    assert np.abs(reference - plain).max() < 3e-3 * reference.max()
    assert np.abs(ours - reference).max() < 1e-3 * reference.max()
    assert ours.sum() == pytest.approx(reference.sum(), rel=1e-4)


@pytest.mark.parametrize("n", [1.0, 4.0, 8.0])
def test_a_profile_of_a_tenth_of_a_pixel_keeps_its_flux(n: float) -> None:
    profile = SersicProfile(3.0, 0.01, n, 1.0, 0.0, 0.013, 0.021)
    x = (np.arange(61) - 30) * 0.1
    total = render_sersic(profile, x, x, 0.1).sum()
    # n = 8 has 1.4 % of its light beyond 300 half-light radii, outside the image.
    assert total == pytest.approx(3.0, rel={1.0: 1e-3, 4.0: 3e-3, 8.0: 4e-2}[n])


def test_sampled_rendering_is_the_mean_over_the_rays() -> None:
    lens = PowerLawLens(1.2, 0.8, 0.5, 2.1)
    profile = SersicProfile(10.0, 0.3, 2.0, 0.7, 0.3, 0.03, 0.05)
    x, y = np.linspace(-1, 1, 11), np.linspace(-0.8, 0.8, 9)
    ours = sample_lensed_sersic(profile, lens, x, y, 0.2, 3)
    assert np.allclose(ours, supersampled(profile, x, y, 0.2, 3, lens), rtol=1e-12)


def test_mean_surface_brightness_is_half_the_light_over_the_half_light_circle() -> None:
    assert mean_surface_brightness(20.0, 1.0) == pytest.approx(20 + 2.5 * math.log10(2 * math.pi))


@pytest.mark.parametrize(("field", "value"), [("r_eff", 0.0), ("n", 0.1), ("q", 1.5)])
def test_an_impossible_profile_is_refused_by_field(field: str, value: float) -> None:
    values = {"flux": 1.0, "r_eff": 1.0, "n": 1.0, "q": 1.0, "phi": 0.0} | {field: value}
    with pytest.raises(SpecError, match=field):
        SersicProfile(**values)


def test_the_kernels_take_what_kernel_arguments_gives() -> None:
    packed, series = kernel_arguments(PowerLawLens(1.0, 0.8, 0.0, 2.0))
    assert packed.shape == (9,)
    assert series[0] == 1.0
