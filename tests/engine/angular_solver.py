"""An independent solver of the lens equation: one-dimensional roots in the elliptical angle, no cells, no Newton.

With z = R u(phi), u = (cos phi / q, sin phi), and alpha = R^(1-t) a(phi) in the frame of the major axis, and M = 1 -
Gamma, the lens equation beta = M z - alpha has one component along M u, which gives R(phi), and one across it, which
is then a function of phi alone. Its roots are the images; some pairs that are about to merge slip between the points of
its grid. Deflections come from scipy's 2F1, so that nothing is shared with the engine but the lens' parameters.
"""

import itertools
import math

import numpy as np
from scipy.optimize import brentq, minimize_scalar
from scipy.special import hyp2f1

from engine.lensing.power_law import PowerLawLens

_ANGLES = 240
_STEP = 2 * np.pi / _ANGLES
_GRID = np.arange(_ANGLES) * _STEP + 0.001
_FINE = 31
_EXACT = {"xatol": 1e-13}
_SAME = 1e-7
"""Roots this close are one, found in two overlapping windows."""


class AngularSolver:
    """All images of a source behind one lens, found by the roots of an angular function."""

    def __init__(self, lens: PowerLawLens) -> None:
        self.lens = lens
        self.t = lens.slope - 1.0
        c, s = math.cos(2 * lens.phi), math.sin(2 * lens.phi)
        self.g1 = c * lens.gamma1 + s * lens.gamma2
        self.g2 = c * lens.gamma2 - s * lens.gamma1
        self.scale = 2 * (lens.theta_E * math.sqrt(lens.q)) ** self.t / (1 + lens.q)
        self.coarse = self._parts(np.exp(1j * _GRID))

    def _parts(self, w):
        """M u and a(phi) as complex numbers, for w = exp(i phi)."""
        ux, uy = w.real / self.lens.q, w.imag
        ray = (1 - self.g1) * ux - self.g2 * uy + 1j * ((1 + self.g1) * uy - self.g2 * ux)
        f = (1 - self.lens.q) / (1 + self.lens.q)
        return ray, self.scale * w * hyp2f1(1, self.t / 2, 2 - self.t / 2, -f * w * w)

    def _bracket(self, a, b, branch):
        """Where a R - b R^s - c has one root: beyond its minimum (branch 0) or below it (1); s > 0 for branch 1."""
        s = 1.0 - self.t
        bottom = (b * s / a) ** (1 / (1 - s)) if s > 0 else 0.0 * a + 1e-14
        return (bottom, 0.0 * a + 1e4) if branch == 0 else (0.0 * a + 1e-14, bottom)

    def _values(self, parts: tuple[np.ndarray, np.ndarray], beta: complex, branch: int) -> np.ndarray:
        """As _across, on a grid of angles."""
        (ray, alpha), s = parts, 1.0 - self.t
        a, b = np.abs(ray) ** 2, (ray.conj() * alpha).real
        c = (ray.conj() * beta).real
        if s == 0.0:
            return np.where(b + c > 0, (ray.conj() * (beta + alpha)).imag, np.nan)
        low, high = self._bracket(a, b, branch)
        sign = -1.0 if branch else 1.0
        ok = (sign * (a * low - b * low**s - c) <= 0) & (sign * (a * high - b * high**s - c) >= 0)
        for _ in range(45):
            r = np.sqrt(low * high)
            above = sign * (a * r - b * r**s - c) > 0
            low, high = np.where(above, low, r), np.where(above, r, high)
        return np.where(ok, (ray.conj() * (beta + np.sqrt(low * high) ** s * alpha)).imag, np.nan)

    def _radius(self, phi: float, beta: complex, branch: int) -> tuple[float, complex, complex]:
        ray, alpha = self._parts(complex(math.cos(phi), math.sin(phi)))
        s = 1.0 - self.t
        a, b, c = abs(ray) ** 2, (ray.conjugate() * alpha).real, (ray.conjugate() * beta).real
        if s == 0.0:
            return ((b + c) / a if b + c > 0 else math.nan), ray, alpha
        return _monotone_root(a, b, c, s, branch), ray, alpha

    def _across(self, phi: float, beta: complex, branch: int) -> float:
        """The component of the lens equation across M u, whose roots in phi are the images."""
        r, ray, alpha = self._radius(phi, beta, branch)
        return math.nan if math.isnan(r) else (ray.conjugate() * (beta + r ** (1.0 - self.t) * alpha)).imag

    def images(self, x: float, y: float) -> list[tuple[float, float]]:
        """Image positions [arcsec, image frame]."""
        lens = self.lens
        # Shear acts about the origin of the image frame, so in the lens' frame it shifts the source.
        turn = complex(math.cos(lens.phi), math.sin(lens.phi))
        shift = (lens.gamma1 + 1j * lens.gamma2) * complex(lens.x, -lens.y)
        beta = (complex(x - lens.x, y - lens.y) + shift) / turn
        found = []
        for branch in (0, 1) if self.t < 1 else (0,):
            for phi in self._roots(beta, branch):
                r = self._radius(phi, beta, branch)[0]
                z = r * complex(math.cos(phi) / lens.q, math.sin(phi)) * turn
                found.append((z.real + lens.x, z.imag + lens.y))
        return found

    def source(self, x: float, y: float) -> complex:
        """Where an image position maps to, as x + i y."""
        lens = self.lens
        turn = complex(math.cos(lens.phi), math.sin(lens.phi))
        z = complex(x - lens.x, y - lens.y) / turn
        elliptical = complex(lens.q * z.real, z.imag)
        r = abs(elliptical)
        _, alpha = self._parts(elliptical / r)
        shear = complex(lens.gamma1, lens.gamma2) * complex(x, -y)
        return complex(x, y) - r ** (1.0 - self.t) * alpha * turn - shear

    def inverse_magnification(self, x: float, y: float) -> float:
        """Determinant of the Jacobian by fourth-order differences of the lens equation."""
        lens, source = self.lens, self.source
        # The deflection varies on the scale of the distance from the lens.
        step = 1e-3 * lens.q * math.hypot(x - lens.x, y - lens.y)

        def slope(dx: float, dy: float) -> complex:
            near = source(x + dx, y + dy) - source(x - dx, y - dy)
            far = source(x + 2 * dx, y + 2 * dy) - source(x - 2 * dx, y - 2 * dy)
            return (8 * near - far) / (12 * step)

        across, up = slope(step, 0.0), slope(0.0, step)
        return across.real * up.imag - across.imag * up.real

    def _roots(self, beta: complex, branch: int) -> list[float]:
        value = self._values(self.coarse, beta, branch)
        roots = []
        for k in _suspects(value, periodic=True):
            # Beside a cusp three roots may lie between two points of the grid.
            crossed = value[k - 1] * value[k] < 0 or value[k] * value[(k + 1) % _ANGLES] < 0
            reach = (0.6 if crossed else 1.1) * _STEP
            grid = np.linspace(_GRID[k] - reach, _GRID[k] + reach, _FINE)
            fine = self._values(self._parts(np.exp(1j * grid)), beta, branch)
            for m in _suspects(fine, periodic=False):
                roots += self._between(grid[m - 1], grid[m], grid[m + 1], beta, branch)
        roots = sorted(phi % (2 * math.pi) for phi in roots)
        return [phi for k, phi in enumerate(roots) if k == 0 or phi - roots[k - 1] > _SAME]

    def _between(self, low: float, middle: float, high: float, beta: complex, branch: int) -> list[float]:
        """Roots in (low, high), on one side and the other of an extremum where there is one."""

        def f(phi: float) -> float:
            return self._across(phi, beta, branch)

        ends = [low, middle, high]
        if f(low) * f(middle) > 0 and f(middle) * f(high) > 0:
            sign = math.copysign(1.0, f(middle))
            turn = minimize_scalar(lambda phi: sign * f(phi), bounds=(low, high), method="bounded", options=_EXACT)
            ends = [low, float(turn.x), high]
        return [brentq(f, a, b, xtol=1e-15) for a, b in itertools.pairwise(ends) if f(a) * f(b) < 0]


