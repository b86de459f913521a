"""Mass beside the power law: from the potential by numerical derivatives, images by a plain search, source by all."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy.integrate import quad

from engine.errors import SpecError
from engine.lensing.lens_equation import makes_ring, solve_lens_equation
from engine.lensing.perturbers import Multipole, Perturber, Satellite
from engine.lensing.power_law import PowerLawLens, convergence_and_shear, deflection, magnification, source_position
from engine.lensing.ray_derivatives import ray_constants

MAIN = PowerLawLens(1.2, 0.75, 0.4, 2.1, 0.03, -0.02, 0.02, -0.04)
PERTURBERS: dict[str, tuple[Perturber, ...]] = {
    "m = 3": (Multipole(3, 0.02, 0.7),),
    "m = 4": (Multipole(4, -0.03, 0.4),),
    "round satellite": (Satellite(0.1, 0.8, 0.9),),
    "flat satellite": (Satellite(0.15, -0.7, 1.0, 0.6, 1.1),),
    "all": (Multipole(3, 0.01, 0.2), Multipole(4, 0.02, 0.4), Satellite(0.1, 0.8, 0.9, 0.8, 0.3)),
}
POINTS = np.random.default_rng(5).uniform(-2.0, 2.0, (2, 40))


def without(lens: PowerLawLens, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Deflection of the perturbers alone."""
    ax, ay = deflection(lens, x, y)
    bx, by = deflection(MAIN, x, y)
    return ax - bx, ay - by


