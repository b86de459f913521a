"""Hard cases of the inversion: extreme lenses, extreme components, spoilt noise and PSFs, limits of trust."""

import math
from dataclasses import replace

import numpy as np
import pytest

from engine.errors import InversionError, ObservationError, SpecError
from engine.imaging.observation import Observation
from engine.lensing.power_law import PowerLawLens
from engine.light.sersic import SersicProfile
from engine.likelihood.amplitudes import LinearData, MarginalLikelihood
from engine.likelihood.evidence import MAX_CONDITION, invert, ln_evidence
from engine.likelihood.problem import prepare_problem
from engine.simulation.scene import Scene
from engine.simulation.simulate import Simulation
from engine.source.regularisation import SourceModel, sparse_regularisation
from engine.spec.analysis import Analysis
from tests.engine.explicit_inversion import LENS, Explicit, stamp, stamp_likelihood
from tests.engine.true_fit import bare_fit, true_fit

MODEL = SourceModel((11, 12))


def rebuilt(scene: Explicit, linear: LinearData | None = None, psf: np.ndarray | None = None) -> MarginalLikelihood:
    return stamp_likelihood(
        scene.linear if linear is None else linear,
        stamp(scene.psf) if psf is None else psf,
        scene.likelihood().rays,
        np.nonzero(scene.chosen),
        np.nonzero(scene.rayed),
    )


# Lenses


@pytest.mark.parametrize(("name", "value"), [("slope", 2.0), ("q", 1.0)])
def test_the_evidence_is_continuous_where_formulas_change(name: str, value: float) -> None:
    likelihood, lens = Explicit().likelihood(), LENS.with_values(**{name: value})
    here = ln_evidence(likelihood, lens, 0.0, MODEL)
    for step in (-1e-12, 1e-12) if name == "slope" else (-1e-12,):
        there = ln_evidence(likelihood, lens.with_values(**{name: value + step}), 0.0, MODEL)
        # ln Z of several hundred changes by less than 1e4 for a change of one in the parameter.
        assert there == pytest.approx(here, abs=1e-7)


@pytest.mark.parametrize("lens", [LENS.with_values(slope=1.2), LENS.with_values(slope=2.8), LENS.with_values(q=0.2)])
def test_extreme_lenses_are_inverted_exactly(lens: PowerLawLens) -> None:
    scene = Explicit(lens=lens)
    expected = scene.solve(0.0, MODEL)
    found = invert(scene.likelihood(), lens, 0.0, MODEL)
    assert found.ln_evidence == pytest.approx(expected.ln_evidence, rel=1e-8)
    assert np.allclose(found.source.ravel(), expected.source, atol=1e-8 * np.abs(expected.source).max())


def test_a_round_lens_does_not_know_its_angle() -> None:
    likelihood, round_ = Explicit().likelihood(), LENS.with_values(q=1.0)
    values = [ln_evidence(likelihood, round_.with_values(phi=phi), 0.0, MODEL) for phi in (0.0, 0.7, 2.1)]
    assert values == pytest.approx([values[0]] * 3, rel=1e-11)


@pytest.mark.parametrize("slope", [1.2, 2.0])
def test_a_ray_through_the_centre_of_the_lens_is_traced(slope: float) -> None:
    # The middle ray of 3 x 3 of the central pixel hits the centre exactly.
    lens = PowerLawLens(0.8, 0.8, 0.4, slope)
    scene = Explicit(mask="disc", subrays=3, lens=lens)
    assert ln_evidence(scene.likelihood(), lens, 0.0, MODEL) == pytest.approx(
        scene.solve(0.0, MODEL).ln_evidence, rel=1e-8
    )


def test_no_shear_is_shear_of_zero() -> None:
    likelihood = Explicit().likelihood()
    without = PowerLawLens(0.8, 0.8, 0.4, 2.05, 0.02, -0.01)
    with_zero = LENS.with_values(gamma1=0.0, gamma2=0.0)
    assert ln_evidence(likelihood, without, 0.0, MODEL) == ln_evidence(likelihood, with_zero, 0.0, MODEL)


