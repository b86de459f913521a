"""Hard cases of the inversion: extreme lenses, extreme components, spoilt noise and PSFs, limits of trust."""

import math
from dataclasses import replace

import numpy as np
import pytest

from engine.errors import InversionError, ObservationError, SpecError
from engine.imaging.observation import Observation
from engine.imaging.optics.stamp_matrix import pixel_kernel
from engine.lensing.power_law import PowerLawLens
from engine.light.sersic import SersicProfile
from engine.likelihood.amplitudes import LinearData, MarginalLikelihood, marginalise_amplitudes
from engine.likelihood.evidence import MAX_CONDITION, invert, ln_evidence
from engine.likelihood.problem import prepare_problem
from engine.simulation.scene import Scene
from engine.simulation.simulate import Simulation
from engine.source.lensing_matrix import cast_rays, map_rays
from engine.source.regularisation import SourceModel, sparse_regularisation
from engine.spec.analysis import Analysis
from tests.engine.explicit_inversion import LENS, Explicit, stamp, stamp_likelihood
from tests.engine.plain_matrices import lensing_matrix, regularisation
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
    """A slope of 2 and 2 +- 1e-12, an axis ratio of 1 and 1 - 1e-12.

    Could go wrong: the formula for slope 2 or q = 1 is another one than beside them, and ln Z jumps. Holds: ln Z
    changes by less than 1e-7.
    """
    likelihood, lens = Explicit().likelihood(), LENS.with_values(**{name: value})
    here = ln_evidence(likelihood, lens, 0.0, MODEL)
    for step in (-1e-12, 1e-12) if name == "slope" else (-1e-12,):
        there = ln_evidence(likelihood, lens.with_values(**{name: value + step}), 0.0, MODEL)
        # ln Z of several hundred changes by less than 1e4 for a change of one in the parameter.
        assert there == pytest.approx(here, abs=1e-7)


@pytest.mark.parametrize("lens", [LENS.with_values(slope=1.2), LENS.with_values(slope=2.8), LENS.with_values(q=0.2)])
def test_extreme_lenses_are_inverted_exactly(lens: PowerLawLens) -> None:
    """Slopes of 1.2 and 2.8, an axis ratio of 0.2.

    Could go wrong: the traced mask is a sliver or covers the source plane many times. Holds: ln Z and source are
    those of matrices written out, to 1e-8.
    """
    scene = Explicit(lens=lens)
    expected = scene.solve(0.0, MODEL)
    found = invert(scene.likelihood(), lens, 0.0, MODEL)
    assert found.ln_evidence == pytest.approx(expected.ln_evidence, rel=1e-8)
    assert np.allclose(found.source.ravel(), expected.source, atol=1e-8 * np.abs(expected.source).max())


def test_a_round_lens_does_not_know_its_angle() -> None:
    """A round lens, whose position angle means nothing.

    Could go wrong: the angle leaks into ln Z, and a chain finds it. Holds: ln Z is the same for three angles, to
    1e-11.
    """
    likelihood, round_ = Explicit().likelihood(), LENS.with_values(q=1.0)
    values = [ln_evidence(likelihood, round_.with_values(phi=phi), 0.0, MODEL) for phi in (0.0, 0.7, 2.1)]
    assert values == pytest.approx([values[0]] * 3, rel=1e-11)


@pytest.mark.parametrize("slope", [1.2, 2.0])
def test_a_ray_through_the_centre_of_the_lens_is_traced(slope: float) -> None:
    """A ray through the very centre of the lens.

    Could go wrong: 0/0 in its direction. Holds: ln Z is that of matrices written out, to 1e-8.
    """
    # The middle ray of 3 x 3 of the central pixel hits the centre exactly.
    lens = PowerLawLens(0.8, 0.8, 0.4, slope)
    scene = Explicit(mask="disc", subrays=3, lens=lens)
    assert ln_evidence(scene.likelihood(), lens, 0.0, MODEL) == pytest.approx(
        scene.solve(0.0, MODEL).ln_evidence, rel=1e-8
    )


def test_no_shear_is_shear_of_zero() -> None:
    """A lens without shear, and one whose shear is zero.

    Could go wrong: another code path, other numbers. Holds: the same bits.
    """
    likelihood = Explicit().likelihood()
    without = PowerLawLens(0.8, 0.8, 0.4, 2.05, 0.02, -0.01)
    with_zero = LENS.with_values(gamma1=0.0, gamma2=0.0)
    assert ln_evidence(likelihood, without, 0.0, MODEL) == ln_evidence(likelihood, with_zero, 0.0, MODEL)


