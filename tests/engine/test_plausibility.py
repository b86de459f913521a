"""What is said of an observation before it is fitted: that it is none of a lens, that it cannot be, that it is odd."""

import re
from dataclasses import replace

import numpy as np
import pytest

from engine import (
    Host,
    ObservationError,
    Realization,
    SpecError,
    load_system,
    measure_image,
    simulate_realization,
)
from engine.imaging.observation import Observation
from engine.imaging.optics.stamp import StampOptics
from engine.light.sersic import SersicProfile
from engine.parametric.detectability import why_no_lens
from engine.plausibility import require_lens, sky_scatter, unlikely
from engine.simulation.simulate import Simulation

SIGMA, SCALE = 0.005, 0.08
PSF = np.exp(-0.5 * np.add.outer((np.arange(31) - 15.0) ** 2, (np.arange(31) - 15.0) ** 2) / 1.1**2)
PSF /= PSF.sum()


def seen(light: np.ndarray | float = 0.0, side: int = 70, **changes: object) -> Observation:
    noise = SIGMA * np.random.default_rng(4).standard_normal((side, side))
    parts = {"psf": PSF, "pixel_scale": SCALE, "zero_point": 25.9} | changes
    return Observation(noise + light, np.full((side, side), SIGMA), **parts)  # type: ignore[arg-type]


def optics(side: int = 70) -> StampOptics:
    return StampOptics(PSF, (side, side), SCALE)


def galaxy(flux: float = 60.0, side: int = 70) -> np.ndarray:
    return optics(side).sersic_image(SersicProfile(flux, 0.6, 4.0, 0.7, 0.3, 0.03, -0.02))


@pytest.fixture(scope="module")
def lens(simulation: Simulation) -> Observation:
    return replace(simulation.observation, response=None, covariance=None)


def test_noise_alone_one_star_and_a_galaxy_without_an_arc_are_no_lens() -> None:
    for light, said in (
        (0.0, "nothing stands out"),
        (50.0 * optics().point_source(0.33, -0.21), "one point source"),
        (1.0 * optics().point_source(-2.1, 1.7), "one point source"),
        (galaxy(), "one galaxy"),
    ):
        observation = seen(light)
        assert said in (why_no_lens(observation) or "")
        with pytest.raises(ObservationError, match=f"image: {said}.*no lens to measure"):
            measure_image(observation, inversion=False)
    assert require_lens(seen(), trusting=True) == ("image: nothing stands out of its noise",)


def test_a_drizzled_deflector_is_no_lens_until_an_arc_is_behind_it() -> None:
    # Its pixels share noise, its noise map allows for that, and its core is not the moved stamp of its PSF.
    system = replace(load_system("HE0435"), agn=())
    for magnitude, said in ((32.0, "one galaxy"), (24.5, None)):
        spec = Realization(system=system, l_eta=1.0, host=Host(n=2.0, r_eff=0.3, magnitude=magnitude))
        observation = replace(simulate_realization(spec).observation, response=None, covariance=None)
        reason = why_no_lens(observation)
        assert reason is None if said is None else said in (reason or "")


def test_a_noise_map_that_is_wrong_by_half_makes_no_lens_of_noise_and_no_noise_of_a_lens(lens: Observation) -> None:
    for factor in (0.67, 1.5):
        noise = seen()
        assert why_no_lens(replace(noise, noise=factor * noise.noise)) is not None
        assert why_no_lens(replace(lens, noise=factor * lens.noise)) is None


def test_whatever_has_a_second_source_or_an_arc_may_be_a_lens(lens: Observation) -> None:
    assert why_no_lens(lens) is None
    star = 50.0 * optics().point_source(0.33, -0.21)
    assert why_no_lens(seen(star + 0.5 * optics().point_source(-1.0, 0.6))) is None
    y, x = np.indices((70, 70)) - 34.5
    ring = 0.02 * np.exp(-0.5 * ((np.hypot(x, y) - 13.0) / 1.5) ** 2)
    # A full ring has the galaxy's own symmetry, so that only the fit of the galaxy finds it.
    assert why_no_lens(seen(galaxy() + ring)) is None
    # A crop of nothing but arcs and images has no empty sky to compare with.
    half = lens.shape[0] // 2
    middle = slice(half - 20, half + 20)
    crop = Observation(lens.image[middle, middle], lens.noise[middle, middle], lens.psf, SCALE, lens.zero_point)
    assert why_no_lens(crop) is None


