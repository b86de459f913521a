"""Kernels in float64 against fifty digits, and what float32 would do in their place."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import lapack

from engine import Host, Realization
from engine.errors import InversionError
from engine.imaging.convolution import point_source_image
from engine.imaging.optics.spline import place_stamp
from engine.lensing.lens_equation import solve_lens_equation
from engine.lensing.power_law import PowerLawLens, magnification
from engine.light.rendering import render_sersic
from engine.light.sersic import SersicProfile, surface_brightness
from engine.likelihood.evidence import invert, ln_evidence, normal_equations
from engine.simulation.scene import build_scene
from engine.simulation.simulate import scene_geometry
from engine.source.regularisation import SourceModel, add_regularisation, ln_determinant
from tests.engine.conftest import cut
from tests.engine.explicit_inversion import LENS, Explicit
from tests.engine.plain_matrices import regularisation
from tests.hard_cases import fifty_digits
from tests.hard_cases.test_inversions import rebuilt
from tests.hard_cases.test_lenses import SHEARED, critical_point, fold_and_inward, one


@pytest.mark.parametrize("n", [0.3, 0.5, 1.0, 4.0, 8.0, 10.0])
def test_the_sersic_profile_is_right_to_eleven_digits_from_its_cusp_to_its_wings(n: float) -> None:
    """Sersic profiles of n = 0.3 to 10, from 1e-9 to 100 half-light radii, round and twenty times longer than wide.

    Could go wrong: approximations of k(n) are wrong by 1e-4 at n = 0.5 and diverge below; the cusp of n = 10 varies
    over many decades within a pixel. Holds: brightness is that of fifty digits to 1e-11 of itself, or to 1e-300
    where the wings of n = 0.3 have no number in float64.
    """
    for q in (0.05, 0.7, 1.0):
        profile = SersicProfile(3.0, 0.4, n, q, 0.6, 0.1, -0.2)
        for x, y in fifty_digits.ring(7, 4e-10, 40.0):
            at = (0.1 + x, -0.2 + y)
            expected = fifty_digits.brightness(profile, *at)
            # An exponent of e is known to e roundings.
            exponent = abs(math.log(max(expected, 1e-300)))
            assert surface_brightness(profile, one(at[0]), one(at[1]))[0] == pytest.approx(
                expected, rel=1e-13 * (100.0 + 10.0 * exponent), abs=1e-300
            )


@pytest.mark.parametrize("n", [0.5, 1.0, 4.0, 8.0])
def test_the_light_of_a_pixel_is_right_to_the_tolerance_that_was_asked_for(n: float) -> None:
    """Sersic light integrated over the pixel with the cusp, its neighbour and one in the wing, at three tolerances.

    Could go wrong: a quadrature that does not see the cusp states an error that it does not keep. Holds: against fifty
    digits each pixel is right to the tolerance times the brightest pixel, for 1e-3, 1e-5 and 1e-7.
    """
    profile = SersicProfile(2.0, 0.3, n, 0.6, 0.0, 0.013, -0.027)
    axis = (np.arange(17) - 8) * 0.1
    places = [(8, 8), (8, 9), (9, 8), (12, 5)]
    exact = [fifty_digits.pixel_flux(profile, axis[column], axis[row], 0.1) for row, column in places]
    for tolerance in (1e-3, 1e-5, 1e-7):
        image = render_sersic(profile, axis, axis, 0.1, tolerance=tolerance)
        for (row, column), expected in zip(places, exact, strict=True):
            assert abs(image[row, column] - expected) < tolerance * max(exact)


def test_the_products_of_psf_and_noise_are_right_to_thirteen_digits() -> None:
    """Elements of B^T C^-1 B, the sums that every evidence is made of, with noise that spans twelve decades.

    Could go wrong: sums of numbers of many sizes in another order, kept by blocks. Holds: each of 60 elements is that
    of fifty digits to 1e-13 of the geometric mean of its diagonal elements; in float32 it is off by more than 1e-8.
    """
    scene, rng = Explicit(), np.random.default_rng(2)
    m = scene.linear.data.size
    noise = 10.0 ** rng.uniform(-6.0, 6.0, m)
    likelihood = rebuilt(scene, replace(scene.linear, covariance=noise**2, columns=np.zeros((m, 0))))
    columns, ours = likelihood.blurring.toarray(), likelihood.w_tilde.dense()
    pairs = [(int(i), int(min(i + step, len(ours) - 1))) for i in rng.integers(0, len(ours), 20) for step in (0, 1, 7)]
    exact = fifty_digits.weighted_products(columns, noise, pairs)
    single = (columns / noise[:, None]).astype(np.float32)
    lost = 0.0
    for (i, j), expected in zip(pairs, exact, strict=True):
        size = math.sqrt(ours[i, i] * ours[j, j])
        # A sum of some hundred products, each of two roundings.
        assert abs(ours[i, j] - expected) < 1e-13 * size
        lost = max(lost, abs(float(single[:, i] @ single[:, j]) - expected) / size)
    assert lost > 1e-8


def test_a_psf_that_is_moved_by_a_fraction_of_a_pixel_is_right_to_fourteen_digits() -> None:
    """A stamp moved on the sub-pixels in Fourier space, as in exposures, and by its spline on the image's pixels.

    Could go wrong: phases at the highest frequency, the ends of the spline, half a pixel rounded the other way. Holds:
    both are those of fifty digits to 1e-14 of the peak, from no move to half a pixel.
    """
    fall = np.exp(-0.1 * (np.arange(13) - 6.0) ** 2)
    stamp = np.random.default_rng(3).uniform(size=(13, 13)) * np.outer(fall, fall)
    realization = Realization(system=cut(), l_eta=1.0, host=Host(n=2.0, r_eff=0.39, magnitude=20.5))
    geometry = scene_geometry(build_scene(realization))
    guard, size = 16, 45
    centre = (np.array(geometry.high_resolution_shape[::-1]) - 1) / 2
    for dx, dy in ((0.0, 0.0), (0.25, -0.4), (0.499, 0.1)):
        whole = np.floor(centre).astype(int)
        position = (whole + np.array([dx, dy]) - centre) * geometry.subpixel_scale
        image = point_source_image(position[None, :], np.ones(1), stamp, geometry)
        half = 6 + guard
        ours = image[whole[1] - half : whole[1] + half + 1, whole[0] - half : whole[0] + half + 1]
        exact = fifty_digits.moved_in_fourier_space(stamp, size, guard, dx, dy)
        assert np.abs(ours - exact).max() < 1e-14 * np.abs(exact).max()
        moved = place_stamp(stamp, (41, 41), 20.0 + dx, 20.0 + dy)[20 - 7 : 20 + 8, 20 - 7 : 20 + 8]
        rows = np.stack([fifty_digits.spline_between(row, dx) for row in stamp])
        plain = np.stack([fifty_digits.spline_between(column, dy) for column in rows.T], axis=1)
        assert np.abs(moved - plain).max() < 1e-14 * np.abs(plain).max()


@pytest.mark.parametrize("ln_lambda", [-40.0, -10.0, 60.0])
def test_evidence_and_source_are_those_of_fifty_digits_whatever_the_strength(ln_lambda: float) -> None:
    """The whole linear algebra of the evidence, from no regularisation (lambda = 4e-18) to nothing else (1e26).

    Could go wrong: chi^2 and penalty, determinants and the marginalised amplitudes are differences of large
    numbers. Holds: ln Z is right to 1e-9 (of values of 2000 to 6000) and the source to 1e-11 of its peak.
    """
    scene, model = Explicit(columns=("agn", "background")), SourceModel((6, 6))
    design = np.hstack([scene.source_columns(model), scene.linear.columns])
    amplitudes = scene.linear.columns.shape[1]
    exact, source = fifty_digits.evidence(
        design, np.sqrt(scene.linear.covariance), scene.linear.data, regularisation(model), ln_lambda, amplitudes
    )
    found = invert(scene.likelihood(), LENS, ln_lambda, model)
    assert found.ln_evidence == pytest.approx(exact, abs=1e-9)
    assert np.abs(found.source.ravel() - source).max() < 1e-11 * np.abs(source).max()


def replace_lens(scene: Explicit, lens: PowerLawLens) -> Explicit:
    other = scene.changed(lens=lens)
    other.__dict__["linear"] = scene.linear
    return other


def in_float32(scene: Explicit, lens: PowerLawLens, model: SourceModel, ln_lambda: float) -> float:
    """Ln Z from the engine's own F and D, solved in single precision; LinAlgError where that fails."""
    likelihood = scene.likelihood()
    f, d = normal_equations(likelihood, lens, model)
    a = np.tril(f)
    add_regularisation(a, model, math.exp(ln_lambda))
    factor, info = lapack.spotrf(a.astype(np.float32), lower=1)
    if info:
        raise np.linalg.LinAlgError(f"not positive definite at pivot {info}")
    solution, _ = lapack.spotrs(factor, d.astype(np.float32), lower=1)
    source = np.asarray(solution, dtype=np.float64).ravel()
    ln_z = -0.5 * (likelihood.dd - float(d @ source)) - float(np.log(np.diag(factor).astype(np.float64)).sum())
    return ln_z + 0.5 * (ln_determinant(model) + d.size * ln_lambda) + likelihood.ln_constant