def test_a_lens_outside_the_formulas_is_refused() -> None:
    """Slopes of 1 and 3, axis ratio and Einstein radius of 0.

    Could go wrong: infinite mass, or a deflection that is nothing. Holds: a SpecError names the parameter.
    """
    for name, value in (("slope", 1.0), ("slope", 3.0), ("q", 0.0), ("theta_E", 0.0)):
        with pytest.raises(SpecError, match=name):
            LENS.with_values(**{name: value})


# Components


def test_agn_ten_magnitudes_above_the_host_leave_its_source_alone() -> None:
    """AGN ten magnitudes brighter, as in HS2209.

    Could go wrong: their light cancels in float64 and the host is what rounding leaves. Holds: the source is the
    same to 1e-8 of its peak.
    """
    scene = Explicit()
    brighter = replace(scene.linear, data=scene.linear.data + 1e4 * 30.0 * scene.linear.columns[:, :2].sum(axis=1))
    faint, bright = (invert(rebuilt(scene, linear), LENS, -1.0, MODEL) for linear in (scene.linear, brighter))
    # 10 mag are 1e4 in flux: of 16 digits 11 are left, and the solve amplifies rounding by some more.
    assert np.abs(bright.source - faint.source).max() < 1e-8 * np.abs(faint.source).max()
    assert bright.ln_evidence == pytest.approx(faint.ln_evidence, rel=1e-8)


def test_a_component_without_light_on_the_mask_is_refused_by_name() -> None:
    """An AGN or deflector that has no light on the mask.

    Could go wrong: a singular matrix, and amplitudes of 1e16. Holds: an InversionError names the amplitudes.
    """
    scene = Explicit()
    columns = scene.linear.columns.copy()
    columns[:, 2] = 0.0
    with pytest.raises(InversionError, match="amplitudes"):
        rebuilt(scene, replace(scene.linear, columns=columns))


def test_a_scene_without_agn_or_deflector_has_no_columns_of_them(scene: Scene, simulation: Simulation) -> None:
    """A scene without AGN and deflector light.

    Could go wrong: columns of zeros are convolved, solved and make the matrix singular. Holds: the linear problem
    has the background alone, and no boosted noise.
    """
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
    """A source grid of 2 x 2.

    Could go wrong: second differences of two points do not exist. Holds: ln Z is that of matrices written out, to
    1e-8, with each regularisation.
    """
    for name in ("zeroth", "gradient", "curvature"):
        scene, model = Explicit(), SourceModel((2, 2), name)  # type: ignore[arg-type]
        expected = scene.solve(0.0, model)
        assert invert(scene.likelihood(), LENS, 0.0, model).ln_evidence == pytest.approx(expected.ln_evidence, rel=1e-8)


def test_a_mask_without_valid_pixels_is_refused(scene: Scene, simulation: Simulation) -> None:
    """A ring that holds no valid pixel.

    Could go wrong: an empty matrix, or an evidence of nothing. Holds: an ObservationError names the mask and its
    radii.
    """
    observation = simulation.observation
    fit, valid = true_fit(scene), np.zeros(observation.shape, dtype=bool)
    valid[0, 0] = True
    with pytest.raises(ObservationError, match="mask"):
        prepare_problem(replace(observation, valid=valid), fit, Analysis(noise_treatment="diagonal"))


def test_a_saturated_pixel_is_not_used_whatever_its_value(scene: Scene, simulation: Simulation) -> None:
    """A saturated pixel, its value 0, 1e6 or NaN.

    Could go wrong: 0 times NaN is NaN, and one pixel spoils the image. Holds: ln Z is the same bits for all three,
    of one datum fewer.
    """
    observation, fit = simulation.observation, true_fit(scene)
    whole = prepare_problem(observation, fit, Analysis(noise_treatment="diagonal"))
    row, column = np.argwhere(whole.mask)[300]
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
    assert problem.likelihood.data_points == whole.likelihood.data_points - 1


