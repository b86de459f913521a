"""How a PSF may be spoilt, and what a grid makes of it."""

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from engine import Grid, Host, Optics, Realization, SpecError, expand
from engine.catalogue import load_camera, load_dither
from engine.imaging.geometry import exposure_geometry
from engine.imaging.optics.exposed import ExposedOptics
from engine.imaging.psf import detector_kernel
from engine.imaging.telescope import TelescopeState, known_psf, optical_psf, state_psf
from engine.light.sersic import SersicProfile
from engine.parametric.fit import ParametricFit
from engine.parametric.misfit import misfit_significance, shared_noise
from engine.simulation.simulate import Simulation
from engine.spec.validation import spec_error

CAMERA = load_camera("WFC3-IR_F160W")
FACTOR = CAMERA.oversampling
SPEC = Realization(system="HE0435", l_eta=1.0, host=Host(n=2.0, r_eff=0.39, magnitude=21.0))


def test_a_residual_has_the_rms_that_was_asked_for_and_moves_light_alone() -> None:
    psf = optical_psf(CAMERA, FACTOR)
    spoilt = optical_psf(CAMERA, FACTOR, Optics(residual=0.02, residual_seed=3))
    relative = spoilt / psf - 1.0
    assert spoilt.sum() == pytest.approx(psf.sum(), rel=1e-12)
    assert np.sqrt((psf * relative**2).sum() / psf.sum()) == pytest.approx(0.02, rel=1e-9)
    again = optical_psf(CAMERA, FACTOR, Optics(residual=0.01, residual_seed=3)) / psf - 1.0
    # The same field, half as strong; another seed is another field.
    assert again == pytest.approx(0.5 * relative, abs=1e-9)
    other = optical_psf(CAMERA, FACTOR, Optics(residual=0.02, residual_seed=4)) / psf - 1.0
    assert abs(float((psf * other * relative).sum()) / psf.sum()) < 0.5 * 0.02**2


def test_a_bluer_sky_has_the_sharper_psf_and_a_coarse_psf_is_broader_and_centred() -> None:
    psf = optical_psf(CAMERA, FACTOR)
    assert optical_psf(CAMERA, FACTOR, Optics(colour=2.0)).max() > psf.max()
    coarse = known_psf(CAMERA, FACTOR, 2)
    assert coarse.max() < psf.max()
    assert coarse.sum() == pytest.approx(psf.sum(), rel=1e-12)
    assert np.abs(coarse - coarse[::-1, ::-1]).max() <= np.abs(psf - psf[::-1, ::-1]).max() + 1e-12
    assert known_psf(CAMERA, FACTOR) is psf


def test_a_state_of_the_telescope_is_the_psf_that_the_optics_make() -> None:
    optics = Optics(defocus_nm=20.0, jitter=0.01, colour=1.0)
    state = TelescopeState(20.0, 0.01**2, 1.0)
    np.testing.assert_array_equal(state_psf(CAMERA, FACTOR, state), optical_psf(CAMERA, FACTOR, optics))
    sharper = state_psf(CAMERA, FACTOR, TelescopeState(blur=-(0.01**2)))
    assert sharper.max() > optical_psf(CAMERA, FACTOR).max()


