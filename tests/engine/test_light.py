"""The Sersic profile and its integration over pixels, against fluxes made in other ways (light_oracle)."""

import math

import numpy as np
import pytest
from scipy.ndimage import maximum_filter

from engine.accuracy.light_reference import flux_through_the_sides, graded_fluxes, supersampled
from engine.errors import SpecError
from engine.lensing.power_law import PowerLawLens, source_position
from engine.light import radial_table, refinement, rendering
from engine.light.brightness_bounds import brightness_range
from engine.light.radial_table import brightness, tabulate, to_profile_axes
from engine.light.rendering import render_sersic, sample_sersic
from engine.light.sersic import SersicProfile, mean_surface_brightness, sersic_constants, sersic_k, surface_brightness
from tests.engine.light_oracle import GRID, HE0435, assert_as_promised

# The profile


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


@pytest.mark.parametrize(("field", "value"), [("r_eff", 0.0), ("n", 0.1), ("q", 1.5)])
def test_an_impossible_profile_is_refused_by_field(field: str, value: float) -> None:
    values = {"flux": 1.0, "r_eff": 1.0, "n": 1.0, "q": 1.0, "phi": 0.0} | {field: value}
    with pytest.raises(SpecError, match=field):
        SersicProfile(**values)


def test_mean_surface_brightness_is_half_the_light_over_the_half_light_circle() -> None:
    assert mean_surface_brightness(20.0, 1.0) == pytest.approx(20 + 2.5 * math.log10(2 * math.pi))


# The parts of the rendering


@pytest.mark.parametrize("n", [0.2, 0.5, 1.0, 2.0, 4.0, 8.0, 20.0])
def test_the_radial_table_gives_the_brightness(n: float) -> None:
    profile = SersicProfile(1.0, 0.3, n, 0.7, 0.4, 0.1, -0.2)
    rng = np.random.default_rng(1)
    r, angle = 0.3 * 10 ** rng.uniform(-9, 3, 200_000), rng.uniform(0, 2 * np.pi, 200_000)
    x, y = 0.1 + r * np.cos(angle), -0.2 + r * np.sin(angle)
    u, v = to_profile_axes(x, y, sersic_constants(profile))
    ours, exact = brightness(u, v, tabulate(profile)), surface_brightness(profile, x, y)
    assert ours.min() >= 0.0
    assert np.abs(ours - exact).max() < 2e-7 * exact.max()
    if n >= 4:
        seen = exact > 1e-12 * exact.max()
        assert np.abs(ours / exact - 1)[seen].max() < 1e-6


def test_the_radial_table_takes_any_radius() -> None:
    table = tabulate(SersicProfile(1.0, 1.0, 4.0, 1.0, 0.0))
    values = brightness(np.array([0.0, 1e-300, 1e30, np.inf, np.nan]), np.zeros(5), table)
    assert values[0] == values[1] == pytest.approx(table[0, 0])
    assert np.all(values[2:] < 1e-40 * values[0])


@pytest.mark.parametrize("powers", [(0, 0), (1, 1), (2, 0), (0, 2), (2, 2), (4, 0), (0, 4), (5, 0), (3, 2)], ids=str)
def test_the_mean_over_a_pixel_is_exact_for_quintics(powers: tuple[int, int]) -> None:
    def mean(power: int, centre: float) -> float:
        return ((centre + 0.5) ** (power + 1) - (centre - 0.5) ** (power + 1)) / (power + 1)

    px, py = np.meshgrid(np.arange(-2.0, 3.0), np.arange(-2.0, 3.0))
    f = 100.0 + (px + 0.3) ** powers[0] * (py - 0.2) ** powers[1]
    # A profile that is bright at the pixel's centre and dark a pixel away, so that its bounds leave the mean alone.
    table = tabulate(SersicProfile(1.0, 1e-3, 1.0, 1.0, 0.0))
    means, errors = np.empty((1, 1)), np.empty((1, 1))
    rendering._average(1e3 * px, 1e3 * py, f, table, means, errors)
    assert means[0, 0] == pytest.approx(100.0 + mean(powers[0], 0.3) * mean(powers[1], -0.2), abs=1e-12)


def test_errors_spread_to_neighbours_and_sum_below_a_limit() -> None:
    error = np.random.default_rng(0).exponential(size=(13, 9))
    assert np.array_equal(rendering._greatest_of_neighbours(error), maximum_filter(error, 3, mode="nearest"))
    assert rendering._sum_below(error, 1.0) == pytest.approx(error[error <= 1.0].sum())