def test_a_good_observation_has_nothing_odd_about_it(lens: Observation) -> None:
    assert unlikely(lens) == ()


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"zero_point": 1e6}, "zero_point: got 1e"),
        ({"pixel_scale": 3600.0}, "pixel_scale: got 3.6e"),
        ({"noise": lambda seen: seen.noise**2}, "noise: the sky scatters by .* variance or weight"),
        ({"noise": lambda seen: np.full(seen.shape, 2000.0)}, "noise: the sky scatters"),
        ({"psf": lambda seen: seen.image[:-1, :-1] if seen.shape[0] % 2 == 0 else seen.image}, "psf: "),
        (
            {"image": np.zeros((3, 3)), "noise": np.ones((3, 3)), "valid": None},
            "3 x 3 pixels",
        ),
    ],
)
def test_what_cannot_be_is_refused_by_name_and_told_where_it_is_trusted(
    lens: Observation, change: dict[str, object], complaint: str
) -> None:
    changes = {name: value(lens) if callable(value) else value for name, value in change.items()}
    if "psf" in changes:
        side = changes["psf"].shape[0]  # type: ignore[attr-defined]  # an array
        changes |= {"image": lens.image[:side, :side], "noise": lens.noise[:side, :side], "valid": None}
    observation = replace(lens, **changes)
    with pytest.raises(ObservationError, match=complaint):
        unlikely(observation)
    with pytest.raises(ObservationError, match=complaint):
        measure_image(observation, inversion=False)


@pytest.mark.parametrize(
    ("change", "warning"),
    [
        ({"zero_point": 14.0}, "zero_point: 14"),
        ({"zero_point": 15.5}, "image: 6.* mag of all its light"),
        ({"pixel_scale": 1.2}, "pixel_scale: 1.2"),
        ({"pixel_scale": 0.4}, "psf: .* arcsec wide"),
        ({"psf": lambda seen: seen.psf + 1e-3}, "psf: a pedestal"),
        (
            {"psf": lambda seen: np.kron(seen.psf[20:-20, 20:-20], np.ones((3, 3)))},
            "psf: the image has a peak [2-5].. times as sharp",
        ),
    ],
)
def test_what_is_unlikely_is_warned_of_by_name(lens: Observation, change: dict[str, object], warning: str) -> None:
    changes = {name: value(lens) if callable(value) else value for name, value in change.items()}
    told = unlikely(replace(lens, **changes))
    assert any(re.match(warning, note) for note in told), told


@pytest.mark.parametrize(
    ("factor", "told"), [(4.0, "noise: .* by 0.2"), (1 / 3.0, "noise: .* by (2.9|3)"), (1.5, ""), (0.67, "")]
)
def test_a_noise_map_that_is_far_from_the_scatter_is_warned_of(factor: float, told: str) -> None:
    observation = seen(galaxy())
    notes = unlikely(replace(observation, noise=factor * observation.noise))
    assert [re.match(told, note) is not None for note in notes] == ([True] if told else [])


def test_the_scatter_over_the_map_is_that_of_the_sky(lens: Observation) -> None:
    # 1,200 pixels tell it to 3 %; the median that is taken off takes 1 % of the variance.
    assert sky_scatter(seen(galaxy())) == pytest.approx((1.0, 1.0), abs=0.1)
    assert sky_scatter(seen(side=18)) is None
    least, most = sky_scatter(lens) or (0.0, 0.0)
    assert sky_scatter(replace(lens, noise=2.0 * lens.noise)) == pytest.approx((0.5 * least, 0.5 * most))
    # A crop has arcs where its sky is faintest; they raise the upper bound alone.
    half = lens.shape[0] // 2
    middle = slice(half - 18, half + 18)
    crop = Observation(lens.image[middle, middle], lens.noise[middle, middle], lens.psf, SCALE, lens.zero_point)
    assert unlikely(crop) == ()


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"theta_E": float("nan")}, "theta_E"),
        ({"theta_E": 0.0}, "theta_E"),
        ({"positions": [(float("nan"), 0.0)]}, "positions"),
        ({"positions": [(0.5, 50.0)]}, "positions"),
    ],
)
def test_hints_that_are_no_numbers_or_off_the_image_are_refused(
    lens: Observation, options: dict[str, object], field: str
) -> None:
    with pytest.raises(SpecError, match=field):
        measure_image(lens, inversion=False, **options)  # type: ignore[arg-type]