def test_a_lens_outside_the_formulas_is_refused() -> None:
    for name, value in (("slope", 1.0), ("slope", 3.0), ("q", 0.0), ("theta_E", 0.0)):
        with pytest.raises(SpecError, match=name):
            LENS.with_values(**{name: value})


# Components


@pytest.mark.parametrize("columns", [(), ("deflector", "background"), ("agn", "background"), ("agn",)])
def test_a_component_that_is_left_out_changes_nothing_where_its_flux_is_known_to_be_zero(
    columns: tuple[str, ...],
) -> None:
    # A column whose amplitude is held at zero by a measurement far better than the data equals no column: the
    # evidence differs by the density of that measurement alone.
    scene = Explicit(columns=columns)
    full = Explicit(columns=(*columns, *(c for c in ("agn", "deflector", "background") if c not in columns)))
    assert np.array_equal(full.linear.columns[:, : scene.linear.columns.shape[1]], scene.linear.columns)
    data, extra = scene.linear.data, full.linear.columns.shape[1] - scene.linear.columns.shape[1]
    k, sigma = full.linear.columns.shape[1], 1e-6
    # One more datum for each extra amplitude, far from every ray: a pixel that nothing else shines on.
    far = np.arange(extra) + 10_000
    rows, cols = np.nonzero(scene.chosen)
    held = np.zeros((extra, k))
    held[np.arange(extra), k - extra + np.arange(extra)] = 1.0
    likelihood = stamp_likelihood(
        LinearData(
            np.concatenate([data, np.zeros(extra)]),
            np.concatenate([scene.linear.covariance, np.full(extra, sigma**2)]),
            np.vstack([full.linear.columns, held]),
        ),
        stamp(scene.psf),
        scene.likelihood().rays,
        (np.concatenate([rows, far]), np.concatenate([cols, far])),
        np.nonzero(scene.rayed),
    )
    # The flat prior of each amplitude integrates its measurement to one.
    assert ln_evidence(likelihood, LENS, 0.0, MODEL) == pytest.approx(
        ln_evidence(scene.likelihood(), LENS, 0.0, MODEL), rel=1e-8
    )


def test_agn_ten_magnitudes_above_the_host_leave_its_source_alone() -> None:
    scene = Explicit()
    brighter = replace(scene.linear, data=scene.linear.data + 1e4 * 30.0 * scene.linear.columns[:, :2].sum(axis=1))
    faint, bright = (invert(rebuilt(scene, linear), LENS, -1.0, MODEL) for linear in (scene.linear, brighter))
    # 10 mag are 1e4 in flux: of 16 digits 11 are left, and the solve amplifies rounding by some more.
    assert np.abs(bright.source - faint.source).max() < 1e-8 * np.abs(faint.source).max()
    assert bright.ln_evidence == pytest.approx(faint.ln_evidence, rel=1e-8)


def test_a_component_without_light_on_the_mask_is_refused_by_name() -> None:
    scene = Explicit()
    columns = scene.linear.columns.copy()
    columns[:, 2] = 0.0
    with pytest.raises(InversionError, match="amplitudes"):
        rebuilt(scene, replace(scene.linear, columns=columns))


def test_a_scene_without_agn_or_deflector_has_no_columns_of_them(scene: Scene, simulation: Simulation) -> None:
    fit = true_fit(scene)
    bare = prepare_problem(
        simulation.observation, replace(fit, agn=(), deflector=None), Analysis(noise_treatment="diagonal")
    )
    assert bare.amplitude_names == ("background",)
    assert not bare.core.any()
    assert bare.likelihood.amplitudes == 1
    full = prepare_problem(simulation.observation, fit, Analysis(noise_treatment="diagonal"))
    assert full.amplitude_names == ("agn1", "agn2", "agn3", "agn4", "deflector", "background")


# Masks and grids


