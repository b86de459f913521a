"""Deflectors that are no Sersic profiles, lenses off the middle, and what else shines in an image."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from engine import Observation, measure_image, read_external_observation
from engine.conventions import FloatArray
from engine.imaging.bad_pixels import lone_pixels
from engine.lensing.power_law import PowerLawLens
from engine.light.sersic import SersicProfile
from engine.neighbours import without_neighbours
from engine.parametric.fit import ParametricFit, fit_parametric
from engine.parametric.galaxy_light import GalaxyImages, GalaxyLight, first_light, non_negative
from engine.parametric.starts import deflector_centre, off_centre
from engine.simulation.simulate import Simulation
from engine.status import prior_dominated, status_of

SHARED_DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data"
SCALE, SIDE = 0.08, 61
LENS = PowerLawLens(1.1, 0.8, 0.4, 2.05)


def _psf(side: int = 21, width: float = 1.0) -> FloatArray:
    y, x = np.mgrid[:side, :side] - side // 2
    star = np.exp(-(x**2 + y**2) / (2.0 * width**2))
    return np.asarray(star / star.sum())


def _galaxy_and_arc(seed: int = 3) -> Observation:
    """A bulge, a disc across it and a halo, brighter than the arc behind them wherever it is."""
    empty = Observation(np.zeros((SIDE, SIDE)), np.ones((SIDE, SIDE)), _psf(), SCALE, 25.9463)
    light = [
        (SersicProfile(100.0, 0.2, 2.0, 0.7, 0.4), None),
        (SersicProfile(250.0, 0.7, 0.8, 0.5, 2.0), None),
        (SersicProfile(200.0, 2.0, 1.5, 0.85, 0.4), None),
        (SersicProfile(5.0, 0.15, 1.0, 0.8, 1.0, 0.08, -0.05), LENS),
    ]
    image = sum(empty.optics.sersic_image(profile, lens) for profile, lens in light)
    noise = np.sqrt(1e-4 + np.asarray(image) / 2000.0)
    return replace(empty, image=image + np.random.default_rng(seed).normal(0.0, noise), noise=noise)


def test_a_lens_behind_a_bulge_a_disc_and_a_halo_is_found() -> None:
    seen = _galaxy_and_arc()
    fit = fit_parametric(seen, agn_images=0, shear=False, real_galaxy=True)
    assert fit.deflector is None
    assert len(fit.deflector_gaussians) > 4
    # A hundredth is what arcs of this brightness are worth; one Sersic profile misses by more.
    assert fit.lens.theta_E == pytest.approx(LENS.theta_E, rel=0.01)
    assert fit.chi2 / fit.degrees_of_freedom < 1.2
    # Three times the error that a host of a fiftieth of the light can be hoped to have.
    assert -2.5 * math.log10(fit.host.flux / 5.0) == pytest.approx(0.0, abs=0.3)
    total = sum(one.flux for one in fit.deflector_gaussians)
    assert total == pytest.approx(550.0, rel=0.15), "the halo reaches beyond the image"


def test_one_sersic_profile_stays_one(simulation: Simulation) -> None:
    fit = fit_parametric(simulation.observation, agn_images=4, real_galaxy=True)
    assert fit.deflector is not None
    assert fit.deflector_gaussians == ()
    assert fit.arc_error == 0.0


def test_derivatives_of_gaussians_are_those_of_their_images() -> None:
    seen = Observation(np.zeros((31, 31)), np.ones((31, 31)), _psf(), SCALE, 25.0)
    images = GalaxyImages(seen, (slice(0, 31), slice(0, 31)))
    light = first_light((0.03, -0.02), 1.2, SCALE, (0.1, 0.05))
    fluxes = np.random.default_rng(0).uniform(0.5, 1.5, light.size)
    found, step = images.derivatives(light, fluxes), 1e-5

    def moved(k: int, by: float) -> GalaxyLight:
        values = np.array([*light.centre, *np.ravel(light.ellipses)])
        values[k] += by
        pairs = tuple((float(a), float(b)) for a, b in values[2:].reshape(-1, 2))
        return GalaxyLight((float(values[0]), float(values[1])), pairs, light.widths)

    for k in range(len(found)):
        difference = np.tensordot(fluxes, images(moved(k, step)) - images(moved(k, -step)), axes=1) / (2.0 * step)
        # Central differences of smooth functions are good to the square of the step.
        assert np.abs(found[k] - difference).max() < 1e-6 * np.abs(difference).max()


def test_amplitudes_that_may_not_be_negative_are_not() -> None:
    rng = np.random.default_rng(1)
    columns = rng.normal(size=(50, 4))
    data = columns @ np.array([2.0, -1.0, 3.0, -4.0])
    found = non_negative(columns, data, np.array([False, False, False, True]))
    assert found[1] == 0.0
    assert found[3] < 0.0
    free = non_negative(columns, data, np.ones(4, dtype=bool))
    assert free == pytest.approx([2.0, -1.0, 3.0, -4.0], abs=1e-6)


def test_a_deflector_off_the_middle_is_found_and_one_in_it_is_left_there(simulation: Simulation) -> None:
    seen = simulation.observation
    assert off_centre(seen.image, seen.noise, seen.pixel_scale) is None
    by = 10
    image, noise = (values[by:, :-by] for values in (seen.image, seen.noise))
    rough = off_centre(image, noise, seen.pixel_scale)
    assert rough is not None
    found = deflector_centre(image, seen.pixel_scale, rough)
    # Cut off one side, the middle moves by half of it.
    assert found == pytest.approx((0.5 * by * seen.pixel_scale, -0.5 * by * seen.pixel_scale), abs=0.05)


def test_a_hot_pixel_is_masked_and_a_star_is_not(simulation: Simulation) -> None:
    seen = simulation.observation
    assert np.argwhere(lone_pixels(seen)).tolist() == [], "AGN images are no hot pixels"
    image = seen.image.copy()
    image[20, 12] += float(image.max())
    bad = lone_pixels(replace(seen, image=image))
    assert np.argwhere(bad).tolist() == [[20, 12]]


def test_a_star_beside_the_lens_is_subtracted(wide: Simulation) -> None:
    seen = wide.observation
    fit = fit_parametric(seen, agn_images=4)
    assert without_neighbours(seen, fit) == (seen, [])
    star = 20.0 * seen.point_source(2.9, -1.6)
    cleaned, told = without_neighbours(replace(seen, image=seen.image + star), fit)
    assert len(told) == 1
    assert "star at 2.9" in told[0]
    # What is left of it is a hundredth, and its core is masked.
    left = np.where(cleaned.valid, cleaned.image - seen.image, 0.0)
    assert np.abs(left).max() < 0.01 * star.max()


def test_a_host_at_a_bound_is_never_ok(simulation: Simulation, fit: ParametricFit) -> None:
    found = measure_image(simulation.observation, agn_images=4, shear=False, inversion=False)
    assert found.status == "ok"
    assert prior_dominated(fit) == fit.at_bound == ()
    assert status_of(replace(fit, at_bound=("host.n",)), found.host, 1.0) == "prior_dominated"
    assert status_of(fit, found.host, 1.6) == "poor_fit"
    faint = replace(found.host, magnitude=replace(found.host.magnitude, sd=0.5))
    # A plain arc is there, whatever is known of its host's light.
    assert status_of(fit, faint, 1.0) == "prior_dominated"
    assert status_of(replace(fit, arc=1e-3 * fit.arc), faint, 1.0) == "not_detected"


@pytest.mark.parametrize(("name", "theta_E"), [("J1627-0053", 1.23)])
def test_the_arcs_of_a_real_galaxy_are_found(name: str, theta_E: float) -> None:
    folder = SHARED_DATA / "slacs" / name
    if not folder.is_dir():
        pytest.skip("the foreign example data (shared/data beside the project) are not here")
    seen = read_external_observation(
        folder / "image.fits", folder / "psf.fits", noise=folder / "noise.fits", pixel_scale=0.05, zero_point=25.94,
        recentre_psf="pixel", normalise_psf=True, mend_psf=True,
    )  # fmt: skip
    found = measure_image(seen, agn_images=0, inversion=False)
    # The literature's is good to 3 %.
    assert found.lens["theta_E"].mean == pytest.approx(theta_E, rel=0.03)
    assert found.status == "ok"
    assert found.host.r_eff.mean < 0.5 * theta_E
