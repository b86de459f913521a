"""All images of a source: against lenstronomy, the catalogue, and beside caustics."""

import math

import numpy as np
import pytest

from engine.catalogue import load_system, system_facts, system_names
from engine.conventions import sky_to_image
from engine.lensing.lens_equation import solve_lens_equation
from engine.lensing.power_law import PowerLawLens, source_position
from engine.scene import power_law_lens


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
    for lens, x, y in random_configurations(60):
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
        # Burke's theorem without the central image, which the singular centre swallows for slope >= 2.
        assert len(images) in {1, 2, 3, 4, 5}
        assert sum(parities) in {-0, 0, 1}


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


def test_two_images_are_born_on_crossing_the_astroid() -> None:
    lens = PowerLawLens(1.0, 0.7, 0.0, 2.0)
    inside, outside = None, None
    low, high = 0.0, 0.6
    for _ in range(40):
        middle = 0.5 * (low + high)
        count = len(solve_lens_equation(lens, middle, 0.03))
        low, high = (middle, high) if count == 4 else (low, middle)
        inside, outside = low, high
    assert inside is not None
    assert outside is not None
    # The astroid's cusp on this axis lies where four images become two, found here to 1e-6 of the Einstein radius.
    assert high - low < 1e-6
    assert len(solve_lens_equation(lens, inside - 1e-5, 0.03)) == 4
    assert len(solve_lens_equation(lens, outside + 1e-5, 0.03)) == 2


def test_a_source_far_away_has_one_image() -> None:
    lens = PowerLawLens(1.0, 0.8, 0.3, 2.0)
    (image,) = solve_lens_equation(lens, 30.0, -20.0)
    assert image.magnification == pytest.approx(1.0, abs=0.05)


def test_the_central_image_of_a_shallow_profile_is_left_out() -> None:
    lens = PowerLawLens(1.2, 0.85, 0.3, 1.8)
    assert len(solve_lens_equation(lens, 0.01, 0.02)) == 4
