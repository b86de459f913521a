"""What a model of an image may be wrong by is learned from the image, marginalised, and nothing where it is right."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage, stats

from engine import Host, Realization, simulate_realization
from engine.conventions import FloatArray, rate_to_magnitude
from engine.imaging.observation import Observation
from engine.light.derivatives import LightDerivatives
from engine.light.sersic import SersicProfile, surface_brightness
from engine.parametric.fit import Acceptance, ParametricFit, fit_parametric
from engine.parametric.psf_error import stamp_modes
from engine.parametric.shared_error import STRENGTHS, SharedError, likeliest_errors
from engine.parametric.source_error import _from_axes, _to_axes, profile_modes
from engine.simulation.scene import Scene
from engine.simulation.simulate import Simulation
from tests.engine.conftest import cut

PIXELS, MODES = 60, 7


@pytest.fixture
def columns() -> FloatArray:
    return np.random.default_rng(3).normal(size=(PIXELS, MODES)) * np.geomspace(3.0, 0.1, MODES)


def dense(columns: FloatArray) -> FloatArray:
    """The covariance of whitened pixels that share errors."""
    return np.asarray(np.eye(len(columns)) + columns @ columns.T)


def test_pixels_are_decorrelated_by_the_root_of_their_dense_covariance(columns: FloatArray) -> None:
    values = np.random.default_rng(4).normal(size=(PIXELS, 3))
    shared = SharedError(columns, np.zeros(MODES), MODES)
    variance, vectors = np.linalg.eigh(dense(columns))
    root = vectors @ np.diag(variance**-0.5) @ vectors.T
    # Directions below 0.05 of the noise are left out: 0.001 of a value.
    assert shared.decorrelated(values) == pytest.approx(root @ values, abs=2e-3)
    # Of 60 pixels with seven modes: the trace of the part of the data that they explain.
    assert shared.effective_parameters == pytest.approx(PIXELS - np.trace(np.linalg.inv(dense(columns))), abs=0.01)


def test_amplitudes_are_those_of_the_dense_normal_posterior(columns: FloatArray) -> None:
    residual = np.random.default_rng(5).normal(size=PIXELS)
    shared = SharedError(columns, np.zeros(MODES), MODES)
    expected = columns.T @ np.linalg.solve(dense(columns), residual)
    assert shared.amplitudes(residual) == pytest.approx(expected, abs=1e-10)


def test_the_strength_is_that_of_the_greatest_dense_evidence(columns: FloatArray) -> None:
    rng = np.random.default_rng(6)
    sigma = rng.uniform(0.5, 2.0, PIXELS)
    other = rng.normal(size=(PIXELS, 4))
    residual = sigma * rng.normal(size=PIXELS) + 0.8 * (columns * sigma[:, None]) @ rng.normal(size=MODES)
    kinds = [columns * sigma[:, None], 0.01 * other]
    found = likeliest_errors(kinds, residual, [(1.0, sigma), (2.0, 2.0 * sigma)])

    def ln_evidence(strengths: tuple[float, ...], left: float) -> float:
        covariance = np.diag((left * sigma) ** 2)
        for strength, kind in zip(strengths, kinds, strict=True):
            covariance = covariance + strength**2 * kind @ kind.T
        return float(stats.multivariate_normal(cov=covariance).logpdf(residual))

    assert found.left == 1.0
    best = ln_evidence(found.strengths, found.left)
    for strength in STRENGTHS:
        assert ln_evidence((strength, found.strengths[1]), 1.0) <= best + 1e-9
    without = max(ln_evidence((0.0, 0.0), left) for left in (1.0, 2.0))
    assert found.gain == pytest.approx(best - without, abs=1e-8)


def test_an_error_of_a_stamp_makes_no_light_and_stays_where_the_stamp_shines(simulation: Simulation) -> None:
    modes = stamp_modes(simulation.observation.psf)
    assert np.abs(modes.sum(axis=(1, 2))).max() < 1e-10
    # The deviation of the error at each pixel, in proportion to the smoothed stamp there.
    deviation = np.sqrt((modes**2).sum(axis=0))
    psf = simulation.observation.psf
    middle = psf.shape[0] // 2
    assert 0.4 * psf.max() < deviation[middle, middle] < psf.max()
    assert deviation[middle + 10, middle] < 0.02 * psf.max()


def test_what_another_profile_would_explain_is_no_departure_of_a_host() -> None:
    profile = SersicProfile(1.0, 0.3, 1.5, 0.7, 0.4, 0.05, -0.02)
    modes = profile_modes(profile)
    nodes = modes.shape[1]
    side = 7.0 / nodes
    axis = (np.arange(nodes) + 0.5) * side - 3.5
    v, u = np.meshgrid(axis, axis, indexing="ij")
    x, y = _from_axes(profile, u, v)
    assert np.stack(_to_axes(profile, x, y)) == pytest.approx(np.stack([u, v]), abs=1e-12)
    light = surface_brightness(profile, x, y)
    others = np.stack([light.ravel(), *LightDerivatives(profile, None).at(x.ravel(), y.ravel())])
    others /= np.linalg.norm(others, axis=1)[:, None]
    shapes = (modes * light).reshape(len(modes), -1)
    assert np.abs(shapes @ others.T).max() < 1e-9 * np.linalg.norm(shapes, axis=1).max()


def as_others_see_it(simulation: Simulation, psf: FloatArray) -> Observation:
    """The image with a stamp, of which alone the optics are known."""
    return replace(simulation.observation, psf=psf, response=None, covariance=None)


@pytest.fixture(scope="module")
def misled(simulation: Simulation) -> ParametricFit:
    """The fit with a stamp that is 12 % broader than the PSF along one axis, and lopsided."""
    psf = ndimage.gaussian_filter(simulation.observation.psf, (0.5, 0.2))
    psf = psf + 0.1 * (ndimage.shift(psf, (0.0, 1.0), order=3) - psf)
    return fit_parametric(as_others_see_it(simulation, psf), agn_images=4)


def test_a_stamp_that_is_wrong_is_corrected_and_the_host_is_that_of_the_truth(
    misled: ParametricFit, scene: Scene, simulation: Simulation
) -> None:
    error = misled.error
    assert error is not None
    assert error.psf in (0.02, 0.05, 0.1, 0.2)
    true = simulation.observation.psf
    given = misled.psf - error.correction
    # Half of its error at most stays: what the noise of four AGN images hides, and what no mode can be.
    wrong = [float(np.abs(stamp - true).sum()) for stamp in (misled.psf, given)]
    assert wrong[0] < 0.5 * wrong[1]
    magnitude = rate_to_magnitude(misled.host.flux, simulation.observation.zero_point)
    sd = 2.5 / math.log(10.0) * math.sqrt(misled.hosts["wide"].covariance[0, 0])
    assert magnitude == pytest.approx(20.5, abs=3 * sd)
    assert sd < 0.1
    for name in ("theta_E", "q", "slope"):
        at = misled.lens_names.index(name)
        known = math.sqrt(misled.lens_covariance[at, at])
        assert getattr(misled.lens, name) == pytest.approx(getattr(scene.lens, name), abs=3 * known + 1e-3)


def test_a_stamp_that_is_right_is_left_alone_and_costs_no_precision(
    simulation: Simulation, misled: ParametricFit
) -> None:
    right = fit_parametric(as_others_see_it(simulation, simulation.observation.psf), agn_images=4)
    strength = 0.0 if right.error is None else right.error.psf
    # Drizzled images of stars differ from each other by a part in a hundred.
    assert strength <= 0.02
    assert right.error is None or right.error.host == 0.0
    sd = [math.sqrt(fit.hosts["wide"].covariance[0, 0]) for fit in (misled, right)]
    # Beside a known PSF intervals grow by half at most.
    assert sd[0] < 1.5 * sd[1]


def test_a_host_with_clumps_does_not_mislead_the_lens() -> None:
    realization = Realization(system=replace(cut(), agn=()), l_eta=1.0, host=Host(n=1.0, r_eff=0.35, magnitude=22.0))
    simulation = simulate_realization(realization)
    seen, scene = as_others_see_it(simulation, simulation.observation.psf), simulation.scene
    host = scene.host
    clumps = [(0.25, 0.0, 0.04), (-0.1, 0.22, 0.03), (-0.2, -0.15, 0.03)]
    image = seen.image + sum(
        seen.optics.sersic_image(
            SersicProfile(part * host.flux, 0.1, 1.0, 1.0, 0.0, host.x + dx, host.y + dy), scene.lens
        )
        for dx, dy, part in clumps
    )
    found = fit_parametric(replace(seen, image=image), agn_images=0, acceptance=Acceptance(300.0, 0.3))
    assert found.error is not None
    assert found.error.host >= 0.2
    assert found.error.psf == 0.0, "without AGN images nothing is said of the stamp"
    # By a profile alone theta_E is five deviations off, with a chi2 per degree of freedom of 6.
    assert found.misfit < 1.2
    for name in ("theta_E", "q", "slope"):
        at = found.lens_names.index(name)
        known = math.sqrt(found.lens_covariance[at, at])
        assert getattr(found.lens, name) == pytest.approx(getattr(scene.lens, name), abs=3 * known), name
    # The arc holds the clumps' light too; how it is divided from the deflector's wings costs a part in twenty.
    true = rate_to_magnitude(float((image - seen.image).sum()), 0.0)
    total = 10 ** (-0.4 * simulation.arc_magnitude) * 10 ** (0.4 * seen.zero_point) + 10 ** (-0.4 * true)
    assert rate_to_magnitude(float(found.arc.sum()), 0.0) == pytest.approx(rate_to_magnitude(total, 0.0), abs=0.08)