def test_the_evidence_in_float32_jumps_from_lens_to_lens_where_that_in_float64_is_right() -> None:
    """The solve in single precision of an arc a hundred times brighter than its noise, behind lenses 1e-6 arcsec apart.

    Could go wrong: float32 is twice as fast and looks right. Holds: where ln Z is a parabola of the Einstein radius to
    1e-4, float32 scatters about it by more than one, which is what a chain would see of its posterior; float64 agrees
    with matrices written out to 1e-5 of a ln Z of 3e6. The engine has no float32 for that reason.
    """
    scene, model = Explicit(), SourceModel((20, 20))
    scene.__dict__["linear"] = replace(scene.linear, covariance=1e-4 * scene.linear.covariance)
    lenses = [LENS.with_values(theta_E=LENS.theta_E + 1e-6 * k) for k in range(5)]
    double = np.array([ln_evidence(scene.likelihood(), lens, -8.0, model) for lens in lenses])
    single = np.array([in_float32(scene, lens, model, -8.0) for lens in lenses])
    assert double[-1] == pytest.approx(replace_lens(scene, lenses[-1]).solve(-8.0, model).ln_evidence, abs=1e-5)
    steps = np.arange(5)

    def beside_a_parabola(values: np.ndarray) -> float:
        away = values - values[0]
        return float(np.abs(away - np.polyval(np.polyfit(steps, away, 2), steps)).max())

    assert beside_a_parabola(double) < 1e-4
    assert np.ptp(single - double) > 1.0
    assert beside_a_parabola(single) > 1.0