@pytest.mark.parametrize("subrays", [1, 2])
def test_a_mask_of_one_pixel_has_the_evidence_of_one_gaussian(subrays: int) -> None:
    """A mask of a single pixel.

    Could go wrong: with one ray the source grid has no extent, with few it is as small as a pixel; a determinant of
    a matrix of rank one. Holds: with several rays ln Z is that of one datum whose variance is its noise and the
    prior's, written out, to 1e-10, and the source is the datum's share; a single ray is refused with an
    InversionError.
    """
    axis = (np.arange(9) - 4) * 0.1
    mask = np.zeros((9, 9), dtype=bool)
    mask[6, 6] = True
    rays = cast_rays(mask, np.zeros_like(mask), axis, axis, 0.1, subrays)
    likelihood = marginalise_amplitudes(
        LinearData(np.array([1.0]), np.array([0.01]), np.zeros((1, 0))), np.ones((1, 1)), rays
    )
    model = SourceModel((2, 2), "gradient")
    if subrays == 1:
        with pytest.raises(InversionError, match=r"source grid|rays|extent"):
            invert(likelihood, LENS, 0.0, model)
        return
    found = invert(likelihood, LENS, 0.0, model)
    share, prior = lensing_matrix(rays, LENS, model.shape)[0], np.linalg.inv(regularisation(model))
    variance = 0.01 + share @ prior @ share
    assert found.ln_evidence == pytest.approx(-0.5 / variance - 0.5 * math.log(2 * math.pi * variance), abs=1e-10)
    assert np.allclose(found.source.ravel(), prior @ share / variance, rtol=1e-8)
    assert found.effective_parameters() == pytest.approx(share @ prior @ share / variance, rel=1e-8)


def test_an_empty_mask_is_refused() -> None:
    """A mask of no pixel at all.

    Could go wrong: the smallest rectangle round nothing. Holds: an InversionError names the mask.
    """
    axis = (np.arange(9) - 4) * 0.1
    nothing = np.zeros((9, 9), dtype=bool)
    with pytest.raises(InversionError, match="mask"):
        map_rays(cast_rays(nothing, nothing, axis, axis, 0.1, 2), LENS, (4, 4))


# Noise


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
@pytest.mark.parametrize("correlated", [False, True])
def test_noise_that_is_no_noise_is_refused(value: float, correlated: bool) -> None:
    """A noise map with a zero, a negative value, NaN or inf, with and without correlations.

    Could go wrong: a weight of infinity, or NaN for all. Holds: an InversionError names the noise.
    """
    scene = Explicit(correlated=correlated)
    covariance = scene.linear.covariance.copy()
    covariance[(7, 7) if correlated else 7] = value
    with pytest.raises(InversionError, match="noise"):
        rebuilt(scene, replace(scene.linear, covariance=covariance))


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_data_that_are_not_finite_are_refused(value: float) -> None:
    """A pixel of NaN or inf.

    Could go wrong: NaN everywhere. Holds: an InversionError names the data.
    """
    scene = Explicit()
    data = scene.linear.data.copy()
    data[3] = value
    with pytest.raises(InversionError, match="data"):
        rebuilt(scene, replace(scene.linear, data=data))


# PSF


def test_a_psf_that_is_not_normalised_scales_the_source() -> None:
    """A PSF whose sum is three.

    Could go wrong: it is normalised in silence, and fluxes mean something else. Holds: the source is a third, ln Z
    the same, to 1e-9.
    """
    scene, factor = Explicit(), 3.0
    plain, scaled = rebuilt(scene), rebuilt(scene, psf=factor * stamp(scene.psf))
    here, there = invert(plain, LENS, 0.0, MODEL), invert(scaled, LENS, 2 * math.log(factor), MODEL)
    assert np.allclose(there.source * factor, here.source, rtol=1e-9, atol=1e-9 * np.abs(here.source).max())
    assert there.ln_evidence == pytest.approx(here.ln_evidence, rel=1e-9)


def test_a_psf_that_is_not_centred_moves_the_image() -> None:
    """A PSF whose peak is one row up and two columns on.

    Could go wrong: its centre is taken for the middle of the array or for the peak. Holds: the light is seen there:
    ln Z of data moved likewise is the same to 1e-12.
    """
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
    """A PSF stamp larger than the image.

    Could go wrong: indices wrap round, or memory is taken for what cannot be seen. Holds: the same bits as with
    what of it can be seen.
    """
    scene = Explicit()
    axis = np.arange(-60, 61)
    huge = np.exp(-np.hypot(*np.meshgrid(axis, axis)) / 3.0)
    seen = huge[60 - 24 : 60 + 25, 60 - 24 : 60 + 25]
    assert ln_evidence(rebuilt(scene, psf=huge), LENS, 0.0, MODEL) == ln_evidence(
        rebuilt(scene, psf=seen), LENS, 0.0, MODEL
    )