def test_the_bounds_hold_in_bent_parallelograms() -> None:
    rng = np.random.default_rng(2)
    table = tabulate(SersicProfile(1.0, 1.0, 2.0, 1.0, 0.0))
    s, t = (g.ravel() for g in np.meshgrid(np.linspace(-1, 1, 21), np.linspace(-1, 1, 21)))
    smooth_ones = 0
    for _ in range(500):
        u, v, ax, ay, bx, by = rng.normal(size=6) * rng.choice([0.03, 0.3, 1.0], 6)
        cu, cv = rng.normal(size=2) * 0.05
        inside = brightness(u + s * ax + t * bx + s * t * cu, v + s * ay + t * by + s * t * cv, table)
        least, most, smooth = brightness_range(u, v, ax, ay, bx, by, math.hypot(cu, cv), 0.75, table)
        assert least <= inside.min() * (1 + 1e-9)
        assert most >= inside.max() * (1 - 1e-9)
        smooth_ones += smooth
    assert 50 < smooth_ones < 450


def test_a_cell_is_integrated_by_the_nine_point_rule() -> None:
    profile = SersicProfile(1.0, 0.5, 1.0, 0.7, 0.4)
    light, table = sersic_constants(profile), tabulate(profile)
    # Far from the cusp one cell is enough, and the rule is that of any textbook.
    nodes, weights = np.polynomial.legendre.leggauss(3)
    x, y = np.meshgrid(1.0 + 0.005 * nodes, 0.7 + 0.005 * nodes)
    expected = (surface_brightness(profile, x, y) * np.outer(weights, weights)).sum() * 0.005**2
    ours, _ = refinement.refine_pixels(
        np.array([1.0]), np.array([0.7]), 0.01, lambda a, b: to_profile_axes(a, b, light), table, absolute=1.0
    )
    assert ours[0] == pytest.approx(expected, rel=1e-6)


# Without a lens


def test_the_oracles_agree() -> None:
    for n, r_eff in ((0.5, 0.05), (4.0, 0.2)):
        profile = SersicProfile(3.0, r_eff, n, 0.2, 0.4, 0.013, 0.05)
        x = (np.arange(9) - 4) * 0.1
        sides = flux_through_the_sides(profile, x, x, 0.1)
        assert np.abs(graded_fluxes(profile, x, x, 0.1) - sides).max() < 1e-7 * sides.max()


@pytest.mark.parametrize("tolerance", [1e-2, 1e-3, 1e-4, 1e-5, 1e-6])
def test_the_error_stays_below_the_tolerance(tolerance: float) -> None:
    x = (np.arange(21) - 10) * 0.1
    for n in (1.0, 4.0):
        profile = SersicProfile(3.0, 0.2, n, 0.5, 0.4, 0.013, 0.021)
        reference = flux_through_the_sides(profile, x, x, 0.1)
        ours = render_sersic(profile, x, x, 0.1, tolerance=tolerance)
        # The flux includes the radial table's own error, which does not come under the tolerance.
        assert np.abs(ours - reference).max() < max(tolerance, 1e-6) * reference.max()
        assert ours.sum() == pytest.approx(reference.sum(), rel=max(tolerance, 2e-6))


def test_a_deflector_on_a_large_field() -> None:
    # RXJ1131's sampling: 0.0125 arcsec, a deflector as wide as the field.
    profile = SersicProfile(100.0, 3.185, 4.59, 0.783, 0.496, 0.0013, -0.004)
    x = (np.arange(60) - 29.5) * 0.0125
    assert_as_promised(render_sersic(profile, x, x, 0.0125), flux_through_the_sides(profile, x, x, 0.0125))


# Behind a lens

SCENES = {
    "quad": (HE0435, (0.03, 0.05)),
    "on the axis": (HE0435, (0.0, 0.0)),
    "flat": (PowerLawLens(1.2, 0.2, 0.5, 2.2), (0.03, 0.05)),
    "sheared": (PowerLawLens(1.2, 0.8, 0.5, 1.9, 0.0, 0.0, 0.25, 0.15), (0.03, 0.05)),
    "central image": (PowerLawLens(1.2, 0.7, 0.5, 1.4), (0.03, 0.05)),
    "steep": (PowerLawLens(1.2, 0.7, 0.5, 2.7, 0.04, 0.04), (0.2, 0.05)),
    "far from the axis": (HE0435, (0.9, 0.5)),
    "cusp on a corner": (HE0435, None),
}


def host_of(scene: str, n: float, r_eff: float) -> tuple[PowerLawLens, SersicProfile]:
    lens, centre = SCENES[scene]
    if centre is None:
        corner = source_position(lens, GRID[34:35] + 0.04, GRID[25:26] + 0.04)
        centre = (corner[0].item(), corner[1].item())
    return lens, SersicProfile(10.0, r_eff, n, 0.7, 0.3, *centre)


@pytest.mark.parametrize(
    ("n", "r_eff"),
    [
        (1.0, 0.39),
        (4.0, 0.05),
        *(
            pytest.param(*host, marks=pytest.mark.long)
            for host in ((0.5, 0.39), (1.0, 0.008), (4.0, 0.39), (8.0, 0.05))
        ),
    ],
)
@pytest.mark.parametrize("scene", SCENES)
def test_a_lensed_host_is_integrated_to_the_tolerance(scene: str, n: float, r_eff: float) -> None:
    lens, profile = host_of(scene, n, r_eff)
    ours = render_sersic(profile, GRID, GRID, 0.08, lens)
    assert_as_promised(ours, graded_fluxes(profile, GRID, GRID, 0.08, lens))