def test_a_correction_of_the_drizzled_psf_is_seen_in_all_light() -> None:
    geometry = exposure_geometry(CAMERA, load_dither("eight_point_quarter_pixel"), (24, 24))
    plain = ExposedOptics(optical_psf(CAMERA, FACTOR), geometry, detector_kernel(CAMERA), camera=CAMERA)
    correction = np.zeros((11, 11))
    correction[5, 5], correction[5, 6] = -0.02, 0.02
    mended = replace(plain, correction=correction)
    # In the middle of a pixel.
    star = mended.point_source(0.04, 0.04) - plain.point_source(0.04, 0.04)
    # The spline of single pixels rings a little beyond its stamp.
    assert star.sum() == pytest.approx(0.0, abs=2e-4)
    assert np.abs(star).max() == pytest.approx(0.02, rel=0.01)
    # A host that is nearly a point is changed as a star is.
    point = SersicProfile(1.0, 0.004, 0.5, 1.0, 0.0, 0.04, 0.04)
    light = mended.sersic_image(point) - plain.sersic_image(point)
    assert light == pytest.approx(star, abs=2e-3)
    pixels = tuple(np.indices((24, 24)).reshape(2, -1))
    more = mended.blurring_matrix(pixels, pixels, 2, 8) - plain.blurring_matrix(pixels, pixels, 2, 8)
    assert np.abs(more).max() == pytest.approx(0.02, rel=0.5)
    moved = plain.in_state(TelescopeState(30.0))
    assert moved.psf == pytest.approx(optical_psf(CAMERA, FACTOR, Optics(defocus_nm=30.0)), abs=1e-12)
    with pytest.raises(ValueError, match="camera is not known"):
        replace(plain, camera=None).in_state(TelescopeState(30.0))


def test_noise_that_pixels_share_is_no_misfit_and_a_misfit_of_its_size_is(simulation: Simulation) -> None:
    observation = simulation.observation
    correlation = shared_noise(observation)
    assert correlation[3, 3] == pytest.approx(1.0)
    assert observation.covariance is not None
    rng = np.random.default_rng(5)
    lit = np.ones(observation.shape, dtype=bool)
    # Noise of that correlation, by the exposures that it comes from.
    from engine.imaging.drizzling import drizzle_weights

    assert observation.response is not None
    weights = drizzle_weights(observation.response.geometry)
    found = []
    for _ in range(20):
        noise = (weights @ rng.normal(size=weights.shape[1])).reshape(observation.shape)
        noise /= np.sqrt(np.asarray(weights.multiply(weights).sum(axis=1))).reshape(observation.shape)
        found.append(misfit_significance(noise, lit, correlation))
    # Of unit deviation and no mean: 20 of them know both to a quarter.
    assert abs(float(np.mean(found))) < 1.0
    assert float(np.std(found)) < 1.6
    wavy = noise + 0.5 * np.sin(np.arange(observation.shape[1]) / 2.0)
    assert misfit_significance(wavy, lit, correlation) > 10.0


def test_a_psf_that_is_exact_is_left_alone(fit: ParametricFit, simulation: Simulation) -> None:
    # Not nearly: the very same optics, and nothing marginalised.
    assert fit.response is simulation.observation.response
    assert fit.psf is simulation.observation.psf
    assert fit.error is None


def test_optics_are_an_axis_of_a_grid_and_keep_the_digests_of_those_that_were() -> None:
    cuts = {"preset": "h0licow-vi/HE0435", "n": (2.0,), "magnitude": (21.0,), "replicates": 2}
    plain, one = expand(Grid(**cuts)), expand(Grid(**cuts, optics=Optics(defocus_nm=20.0)))
    axis = expand(Grid(**cuts, optics=[{}, {"defocus_nm": 20.0}, {"residual": 0.01, "residual_seed": 2}]))
    assert len(axis) == 3 * len(plain)
    by_label = {run.label: run.realization.digest for run in axis}
    for run in plain:
        name, hash_, replicate = run.label.partition("#")
        assert by_label[f"{name}_nominal{hash_}{replicate}"] == run.realization.digest
    assert {run.realization.digest for run in one} < set(by_label.values())
    assert any(label.partition("#")[0].endswith("_r0.01_s2") for label in by_label)
    # What an object of two fields was has nothing of those that came later.
    assert replace(SPEC, optics=Optics(jitter=0.01)).to_dict()["optics"] == {"defocus_nm": 0.0, "jitter": 0.01}
    with pytest.raises(SpecError, match="repeated"):
        expand(Grid(**cuts, optics=[{"jitter": 0.01}, {"jitter": 0.01}]))
    with pytest.raises(ValidationError) as refused:
        Grid(**cuts, optics=[{}, {"coarse": 0}])
    assert spec_error(refused.value).field == "optics[1].coarse"
