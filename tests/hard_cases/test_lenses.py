"""Lenses: extreme slopes and flattenings, the centre, critical curves and caustics."""

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from engine import EngineError, Host, Realization, SpecError, load_system, system_from_mapping
from engine.errors import LensEquationError
from engine.lensing.lens_equation import LensedImage, solve_lens_equation
from engine.lensing.power_law import PowerLawLens, convergence_and_shear, deflection, magnification, source_position
from tests.engine.angular_solver import AngularSolver
from tests.hard_cases import fifty_digits

SLOPES = [1.05, 1.2, 2.0 - 1e-12, 2.0, 2.0 + 1e-12, 2.8, 2.95]
FLATTENINGS = [0.05, 0.2, 0.6, 1.0 - 1e-12, 1.0]
SHEARED = PowerLawLens(1.0, 0.7, 0.3, 2.0, 0.02, -0.01, 0.05, 0.02)


def one(value: float) -> np.ndarray:
    return np.array([value])


# Deflection and Jacobian


@pytest.mark.parametrize("slope", SLOPES)
@pytest.mark.parametrize("q", FLATTENINGS)
def test_deflection_and_jacobian_are_right_to_twelve_digits_for_any_slope_and_flattening(
    q: float, slope: float
) -> None:
    """Slopes from 1.05 to 2.95, 2 and 2 +- 1e-12 among them; axis ratios from 0.05 to 1 - 1e-12 and 1.

    Could go wrong: the series of the deflection converges as ((1 - q)/(1 + q))^k, and a fixed number of terms is
    wrong by up to 3e-2 for flat lenses; formulas that divide by slope - 2 or 1 - q lose all digits where those
    vanish. Holds: deflection and Jacobian are those of arithmetic with fifty digits, to 1e-12 of the deflection and
    to 1e-11 of the largest derivative, from 1e-9 to 1000 arcsec from the centre.
    """
    lens = PowerLawLens(1.2, q, 0.4, slope)
    for x, y in fifty_digits.ring(9, 1e-9, 1e3):
        alpha = fifty_digits.deflection(lens, x, y)
        ax, ay = deflection(lens, one(x), one(y))
        assert abs(complex(ax[0], ay[0]) - alpha) < 1e-12 * abs(alpha)
        kappa, gamma1, gamma2, _ = fifty_digits.jacobian(lens, x, y)
        ours = [float(value[0]) for value in convergence_and_shear(lens, one(x), one(y))]
        # The shear is a difference of deflection and convergence, each rounded.
        largest = abs(alpha) / math.hypot(x, y) + kappa
        assert np.abs(np.array(ours) - (kappa, gamma1, gamma2)).max() < 1e-11 * largest


def test_shear_and_an_offset_centre_keep_the_twelve_digits() -> None:
    """External shear, and a lens that does not stand at the origin.

    Could go wrong: shear acts about the origin of the frame and the power law about its own centre; mixed up, both
    are wrong by the offset. Holds: 1e-12 of the deflection against fifty digits.
    """
    for x, y in fifty_digits.ring(25, 0.05, 30.0):
        alpha = fifty_digits.deflection(SHEARED, x, y)
        ax, ay = deflection(SHEARED, one(x), one(y))
        assert abs(complex(ax[0], ay[0]) - alpha) < 1e-12 * abs(alpha)
        *derivatives, determinant = fifty_digits.jacobian(SHEARED, x, y)
        ours = [float(value[0]) for value in convergence_and_shear(SHEARED, one(x), one(y))]
        assert ours == pytest.approx(derivatives, rel=1e-11, abs=1e-12)
        assert 1.0 / float(magnification(SHEARED, one(x), one(y))[0]) == pytest.approx(
            determinant, rel=1e-11, abs=1e-11
        )


def test_at_the_centre_of_the_lens_nothing_is_deflected_and_nothing_magnified() -> None:
    """A ray through the very centre, r = 0, where the deflection has no limit.

    Could go wrong: 0/0 in the angle of the ray, infinite convergence. Holds: the symmetric value, a deflection of
    exactly zero (that of the shear where there is some), a magnification of exactly zero, and no warning.
    """
    for slope in (1.05, 1.5, 2.0, 2.5, 2.95):
        lens = PowerLawLens(1.0, 0.7, 0.3, slope)
        ax, ay = deflection(lens, np.zeros(1), np.zeros(1))
        assert (ax[0], ay[0]) == (0.0, 0.0)
        assert magnification(lens, np.zeros(1), np.zeros(1)) == 0.0
        sheared = lens.with_values(x=0.3, y=-0.2, gamma1=0.1, gamma2=0.05)
        ax, ay = deflection(sheared, one(0.3), one(-0.2))
        assert (ax[0], ay[0]) == pytest.approx((0.1 * 0.3 - 0.05 * 0.2, 0.05 * 0.3 + 0.1 * 0.2), abs=1e-16)