def test_a_problem_is_laid_out_with_a_psf_larger_than_the_image() -> None:
    """The same through the layout of an observation.

    Could go wrong: a crop by a negative index. Holds: ln Z is finite.
    """
    rng, axis = np.random.default_rng(0), np.arange(-45, 46)
    psf = np.exp(-0.5 * np.add.outer(axis**2, axis**2) / 1.5**2)
    observation = Observation(rng.normal(size=(31, 31)), np.ones((31, 31)), psf / psf.sum(), 0.1, 25.0)
    fit = bare_fit(LENS, SersicProfile(1.0, 0.2, 1.0, 1.0, 0.0), observation.shape)
    problem = prepare_problem(
        observation, fit, Analysis(psf_radius=80, source_pixels=(8, 8), noise_treatment="diagonal")
    )
    assert math.isfinite(ln_evidence(problem.likelihood, LENS, 0.0, SourceModel((8, 8))))


def test_an_even_psf_is_refused() -> None:
    """A PSF stamp of an even number of pixels, which has no middle pixel.

    Could go wrong: the image moves by half a pixel. Holds: an ObservationError names the PSF.
    """
    with pytest.raises(ObservationError, match="psf"):
        pixel_kernel(np.ones((4, 4)), 2)
    with pytest.raises(ObservationError, match="psf"):
        Observation(np.zeros((9, 9)), np.ones((9, 9)), np.full((4, 4), 1 / 16), 0.1, 25.0)


# Trust


def test_regularisation_without_end_leaves_no_source_and_the_evidence_of_none() -> None:
    """lambda to infinity: ln lambda of 40 and 60.

    Could go wrong: overflow, or an evidence that depends on the grid. Holds: the source vanishes, and ln Z is that
    of the data without a source to 1e-6.
    """
    likelihood, model = Explicit().likelihood(), SourceModel((8, 8))
    alone = -0.5 * likelihood.dd + likelihood.ln_constant
    for ln_lambda in (40.0, 60.0):
        found = invert(likelihood, LENS, ln_lambda, model)
        assert found.ln_evidence == pytest.approx(alone, abs=1e-6)
        assert np.abs(found.source).max() < 1e-8


@pytest.mark.parametrize("ln_lambda", [-9.0, 0.0, 9.0])
@pytest.mark.parametrize("name", ["zeroth", "gradient", "curvature"])
def test_the_condition_number_is_the_true_one_within_a_factor_of_three(name: str, ln_lambda: float) -> None:
    """The condition number that each inversion reports.

    Could go wrong: an estimate that is off by orders of magnitude says nothing. Holds: within a factor of three of
    the one from the written-out inverse.
    """
    model = SourceModel((12, 13), name)  # type: ignore[arg-type]
    inversion = invert(Explicit().likelihood(), LENS, ln_lambda, model)
    a = inversion.curvature + math.exp(ln_lambda) * sparse_regularisation(model).toarray()
    true = np.linalg.norm(a, 1) * np.linalg.norm(np.linalg.inv(a), 1)
    # LAPACK's estimate of the norm of the inverse is a lower bound, seldom below a third.
    assert true / 3 < inversion.condition_number < true * 1.001
    # In the 2-norm it differs by at most the number of pixels; here by a few.
    assert np.linalg.cond(a) / 3 < inversion.condition_number < 15 * np.linalg.cond(a)


def test_where_the_solve_cannot_be_trusted_an_error_says_what_to_change() -> None:
    """lambda to 0 with more source pixels than data.

    Could go wrong: the smaller lambda, the more digits go, without a word. Holds: below some lambda all is refused
    by an InversionError that says what to change; what is accepted has a condition number below the limit.
    """
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
    """lambda of e^-50 to e^-80.

    Could go wrong: rounding leaves the matrix positive definite and ln Z means nothing. Holds: an InversionError
    asks for a larger lambda.
    """
    # Here rounding often leaves A positive definite, with numbers that mean nothing.
    with pytest.raises(InversionError, match="larger lambda"):
        ln_evidence(Explicit().likelihood(), LENS, ln_lambda, SourceModel((12, 12)))


@pytest.mark.parametrize("ln_lambda", [-800.0, 800.0, math.nan])
def test_a_strength_beyond_the_numbers_is_refused(ln_lambda: float) -> None:
    """ln lambda of +-800 and NaN.

    Could go wrong: lambda of 0 or infinity in float64. Holds: an InversionError names lambda.
    """
    with pytest.raises(InversionError, match="lambda"):
        ln_evidence(Explicit().likelihood(), LENS, ln_lambda, SourceModel((30, 30)))