def test_a_source_grid_of_two_by_two_is_inverted_exactly() -> None:
    for name in ("zeroth", "gradient", "curvature"):
        scene, model = Explicit(), SourceModel((2, 2), name)  # type: ignore[arg-type]
        expected = scene.solve(0.0, model)
        assert invert(scene.likelihood(), LENS, 0.0, model).ln_evidence == pytest.approx(expected.ln_evidence, rel=1e-8)


def test_a_mask_without_valid_pixels_is_refused(scene: Scene, simulation: Simulation) -> None:
    observation = simulation.observation
    fit, valid = true_fit(scene), np.zeros(observation.shape, dtype=bool)
    valid[0, 0] = True
    with pytest.raises(ObservationError, match="mask"):
        prepare_problem(replace(observation, valid=valid), fit, Analysis(noise_treatment="diagonal"))


def test_a_saturated_pixel_is_not_used_whatever_its_value(scene: Scene, simulation: Simulation) -> None:
    observation, fit = simulation.observation, true_fit(scene)
    row, column = np.argwhere(prepare_problem(observation, fit, Analysis(noise_treatment="diagonal")).mask)[300]
    valid = observation.valid.copy()
    valid[row, column] = False
    values = []
    for spoilt in (0.0, 1e6, np.nan):
        image, noise = observation.image.copy(), observation.noise.copy()
        image[row, column], noise[row, column] = spoilt, (0.0 if math.isnan(spoilt) else 1.0)
        problem = prepare_problem(
            replace(observation, image=image, noise=noise, valid=valid), fit, Analysis(noise_treatment="diagonal")
        )
        assert not problem.mask[row, column]
        values.append(ln_evidence(problem.likelihood, fit.lens, -9.0, SourceModel((12, 12))))
    assert values[0] == values[1] == values[2]
    whole = prepare_problem(observation, fit, Analysis(noise_treatment="diagonal"))
    assert problem.likelihood.data_points == whole.likelihood.data_points - 1


# Noise


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
@pytest.mark.parametrize("correlated", [False, True])
def test_noise_that_is_no_noise_is_refused(value: float, correlated: bool) -> None:
    scene = Explicit(correlated=correlated)
    covariance = scene.linear.covariance.copy()
    covariance[(7, 7) if correlated else 7] = value
    with pytest.raises(InversionError, match="noise"):
        rebuilt(scene, replace(scene.linear, covariance=covariance))


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_data_that_are_not_finite_are_refused(value: float) -> None:
    scene = Explicit()
    data = scene.linear.data.copy()
    data[3] = value
    with pytest.raises(InversionError, match="data"):
        rebuilt(scene, replace(scene.linear, data=data))


# PSF


def test_a_psf_that_is_not_normalised_scales_the_source() -> None:
    scene, factor = Explicit(), 3.0
    plain, scaled = rebuilt(scene), rebuilt(scene, psf=factor * stamp(scene.psf))
    here, there = invert(plain, LENS, 0.0, MODEL), invert(scaled, LENS, 2 * math.log(factor), MODEL)
    assert np.allclose(there.source * factor, here.source, rtol=1e-9, atol=1e-9 * np.abs(here.source).max())
    assert there.ln_evidence == pytest.approx(here.ln_evidence, rel=1e-9)


def test_a_psf_that_is_not_centred_moves_the_image() -> None:
    scene = Explicit(psf="symmetric")
    larger = np.pad(stamp(scene.psf), 2)
    off = np.roll(larger, (1, 2), axis=(0, 1))
    rows, columns = np.nonzero(scene.chosen)
    pixels = np.nonzero(scene.rayed)
    rays = scene.likelihood().rays
    here = stamp_likelihood(scene.linear, larger, rays, (rows, columns), pixels)
    # Light that arrives one row up and two columns on is the same light, seen there.
    there = stamp_likelihood(scene.linear, off, rays, (rows + 1, columns + 2), pixels)
    assert ln_evidence(there, LENS, 0.0, MODEL) == pytest.approx(ln_evidence(here, LENS, 0.0, MODEL), rel=1e-12)