def test_rays_in_float32_lose_images_beside_a_fold_that_float64_finds() -> None:
    """A source 1e-8 arcsec inside a fold, its position rounded to float32.

    Could go wrong: float32 knows 0.1 arcsec to 4e-9, and on a caustic that is the difference between four images
    and two. Holds: in float64 the pair is there, its magnification as the root law has it to 5 %; of sources
    rounded to float32 three of five have a magnification that is off by more than a tenth, or no pair.
    """
    off, law = 0, None
    for angle in (0.9, 1.1, 1.29, 3.9, 5.0):
        fold, inward = fold_and_inward(SHEARED, angle)
        pairs = []
        for source in (fold + 1e-6 * inward, fold + 1e-8 * inward, (fold + 1e-8 * inward).astype(np.float32)):
            images = solve_lens_equation(SHEARED, float(source[0]), float(source[1]))
            pairs.append(abs(images[0].magnification) if len(images) == 4 else 0.0)
        law = 10.0 * pairs[0]
        assert pairs[1] == pytest.approx(law, rel=0.05)
        off += abs(pairs[2] / law - 1.0) > 0.1
    assert off >= 3


def test_a_magnification_in_float32_is_wrong_by_more_than_a_tenth_beside_a_critical_curve() -> None:
    """The Jacobian 1e-7 theta_E beside a critical curve, at a position rounded to float32.

    Could go wrong: the inverse magnification is a difference of numbers near one, of which float32 has seven
    digits. Holds: float64 agrees with fifty digits to 1e-7, float32 is off by more than a tenth in three of five
    places.
    """
    wrong = 0
    for angle in (0.3, 0.9, 1.29, 2.2, 3.9):
        x, y = critical_point(SHEARED, angle)
        x, y = x + 1e-7, y + 1e-7
        exact = fifty_digits.jacobian(SHEARED, x, y)[3]
        double = 1.0 / float(magnification(SHEARED, one(x), one(y))[0])
        single = 1.0 / float(magnification(SHEARED, one(np.float32(x)), one(np.float32(y)))[0])
        assert double == pytest.approx(exact, rel=1e-7)
        wrong += abs(single / exact - 1.0) > 0.1
    assert wrong >= 3


def test_the_evidence_refuses_rather_than_returns_what_even_float64_cannot_know() -> None:
    """A source of 900 pixels behind 336 data, with no regularisation to speak of.

    Could go wrong: rounding leaves the matrix positive definite and the numbers mean nothing. Holds: an
    InversionError that tells the condition number and what to change.
    """
    with pytest.raises(InversionError, match="larger lambda"):
        ln_evidence(Explicit().likelihood(), LENS, -60.0, SourceModel((30, 30)))