@np.errstate(over="ignore")
def _monotone_root(a: float, b: float, c: float, s: float, branch: int) -> float:
    """Root of a r - b r^s - c for a, b > 0 by Newton from the side on which it converges without overshooting."""
    if s < 0:  # rising and concave: from below
        r = min((b / (2 * a)) ** (1 / (1 - s)), (b / (2 * abs(c) + 1e-9)) ** (-1 / s))
    else:  # convex
        bottom = (b * s / a) ** (1 / (1 - s))
        if a * bottom - b * bottom**s - c > 0 or (branch == 1 and c >= 0):
            return math.nan
        r = (-c / b) ** (1 / s) if branch else max((2 * b / a) ** (1 / (1 - s)), 2 * abs(c) / a)
    if r == 0.0:
        return math.nan
    for _ in range(200):
        change = (a * r - b * r**s - c) / (a - s * b * r ** (s - 1))
        r -= change
        if abs(change) <= 4e-16 * r:
            break
    return r


def _suspects(value: np.ndarray, *, periodic: bool) -> np.ndarray:
    """Grid points beside a change of sign, or where the modulus has a minimum that may hide two."""
    before, after = np.roll(value, 1), np.roll(value, -1)
    crossed = (value * before < 0) | (value * after < 0)
    found = crossed | ((np.abs(value) <= np.abs(before)) & (np.abs(value) <= np.abs(after)))
    if not periodic:
        found[[0, -1]] = False
    return np.flatnonzero(found)