def test_a_psf_larger_than_the_image_counts_as_far_as_the_image_reaches() -> None:
    scene = Explicit()
    axis = np.arange(-60, 61)
    huge = np.exp(-np.hypot(*np.meshgrid(axis, axis)) / 3.0)
    seen = huge[60 - 24 : 60 + 25, 60 - 24 : 60 + 25]
    assert ln_evidence(rebuilt(scene, psf=huge), LENS, 0.0, MODEL) == ln_evidence(
        rebuilt(scene, psf=seen), LENS, 0.0, MODEL
    )


def test_a_problem_is_laid_out_with_a_psf_larger_than_the_image() -> None:
    rng, axis = np.random.default_rng(0), np.arange(-45, 46)
    psf = np.exp(-0.5 * np.add.outer(axis**2, axis**2) / 1.5**2)
    observation = Observation(rng.normal(size=(31, 31)), np.ones((31, 31)), psf / psf.sum(), 0.1, 25.0)
    fit = bare_fit(LENS, SersicProfile(1.0, 0.2, 1.0, 1.0, 0.0), observation.shape)
    problem = prepare_problem(
        observation, fit, Analysis(psf_radius=80, source_pixels=(8, 8), noise_treatment="diagonal")
    )
    assert math.isfinite(ln_evidence(problem.likelihood, LENS, 0.0, SourceModel((8, 8))))


# Trust


@pytest.mark.parametrize("ln_lambda", [-9.0, 0.0, 9.0])
@pytest.mark.parametrize("name", ["zeroth", "gradient", "curvature"])
def test_the_condition_number_is_the_true_one_within_a_factor_of_three(name: str, ln_lambda: float) -> None:
    model = SourceModel((12, 13), name)  # type: ignore[arg-type]
    inversion = invert(Explicit().likelihood(), LENS, ln_lambda, model)
    a = inversion.curvature + math.exp(ln_lambda) * sparse_regularisation(model).toarray()
    true = np.linalg.norm(a, 1) * np.linalg.norm(np.linalg.inv(a), 1)
    # LAPACK's estimate of the norm of the inverse is a lower bound, seldom below a third.
    assert true / 3 < inversion.condition_number < true * 1.001
    # In the 2-norm it differs by at most the number of pixels; here by a few.
    assert np.linalg.cond(a) / 3 < inversion.condition_number < 15 * np.linalg.cond(a)


def test_where_the_solve_cannot_be_trusted_an_error_says_what_to_change() -> None:
    likelihood, model = Explicit().likelihood(), SourceModel((30, 30))
    # More source pixels than data: the smaller lambda, the worse, until A is not even positive definite.
    accepted, refused = [], []
    for ln_lambda in np.arange(-80.0, 0.0, 2.0):
        try:
            accepted.append(invert(likelihood, LENS, float(ln_lambda), model).condition_number)
        except InversionError as error:
            refused.append(str(error))
    assert len(refused) > 10
    assert len(accepted) > 10
    assert all("larger lambda" in message and "source pixels" in message for message in refused)
    assert any("condition number" in message for message in refused)
    assert max(accepted) < MAX_CONDITION


@pytest.mark.parametrize("ln_lambda", [-80.0, -65.0, -56.0, -50.0])
def test_the_evidence_refuses_what_it_knows_to_be_rounding(ln_lambda: float) -> None:
    # Here rounding often leaves A positive definite, with numbers that mean nothing.
    with pytest.raises(InversionError, match="larger lambda"):
        ln_evidence(Explicit().likelihood(), LENS, ln_lambda, SourceModel((12, 12)))


@pytest.mark.parametrize("ln_lambda", [-800.0, 800.0, math.nan])
def test_a_strength_beyond_the_numbers_is_refused(ln_lambda: float) -> None:
    with pytest.raises(InversionError, match="lambda"):
        ln_evidence(Explicit().likelihood(), LENS, ln_lambda, SourceModel((30, 30)))