def test_a_system_of_a_slope_or_flattening_that_no_lens_has_is_refused_by_its_field() -> None:
    """A slope of 1.05 or 2.95, a flattening of 0.05 or of 0.04, asked for in a system of one's own.

    Could go wrong: a mass whose series hardly converges, or whose total hardly does, is simulated without a word.
    Holds: slopes outside 1.2 to
    2.8 and axis ratios below 0.05 are refused by their field; 0.05 is taken.
    """
    plain = Realization(system=load_system("HE0435"), l_eta=1.0, host=Host(n=1.0, r_eff=0.002, magnitude=22.0))
    document = plain.to_dict()["system"]

    def with_mass(key: str, **values: object) -> dict[str, object]:
        mass = {**document["mass_models"]["recommended"]["1.0"], **values}
        return {**document, "agn": [], "mass_models": {"recommended": {key: mass}}}

    for slope in (1.05, 2.95):
        with pytest.raises(SpecError) as caught:
            system_from_mapping(with_mass(f"{slope - 1:g}", slope=slope))
        assert caught.value.field.endswith(".slope")
    with pytest.raises(SpecError) as caught:
        system_from_mapping(with_mass("1.0", q=0.04))
    assert caught.value.field.endswith(".q")
    system_from_mapping(with_mass("1.0", q=0.05))


# Critical curves and caustics


def critical_point(lens: PowerLawLens, angle: float) -> tuple[float, float]:
    """The outermost critical point in a direction from the lens."""

    def determinant(r: float) -> float:
        kappa, gamma1, gamma2 = convergence_and_shear(
            lens, one(lens.x + r * math.cos(angle)), one(lens.y + r * math.sin(angle))
        )
        return float(((1 - kappa) ** 2 - gamma1**2 - gamma2**2)[0])

    radii = np.linspace(3.0, 0.2, 300) * lens.theta_E
    signs = np.sign([determinant(r) for r in radii])
    k = int(np.flatnonzero(signs[1:] != signs[:-1])[0])
    r = brentq(determinant, radii[k + 1], radii[k], xtol=1e-16)
    return lens.x + r * math.cos(angle), lens.y + r * math.sin(angle)


def behind(lens: PowerLawLens, point: tuple[float, float]) -> tuple[float, float]:
    x, y = source_position(lens, one(point[0]), one(point[1]))
    return float(x[0]), float(y[0])


def all_images(lens: PowerLawLens, x: float, y: float) -> tuple[LensedImage, ...]:
    return solve_lens_equation(lens, x, y, min_magnification=0.0)


@pytest.mark.parametrize("slope", [1.7, 2.0, 2.4])
def test_a_point_on_a_critical_curve_is_magnified_as_far_as_rounding_knows(slope: float) -> None:
    """A point of the image plane on the critical curve itself.

    Could go wrong: the inverse magnification is a difference of numbers near one and is zero there, so that the
    magnification may be NaN, or raise, or warn of a division. Holds: the inverse is right to 1e-14 against fifty
    digits, the magnification above 1e13 or infinite, never NaN, and exactly infinite on the Einstein ring of an
    isothermal sphere.
    """
    lens = SHEARED.with_values(slope=slope)
    for angle in (0.3, 0.9, 1.29, 2.2, 3.9):
        x, y = critical_point(lens, angle)
        mu = float(magnification(lens, one(x), one(y))[0])
        assert abs(mu) > 1e13
        assert 1.0 / mu == pytest.approx(fifty_digits.jacobian(lens, x, y)[3], abs=1e-14)
    sphere = PowerLawLens(1.0, 1.0, 0.0, 2.0)
    assert magnification(sphere, one(1.0), one(0.0))[0] == math.inf