# Structure


def test_without_a_lens_nothing_is_deflected(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("a ray was traced")

    monkeypatch.setattr(rendering, "trace_rays", refuse)
    profile = SersicProfile(1.0, 0.2, 4.0, 0.7, 0.3)
    render_sersic(profile, GRID, GRID, 0.08)
    with pytest.raises(AssertionError, match="traced"):
        render_sersic(profile, GRID, GRID, 0.08, HE0435)


def test_work_goes_where_the_brightness_varies(monkeypatch: pytest.MonkeyPatch) -> None:
    rays: list[int] = []
    trace = rendering.trace_rays

    def counted(x: np.ndarray, *rest: object) -> None:
        rays.append(x.size)
        trace(x, *rest)

    monkeypatch.setattr(rendering, "trace_rays", counted)
    x = (np.arange(161) - 80) * 0.02

    def cost(n: float, r_eff: float) -> int:
        rays.clear()
        render_sersic(SersicProfile(1.0, r_eff, n, 0.7, 0.3, 0.03, 0.05), x, x, 0.02, HE0435)
        return sum(rays)

    # One ray a pixel at least; uniform supersampling has 64 or more and does not reach the same error.
    assert x.size**2 < cost(0.5, 0.39) < 4 * x.size**2
    assert cost(1.0, 0.39) < cost(4.0, 0.39) < cost(4.0, 0.05) < 27 * x.size**2


def test_the_same_bits_every_time_and_flux_is_linear() -> None:
    _, profile = host_of("quad", 4.0, 0.05)
    first = render_sersic(profile, GRID, GRID, 0.08, HE0435)
    assert np.array_equal(first, render_sersic(profile, GRID, GRID, 0.08, HE0435))
    twice = SersicProfile(20.0, profile.r_eff, profile.n, profile.q, profile.phi, profile.x, profile.y)
    assert np.array_equal(2 * first, render_sersic(twice, GRID, GRID, 0.08, HE0435))


def test_a_single_pixel_and_a_reversed_axis_are_parts_of_the_same_image() -> None:
    _, profile = host_of("quad", 1.0, 0.39)
    whole = render_sersic(profile, GRID, GRID, 0.08, HE0435)
    peak = whole.max()
    one = render_sersic(profile, GRID[5:6], GRID[7:8], 0.08, HE0435)
    assert one.shape == (1, 1)
    assert one[0, 0] == pytest.approx(whole[7, 5], abs=2e-4 * peak)
    mirrored = render_sersic(profile, GRID[::-1].copy(), GRID, 0.08, HE0435)
    assert np.abs(mirrored[:, ::-1] - whole).max() < 2e-4 * peak


def test_what_cannot_be_rendered_is_refused_by_name() -> None:
    profile = SersicProfile(1.0, 0.2, 4.0, 0.7, 0.3)
    with pytest.raises(SpecError, match="tolerance"):
        render_sersic(profile, GRID, GRID, 0.08, tolerance=0.0)
    with pytest.raises(SpecError, match=r"(?s)y: .*pixel_scale"):
        render_sersic(profile, GRID, GRID * 1.1, 0.08)


def test_sampled_rendering_is_the_mean_over_the_rays() -> None:
    lens = PowerLawLens(1.2, 0.8, 0.5, 2.1)
    profile = SersicProfile(10.0, 0.3, 2.0, 0.7, 0.3, 0.03, 0.05)
    x, y = np.linspace(-1, 1, 11), np.linspace(-0.8, 0.8, 9)
    rays_x, rays_y = (np.add.outer(axis, 0.2 * np.array([-1.0, 0.0, 1.0]) / 3.0).ravel() for axis in (x, y))
    ours = sample_sersic(profile, lens, rays_x, rays_y, 0.2 / 3).reshape(9, 3, 11, 3).sum(axis=(1, 3))
    # The radial table is within 1e-7 of the profile here.
    assert np.allclose(ours, supersampled(profile, x, y, 0.2, 3, lens), rtol=1e-7)


def test_whole_numbers_are_the_same_lens_and_the_same_profile_to_the_kernels() -> None:
    lens, whole = PowerLawLens(1.0, 1.0, 0.0, 2.0), PowerLawLens(1, 1, 0, 2)
    profile, round_one = SersicProfile(1.0, 1.0, 1.0, 1.0, 0.0), SersicProfile(1, 1, 1, 1, 0)
    assert {type(value) for value in sersic_constants(round_one)} == {float}
    expected = render_sersic(profile, GRID, GRID, 0.08, lens)
    assert np.array_equal(render_sersic(round_one, GRID, GRID, 0.08, whole), expected)
    assert radial_table.tabulate(SersicProfile(1.0, 1.0, 1.0, 1.0, 0.0)).shape[1] == 4
