"""All images of a source: against lenstronomy, the catalogue, and beside caustics."""

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from engine.catalogue import load_system, system_facts, system_names
from engine.conventions import sky_to_image
from engine.lensing.lens_equation import solve_lens_equation
from engine.lensing.power_law import PowerLawLens, magnification, source_position
from engine.simulation.scene import power_law_lens
from tests.engine.angular_solver import AngularSolver


def lenstronomy_images(lens: PowerLawLens, x: float, y: float) -> list[tuple[float, float, float]]:
    from lenstronomy.LensModel.lens_model import LensModel
    from lenstronomy.LensModel.Solver.lens_equation_solver import LensEquationSolver
    from lenstronomy.Util.param_util import phi_q2_ellipticity

    e1, e2 = phi_q2_ellipticity(lens.phi, lens.q)
    kwargs = [
        {
            "theta_E": lens.theta_E,
            "gamma": lens.slope,
            "e1": e1,
            "e2": e2,
            "center_x": lens.x,
            "center_y": lens.y,
        },
        {"gamma1": lens.gamma1, "gamma2": lens.gamma2},
    ]
    model = LensModel(["EPL", "SHEAR"])
    with np.errstate(all="ignore"):  # it looks for its roots beyond where there are numbers, too
        px, py = LensEquationSolver(model).image_position_from_source(
            x, y, kwargs, solver="analytical", magnification_limit=1e-2
        )
    return list(zip(px, py, model.magnification(px, py, kwargs), strict=True))


def random_configurations(number: int) -> list[tuple[PowerLawLens, float, float]]:
    rng = np.random.default_rng(7)
    out = []
    for _ in range(number):
        lens = PowerLawLens(
            rng.uniform(0.4, 2.0),
            rng.uniform(0.4, 0.98),
            rng.uniform(-1.5, 1.5),
            rng.uniform(1.7, 2.4),
            rng.uniform(-0.05, 0.05),
            rng.uniform(-0.05, 0.05),
        )
        radius, angle = 0.6 * lens.theta_E * rng.uniform() ** 0.5, rng.uniform(0, 2 * math.pi)
        out.append((lens, radius * math.cos(angle), radius * math.sin(angle)))
    return out


def test_the_images_are_those_of_lenstronomy() -> None:
    # A few, by a code that everybody knows; as many as one likes by the solver below.
    for lens, x, y in random_configurations(25):
        ours, theirs = solve_lens_equation(lens, x, y), lenstronomy_images(lens, x, y)
        assert len(ours) == len(theirs), (lens, x, y)
        for px, py, mu in theirs:
            nearest = min(ours, key=lambda image: math.hypot(image.x - px, image.y - py))
            # lenstronomy's analytical solver stops at about 1e-8 arcsec.
            assert math.hypot(nearest.x - px, nearest.y - py) < 1e-6
            assert nearest.magnification == pytest.approx(mu, rel=1e-3)


def test_every_image_maps_back_to_the_source_and_parities_add_up() -> None:
    for lens, x, y in random_configurations(200):
        images = solve_lens_equation(lens, x, y, min_magnification=0.0)
        bx, by = source_position(lens, np.array([i.x for i in images]), np.array([i.y for i in images]))
        assert np.allclose(bx, x, rtol=0, atol=1e-11)
        assert np.allclose(by, y, rtol=0, atol=1e-11)
        parities = [1 if image.magnification > 0 else -1 for image in images]
        # Burke's theorem: minima and maxima are one more than saddles. A slope of 2 and more swallows the maximum, and
        # just below 2 it stands nearer to the centre than any number can say.
        total, number = sum(parities), len(images)
        if lens.slope > 2.0:
            assert (total, number) in {(0, 2), (0, 4)}, (lens, x, y)
        elif lens.slope < 1.9 and total == 0:
            solver = AngularSolver(lens)
            faint = min(solver.images(x, y), key=lambda found: math.hypot(found[0] - lens.x, found[1] - lens.y))
            # The central image, a hundred thousand times fainter than what would be asked for.
            assert abs(solver.inverse_magnification(*faint)) > 1e7, (lens, x, y)
            assert number in {2, 4}
        elif lens.slope < 1.9:
            assert (total, number) in {(1, 1), (1, 3), (1, 5)}, (lens, x, y)
        else:
            assert (total, number) in {(0, 2), (0, 4), (1, 1), (1, 3), (1, 5)}, (lens, x, y)