def fold_and_inward(lens: PowerLawLens, angle: float) -> tuple[np.ndarray, np.ndarray]:
    """A source on a fold, and the unit vector across the caustic towards where there are two images more."""
    here, ahead = (np.array(behind(lens, critical_point(lens, angle + step))) for step in (0.0, 1e-4))
    tangent = (ahead - here) / np.linalg.norm(ahead - here)
    normal = np.array([-tangent[1], tangent[0]])
    more = [len(all_images(lens, *(here + sign * 1e-4 * normal))) for sign in (1, -1)]
    assert abs(more[0] - more[1]) == 2
    return here, normal if more[0] > more[1] else -normal


@pytest.mark.parametrize("slope", [1.7, 2.0, 2.4])
@pytest.mark.parametrize("angle", [0.9, 1.29, 3.9])
def test_a_source_on_a_fold_has_its_two_images_in_one_and_beside_it_two_more_or_none(
    angle: float, slope: float
) -> None:
    """A source on a fold, and 1e-10 to 1e-4 arcsec inside and outside.

    Could go wrong: two images merge on the critical curve, where Newton's method stops anywhere within the square
    root of rounding: one image is counted many times, or the pair is lost. Holds: on the fold the pair is one
    image; inside there are two more than outside, of opposite parity and equal magnification, which grows as one
    over the root of the distance; the images elsewhere are always there, and keep magnification and parity.
    """
    lens = SHEARED.with_values(slope=slope)
    fold, inward = fold_and_inward(lens, angle)
    outside = all_images(lens, *(fold - 1e-4 * inward))
    assert len(all_images(lens, *fold)) == len(outside) + 1
    scale = []
    for distance in (1e-10, 1e-8, 1e-6, 1e-4):
        assert len(all_images(lens, *(fold - distance * inward))) == len(outside)
        one_side, other, *rest = all_images(lens, *(fold + distance * inward))
        assert len(rest) == len(outside)
        assert one_side.magnification * other.magnification < 0
        # They differ in the order of the distance between the two, the root of that of the source; their mean does not.
        assert abs(one_side.magnification / other.magnification) == pytest.approx(1.0, abs=60.0 * distance**0.5)
        scale.append(abs(one_side.magnification * other.magnification * distance) ** 0.5)
        for image, known in zip(rest, outside, strict=True):
            assert image.magnification == pytest.approx(known.magnification, rel=0.05)
    # Of the order of the distance in units of the caustic's own bends.
    assert scale == pytest.approx([scale[1]] * 4, rel=0.05)


@pytest.mark.parametrize("angle", [0.0, 0.5 * math.pi, math.pi])
def test_a_source_on_a_cusp_has_its_three_images_in_one_and_beside_it_three_or_one(angle: float) -> None:
    """A source on a cusp, and 1e-6 to 1e-4 arcsec inside and outside along its axis.

    Could go wrong: Newton's method stops anywhere within the cube root of rounding of the triple root; sixteen
    images were found here once, and not the one that is far away. Holds: two images on the cusp and outside, four
    inside; the far one is always there; inside the middle one of the three is as bright as both others, with the
    other parity.
    """
    lens = PowerLawLens(1.0, 0.7, 0.0, 2.0)
    cusp = np.array(behind(lens, critical_point(lens, angle)))
    far = all_images(lens, *cusp)[-1]
    for distance in (0.0, 1e-12, 1e-9, 1e-6, 1e-4):
        for side in (1.0, -1.0):
            found = all_images(lens, *(cusp * (1.0 + side * distance / np.linalg.norm(cusp))))
            assert found[-1].magnification == pytest.approx(far.magnification, rel=1e-3)
            if distance < 1e-7:
                # Within 1e-12 of the caustic, which closes as the power 3/2 towards the cusp.
                assert len(found) == 2
            elif side > 0:
                assert len(found) == 2
                assert np.sign(found[0].magnification) == -np.sign(far.magnification)
            else:
                middle, *others, _ = found
                assert len(others) == 2
                for other in others:
                    assert other.magnification == pytest.approx(-0.5 * middle.magnification, rel=0.02)


