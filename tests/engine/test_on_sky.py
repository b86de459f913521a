"""Angles and positions on the sky, however an image stands there."""

import math

import numpy as np
import pytest

from engine.conventions import NORTH_UP, Orientation, position_angle, sky_to_image
from engine.imaging.observation import Observation
from engine.on_sky import lens_on_sky, places_on_sky
from engine.result import Quantity

TURNS = [Orientation(math.radians(turn + 90.0), mirrored) for turn in (0.0, 60.0, 250.0) for mirrored in (False, True)]


def test_north_up_is_what_the_conventions_say() -> None:
    assert NORTH_UP.on_sky(0.3, -0.7) == pytest.approx(sky_to_image((0.3, -0.7)), abs=1e-15)
    for phi in (0.0, 0.4, 2.9):
        assert NORTH_UP.position_angle(phi) == pytest.approx(position_angle(phi), abs=1e-9)


@pytest.mark.parametrize("orientation", TURNS)
def test_a_position_angle_is_that_of_the_positions_along_the_axis(orientation: Orientation) -> None:
    for phi in (0.1, 1.0, 2.5):
        east, north = orientation.on_sky(math.cos(phi), math.sin(phi))
        difference = orientation.position_angle(phi) - math.degrees(math.atan2(east, north))
        assert math.remainder(difference, 180.0) == pytest.approx(0.0, abs=1e-9)
    # East lies counter-clockwise of North on the sky; in the image it does so unless it is mirrored.
    (e1, n1), (e2, n2) = (orientation.on_sky(*axis) for axis in ((1.0, 0.0), (0.0, 1.0)))
    assert e1 * n2 - e2 * n1 == pytest.approx(1.0 if orientation.mirrored else -1.0)


@pytest.mark.parametrize("orientation", TURNS)
def test_one_lens_is_the_same_on_the_sky_in_every_frame(orientation: Orientation) -> None:
    def in_frame(east: float, north: float) -> tuple[float, float]:
        # The inverse of on_sky, which is orthogonal.
        (e1, n1), (e2, n2) = (orientation.on_sky(*axis) for axis in ((1.0, 0.0), (0.0, 1.0)))
        return e1 * east + n1 * north, e2 * east + n2 * north

    axis, pull = math.radians(30.0), math.radians(110.0)
    along, shear = in_frame(math.sin(axis), math.cos(axis)), in_frame(math.sin(pull), math.cos(pull))
    x, y = in_frame(0.2, -0.1)
    g = 2.0 * math.atan2(shear[1], shear[0])
    values = {"phi": math.atan2(along[1], along[0]), "x": x, "y": y, "gamma1": 0.08 * math.cos(g)}
    lens = {name: Quantity(value, 0.01) for name, value in (values | {"gamma2": 0.08 * math.sin(g)}).items()}
    found = lens_on_sky(lens, orientation)
    assert found["position_angle"].mean == pytest.approx(30.0)
    assert (found["east"].mean, found["north"].mean) == pytest.approx((0.2, -0.1))
    assert found["shear"].mean == pytest.approx(0.08)
    assert found["shear_position_angle"].mean == pytest.approx(110.0)
    assert found["position_angle"].sd == pytest.approx(math.degrees(0.01))


def test_places_have_right_ascension_where_the_middle_has() -> None:
    parts = {"image": np.zeros((5, 5)), "noise": np.ones((5, 5)), "psf": np.ones((3, 3))}
    seen = Observation(**parts, pixel_scale=0.1, zero_point=25.0, centre=(10.0, 60.0))
    (place,) = places_on_sky([(-1.0, 0.5)], seen)
    assert (place["east"], place["north"]) == pytest.approx((1.0, 0.5))
    assert place["dec"] == pytest.approx(60.0 + 0.5 / 3600, abs=1e-8)
    assert place["ra"] == pytest.approx(10.0 + 1.0 / 3600 / math.cos(math.radians(60.0 + 0.5 / 3600)), abs=1e-8)
    bare = Observation(**parts, pixel_scale=0.1, zero_point=25.0)
    assert places_on_sky([(0.0, 0.0)], bare)[0]["ra"] is None