def multipole_potential(one: Multipole, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """By the separated Poisson equation, with Green's function instead of the closed form: two radial integrals."""
    t, m = MAIN.slope - 1.0, one.m
    out = []
    for r, angle in zip(np.hypot(x - MAIN.x, y - MAIN.y), np.arctan2(y - MAIN.y, x - MAIN.x), strict=True):

        def kappa(s: float) -> float:
            return 0.5 * (2.0 - t) * (MAIN.theta_E / s) ** t * t * one.amplitude

        inner = quad(lambda s: kappa(s) * s * (s / r) ** m, 0.0, r)[0]  # noqa: B023 - used at once
        outer = quad(lambda s: kappa(s) * s * (r / s) ** m, r, math.inf)[0]  # noqa: B023 - used at once
        out.append(-(inner + outer) / m * math.cos(m * (angle - one.phi)))
    return np.array(out)


def satellite_potential(one: Satellite, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Of an isothermal lens: r . alpha (its deflection is homogeneous of degree 0), alpha from its shells.

    An isodensity ellipse of axes (a, a q) has no pull inside; outside it acts as its confocal does, which integrated
    over a is the line integral here.
    """
    turn = np.exp(-1j * one.phi)
    z = ((x - one.x) + 1j * (y - one.y)) * turn
    out = []
    for point in z:
        # Bourassa and Kantowski (1975): alpha* = 2 q int kappa(s) s ds / sqrt(z^2 - (1 - q^2) s^2), s the major axis.
        edge = math.hypot(point.real, point.imag / one.q)
        kappa = 0.5 * one.theta_E / math.sqrt(one.q)

        def integrand(s: float) -> complex:
            return 2.0 * one.q * kappa / np.sqrt(1.0 - (1.0 - one.q**2) * (s / point) ** 2) / point  # noqa: B023

        real = quad(lambda s: integrand(s).real, 0.0, edge)[0]
        imaginary = quad(lambda s: integrand(s).imag, 0.0, edge)[0]
        out.append((point * complex(real, imaginary)).real)
    return np.array(out)


def potential(lens: PowerLawLens, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    known = {Multipole: multipole_potential, Satellite: satellite_potential}
    return sum((known[type(one)](one, x, y) for one in lens.perturbers), np.zeros(x.size))  # type: ignore[operator]


@pytest.mark.parametrize("name", PERTURBERS)
def test_the_deflection_is_the_gradient_of_the_potential(name: str) -> None:
    lens = MAIN.with_values(perturbers=PERTURBERS[name])  # type: ignore[arg-type]
    x, y = POINTS[:, :12]
    ax, ay = without(lens, x, y)
    h = 1e-4
    # Central differences err as h^2 times third derivatives, 1e-8 over a distance from a satellite squared; quad 1e-8.
    by_x = (potential(lens, x + h, y) - potential(lens, x - h, y)) / (2.0 * h)
    by_y = (potential(lens, x, y + h) - potential(lens, x, y - h)) / (2.0 * h)
    assert np.hypot(ax - by_x, ay - by_y).max() < 2e-6


@pytest.mark.parametrize("name", PERTURBERS)
def test_convergence_and_shear_are_derivatives_of_the_deflection(name: str) -> None:
    lens = MAIN.with_values(perturbers=PERTURBERS[name])  # type: ignore[arg-type]
    x, y = POINTS
    h = 1e-5
    right, left = deflection(lens, x + h, y), deflection(lens, x - h, y)
    up, down = deflection(lens, x, y + h), deflection(lens, x, y - h)
    xx, yx = ((a - b) / (2.0 * h) for a, b in zip(right, left, strict=True))
    xy, yy = ((a - b) / (2.0 * h) for a, b in zip(up, down, strict=True))
    kappa, gamma1, gamma2 = convergence_and_shear(lens, x, y)
    # 1e-10 h^2 over distances of 0.05 arcsec cubed at worst.
    for ours, numeric in ((kappa, 0.5 * (xx + yy)), (gamma1, 0.5 * (xx - yy)), (gamma2, xy), (gamma2, yx)):
        assert np.abs(ours - numeric).max() < 1e-6


@pytest.mark.parametrize("name", PERTURBERS)
def test_rays_are_traced_by_the_whole_mass(name: str) -> None:
    lens = MAIN.with_values(perturbers=PERTURBERS[name])  # type: ignore[arg-type]
    x, y = POINTS
    ax, ay = deflection(lens, x, y)
    bx, by = source_position(lens, x, y)
    assert np.abs(bx - (x - ax)).max() < 1e-13
    assert np.abs(by - (y - ay)).max() < 1e-13


def test_contours_of_a_round_lens_depart_by_the_amplitude() -> None:
    lens = PowerLawLens(1.0, 1.0, 0.0, 1.8, perturbers=(Multipole(4, 0.02, 0.5),))
    outwards, across = (
        float(convergence_and_shear(lens, np.array(r * np.cos(a)), np.array(r * np.sin(a)))[0])
        for r, a in ((1.02, 0.5), (0.98, 0.5 + math.pi / 4.0))
    )
    # The definition is to first order in the amplitude: second order is 0.02^2.
    assert outwards == pytest.approx(across, rel=2e-3)


@pytest.mark.parametrize("name", PERTURBERS)
def test_all_images_are_found(name: str) -> None:
    """Beside a plain search: every cell of a fine grid whose mapped triangles hold the source has an image in it."""
    lens = MAIN.with_values(perturbers=PERTURBERS[name])  # type: ignore[arg-type]
    axis = np.arange(-2.5, 2.5, 0.004) + 0.00137
    bx, by = source_position(lens, axis[None, :], axis[:, None])
    rng = np.random.default_rng(11)
    for _ in range(6):
        sx, sy = rng.uniform(-0.25, 0.25, 2)
        found = solve_lens_equation(lens, sx, sy, min_magnification=0.0)
        for image in found:
            x, y = source_position(lens, np.array(image.x), np.array(image.y))
            assert math.hypot(float(x) - sx, float(y) - sy) < 1e-11
        hits = _cells_with_source(bx, by, sx, sy)
        places = np.array([(axis[i] + 0.002, axis[j] + 0.002) for j, i in hits])
        images = np.array([(image.x, image.y) for image in found])
        mu = [float(magnification(lens, np.array(x), np.array(y))) for x, y in places]
        for place, size in zip(places, mu, strict=True):
            # A cell that holds the centre of a mass maps round the source without an image in it.
            singular = min(
                [math.hypot(place[0] - lens.x, place[1] - lens.y)]
                + [math.hypot(place[0] - p.x, place[1] - p.y) for p in lens.perturbers if isinstance(p, Satellite)]
            )
            if singular > 0.01 and abs(size) > 1e-2:
                assert np.hypot(*(images - place).T).min() < 0.02, (name, place, size)


def _cells_with_source(bx: np.ndarray, by: np.ndarray, sx: float, sy: float) -> list[tuple[int, int]]:
    low, high = slice(None, -1), slice(1, None)
    corners = [(bx[j, i], by[j, i]) for j, i in ((low, low), (low, high), (high, high), (high, low))]
    inside = np.zeros(bx[:-1, :-1].shape, dtype=bool)
    for order in ((0, 1, 2), (0, 2, 3)):
        sides = []
        for a, b in itertools.pairwise((*order, order[0])):
            (ax, ay), (cx, cy) = corners[a], corners[b]
            sides.append((cx - ax) * (sy - ay) - (cy - ay) * (sx - ax))
        inside |= np.all([side >= 0 for side in sides], axis=0) | np.all([side <= 0 for side in sides], axis=0)
    return [(int(j), int(i)) for j, i in zip(*np.nonzero(inside), strict=True)]


def test_a_lens_with_a_satellite_makes_no_ring() -> None:
    round_lens = PowerLawLens(1.0, 1.0, 0.0, 2.0)
    assert makes_ring(round_lens, 0.0, 0.0)
    assert not makes_ring(round_lens.with_values(perturbers=(Satellite(0.1, 1.0, 0.0),)), 0.0, 0.0)  # type: ignore[arg-type]


def test_a_lens_that_is_fitted_has_no_perturbers() -> None:
    with pytest.raises(SpecError, match="perturbers"):
        ray_constants(MAIN.with_values(perturbers=PERTURBERS["m = 3"]))  # type: ignore[arg-type]


def test_what_the_formulas_do_not_cover_is_refused() -> None:
    for wrong in (lambda: Multipole(2, 0.1, 0.0), lambda: Satellite(0.0, 0.0, 0.0), lambda: Satellite(0.1, 0, 0, 0.0)):
        with pytest.raises(SpecError):
            wrong()