def test_two_images_are_born_on_crossing_the_astroid() -> None:
    """A source just inside and just outside the astroid, as that of SDSS1206 is.

    Could go wrong: faint or merging images are lost, and the count changes elsewhere than on the caustic. Holds:
    four images change to two within 3e-8 of the cusp of the astroid, at the place that the critical curve has.
    """
    lens = PowerLawLens(1.0, 0.7, 0.0, 2.0)
    cusp = behind(lens, critical_point(lens, 0.0))[0]
    low, high = 0.2, 0.3
    for _ in range(24):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if len(solve_lens_equation(lens, middle, 0.0)) == 4 else (low, middle)
    # The astroid closes towards its cusp: within 1e-8 of it both its sides are nearer than 1e-12.
    assert low == pytest.approx(abs(cusp), abs=3e-8)
    assert len(solve_lens_equation(lens, low - 1e-6, 0.0)) == 4
    assert len(solve_lens_equation(lens, high + 1e-6, 0.0)) == 2


def test_a_source_behind_the_middle_of_a_round_lens_is_a_ring_and_refused() -> None:
    """A point source exactly behind a round lens: its image is a ring, not points.

    Could go wrong: some points of the ring are returned as images, as many as the search happens to hit. Holds: a
    LensEquationError that names the caustic; 1e-6 arcsec away there are the two images that an isothermal sphere
    has.
    """
    for slope in (1.7, 2.0, 2.3):
        with pytest.raises(LensEquationError, match="too close to a caustic"):
            solve_lens_equation(PowerLawLens(1.0, 1.0, 0.0, slope), 0.0, 0.0)
    sphere = PowerLawLens(1.0, 1.0, 0.0, 2.0)
    bright, faint = solve_lens_equation(sphere, 1e-6, 0.0)
    assert (bright.magnification, faint.magnification) == pytest.approx((1e6 + 1, 1 - 1e6), rel=1e-8)
    assert isinstance(LensEquationError("x"), EngineError)


def test_a_source_far_away_has_one_image() -> None:
    """A source thirty Einstein radii away.

    Could go wrong: the faint image beside the lens is counted, or none is found. Holds: one image, magnified as the
    isothermal lens does: by 1 + theta_E / r to first order.
    """
    lens = PowerLawLens(1.0, 0.8, 0.3, 2.0)
    (image,) = solve_lens_equation(lens, 30.0, -20.0)
    assert image.magnification == pytest.approx(1.0 + 1.0 / math.hypot(30.0, 20.0), abs=0.01)


def test_the_central_image_of_a_shallow_profile_is_left_out_and_found_where_it_is_asked_for() -> None:
    """The fifth image of a profile shallower than isothermal, at the centre of the lens.

    Could go wrong: it is counted with the images that an observer sees. Holds: four images by default; the fifth, a
    maximum of the arrival time fainter than a hundredth, where no least magnification is asked for.
    """
    lens = PowerLawLens(1.2, 0.85, 0.3, 1.8)
    assert len(solve_lens_equation(lens, 0.01, 0.02)) == 4
    fifth = all_images(lens, 0.01, 0.02)[-1]
    assert 0.0 < fifth.magnification < 0.01
    assert math.hypot(fifth.x, fifth.y) < 0.01


@pytest.mark.parametrize(("q", "slope"), [(0.05, 2.0), (0.05, 1.3), (0.8, 1.05), (0.8, 2.95), (0.05, 2.95)])
def test_all_images_behind_extreme_lenses_are_those_of_an_independent_solver(q: float, slope: float) -> None:
    """Lenses twenty times longer than wide, and slopes of 1.05 and 2.95: what the kernels take at most.

    Could go wrong: images are missed where the deflection varies over a twentieth of the distance from the lens.
    Holds: for ten sources every image brighter than a hundredth that a solver of one-dimensional roots finds is
    there, at the same place to 1e-9 arcsec, and every image maps back to its source to 1e-11.
    """
    lens, rng = PowerLawLens(1.0, q, 0.4, slope), np.random.default_rng(5)
    solver, compared = AngularSolver(lens), 0
    for _ in range(10):
        x, y = 0.5 * rng.standard_normal(2)
        ours = all_images(lens, x, y)
        for image in ours:
            assert abs(solver.source(image.x, image.y) - complex(x, y)) < 1e-11
        for px, py in solver.images(x, y):
            inverse = solver.inverse_magnification(px, py)
            if abs(inverse) < 100.0:
                nearest = min(math.hypot(image.x - px, image.y - py) for image in ours)
                assert nearest < 1e-9 + 1e-13 / abs(inverse), (x, y)
                compared += 1
    assert compared >= 10