@pytest.mark.parametrize("name", system_names())
def test_the_catalogue_has_as_many_images_as_the_lens_equation_and_where_it_says(name: str) -> None:
    for model, by_slope in system_facts(name)["mass_models"].items():
        for slope, facts in by_slope.items():
            lens = power_law_lens(load_system(name).mass_model(model, float(slope)))
            x, y = sky_to_image(tuple(facts["source_position"]))
            images = solve_lens_equation(lens, x, y)
            check = facts["check"]
            assert len(images) == check["n_images"], (model, slope)
            total = sum(abs(image.magnification) for image in images)
            assert total == pytest.approx(check["total_magnification"], rel=3e-3)
            for east, north, _ in check["images"].values():
                distance = min(math.hypot(image.x + east, image.y - north) for image in images)
                # The catalogue's parameters are rounded to 1e-4 arcsec or 5e-5 in q.
                assert distance < 1.5e-3


def caustic_point(lens: PowerLawLens, rng: np.random.Generator) -> tuple[float, float, float, float]:
    """A point of the tangential caustic, and a unit vector of any direction."""
    # Half of the directions lie near the axes of the lens, where the caustic has its cusps.
    angle = rng.uniform(0, 2 * math.pi)
    if rng.uniform() < 0.5:
        angle = lens.phi + 0.5 * math.pi * rng.integers(4) + rng.normal(0, 0.02)
    low, high = 0.02 * lens.theta_E, 20.0 * lens.theta_E
    cos, sin = math.cos(angle), math.sin(angle)
    radii = np.geomspace(high, low, 600)
    determinant = 1 / magnification(lens, lens.x + radii * cos, lens.y + radii * sin)
    first = int(np.flatnonzero(determinant < 0)[0])
    r = brentq(
        lambda r: 1 / float(magnification(lens, np.array(lens.x + r * cos), np.array(lens.y + r * sin))),
        radii[first],
        radii[first - 1],
        xtol=1e-15,
    )
    x, y = source_position(lens, np.array(lens.x + r * cos), np.array(lens.y + r * sin))
    across = rng.uniform(0, 2 * math.pi)
    return float(x), float(y), math.cos(across), math.sin(across)


def any_lens(rng: np.random.Generator) -> PowerLawLens:
    theta_E = rng.uniform(0.3, 2.5)
    return PowerLawLens(
        theta_E,
        rng.uniform(0.3, 0.99),
        rng.uniform(-1.6, 1.6),
        rng.choice([2.0, rng.uniform(1.4, 2.6)]),
        *rng.uniform(-0.1, 0.1, 2),
        *(rng.uniform(-0.15, 0.15, 2) * rng.choice([0.0, 1.0])),
    )


@pytest.mark.parametrize(
    ("part", "number"), [(0, 300), *(pytest.param(part, 2500, marks=pytest.mark.long) for part in range(4))]
)
def test_all_images_parities_and_magnifications_are_those_of_an_independent_solver(part: int, number: int) -> None:
    # 10,000 configurations in the long ones, every other within 1e-7 to 1e-2 theta_E of the tangential caustic.
    rng, found_by_both = np.random.default_rng([2017, part]), 0
    for k in range(number):
        lens = any_lens(rng)
        radius, angle = lens.theta_E * rng.uniform() ** 0.5, rng.uniform(0, 2 * math.pi)
        x, y = lens.x + radius * math.cos(angle), lens.y + radius * math.sin(angle)
        if k % 2:
            x, y, dx, dy = caustic_point(lens, rng)
            away = lens.theta_E * 10 ** rng.uniform(-7, -2)
            x, y = x + away * dx, y + away * dy
        solver = AngularSolver(lens)
        theirs = [(px, py, solver.inverse_magnification(px, py)) for px, py in solver.images(x, y)]
        ours = solve_lens_equation(lens, x, y, min_magnification=0.0)
        where = f"{lens}, source {x!r} {y!r}"
        for px, py, inverse in theirs:
            if abs(inverse) > 100.0:
                continue  # fainter than a hundredth: the central image, which the engine leaves out
            found = min(ours, key=lambda image: math.hypot(image.x - px, image.y - py))
            # The lens equation holds to rounding, 1e-15 arcsec, so an image is known to that times 1/inverse.
            assert math.hypot(found.x - px, found.y - py) < 1e-9 + 1e-13 / abs(inverse), where
            # Fourth-order differences over 1e-3 of the distance from the lens; the position's error adds to it.
            assert 1 / found.magnification == pytest.approx(inverse, rel=1e-7, abs=1e-8 + 1e-12 / abs(inverse)), where
        # What the engine finds beyond that is an image as well, and each is found once.
        for i, image in enumerate(ours):
            assert abs(solver.source(image.x, image.y) - complex(x, y)) < 1e-11, where
            assert all(math.hypot(image.x - other.x, image.y - other.y) > 1e-5 * lens.theta_E for other in ours[:i])
        found_by_both += sum(abs(inverse) <= 100.0 for *_, inverse in theirs)
    assert found_by_both > 2 * number  # the comparison is not empty
