"""Mass beside an elliptical power law: multipoles of its outline, and satellites. Closed forms, each with its centre.

A multipole has the slope of the power law that it belongs to, kappa = (2 - t)/2 t a (theta_E / r)^t cos m(phi - phi_m):
isodensity contours of a round lens depart from circles by a r cos m(phi - phi_m). With psi = C r^(2 - t) cos m(phi -
phi_m) and the Laplacian in polar coordinates C = (2 - t) t a theta_E^t / ((2 - t)^2 - m^2); for t = 1 that is the form
of Chu et al. (2013) and of Xu et al. (2015).

A satellite is a singular isothermal ellipsoid (Kormann, Schneider and Bartelmann 1994), kappa = theta_E / 2 R with
R = sqrt(q x^2 + y^2/q): the deflection is theta_E sqrt(q) / f (atan(f x / psi), artanh(f y / psi)) along its axes,
f^2 = 1 - q^2, psi^2 = q^2 x^2 + y^2.

Both deflections are homogeneous, of degree 1 - t and 0, so that the shear follows from them by Euler's relation as in
:mod:`engine.lensing.power_law`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from engine.compiled import kernel
from engine.conventions import FloatArray
from engine.errors import SpecError

_MULTIPOLE, _SATELLITE = 0.0, 1.0
_KIND, _X, _Y, _AMPLITUDE, _COS, _SIN, _SHAPE, _T = range(8)
_COLUMNS = 8
_ROUND = 1e-7
"""sqrt(1 - q^2) below which the formulas of a round satellite hold to rounding."""


@dataclass(frozen=True)
class Multipole:
    """Isodensity contours depart in order ``m`` by ``amplitude`` times their radius, most outwards at ``phi`` [rad]."""

    m: int
    amplitude: float
    phi: float

    def __post_init__(self) -> None:
        """Refuse what the formulas do not cover."""
        if self.m < 3:
            raise SpecError("m", self.m, "3 or more: 1 is a shift and 2 an ellipse")


@dataclass(frozen=True)
class Satellite:
    """A singular isothermal ellipsoid: theta_E [arcsec, intermediate axis], centre [arcsec], q, angle [rad]."""

    theta_E: float
    x: float
    y: float
    q: float = 1.0
    phi: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what the formulas do not cover."""
        if not self.theta_E > 0:
            raise SpecError("theta_E", self.theta_E, "a positive Einstein radius")
        if not 0 < self.q <= 1:
            raise SpecError("q", self.q, "an axis ratio in (0, 1]")


Perturber = Multipole | Satellite


def perturber_rows(perturbers: Sequence[Perturber], theta_E: float, t: float, x: float, y: float) -> FloatArray:
    """Perturbers (k, 8) as the kernels take them; multipoles are of a power law at (x, y) with theta_E and slope t."""
    rows = np.zeros((len(perturbers), _COLUMNS))
    for row, one in zip(rows, perturbers, strict=True):
        if isinstance(one, Multipole):
            factor = (2.0 - t) * t * one.amplitude * theta_E**t / ((2.0 - t) ** 2 - one.m**2)
            row[:] = _MULTIPOLE, x, y, factor, math.cos(one.m * one.phi), math.sin(one.m * one.phi), one.m, t
        else:
            row[:] = (
                _SATELLITE, one.x, one.y, one.theta_E * math.sqrt(one.q), math.cos(one.phi), math.sin(one.phi), one.q,
                1.0,
            )  # fmt: skip
    return rows


@kernel
def perturb_point(x: float, y: float, rows: FloatArray) -> tuple[float, float]:
    """Deflection [arcsec] of all perturbers at one point; at the centre of one its own is taken for zero."""
    total_x, total_y = 0.0, 0.0
    for k in range(rows.shape[0]):
        ax, ay, _ = _one(x, y, rows[k])
        total_x += ax
        total_y += ay
    return total_x, total_y


@kernel
def perturb_jacobian(x: float, y: float, rows: FloatArray) -> tuple[float, float, float]:
    """Convergence and shear of all perturbers at one point; at the centre of one the first is infinite."""
    total, total1, total2 = 0.0, 0.0, 0.0
    for k in range(rows.shape[0]):
        dx, dy = x - rows[k, _X], y - rows[k, _Y]
        r2 = dx * dx + dy * dy
        if r2 == 0.0:
            return np.inf, total1, total2
        ax, ay, kappa = _one(x, y, rows[k])
        t = rows[k, _T]
        re = (1.0 - t) * ax - dx * kappa
        im = (1.0 - t) * ay - dy * kappa
        total += kappa
        total1 += (re * dx - im * dy) / r2
        total2 += (re * dy + im * dx) / r2
    return total, total1, total2


@kernel
def _one(x: float, y: float, row: FloatArray) -> tuple[float, float, float]:
    """Deflection and convergence of one perturber."""
    dx, dy = x - row[_X], y - row[_Y]
    r = math.sqrt(dx * dx + dy * dy)
    if r == 0.0:
        return 0.0, 0.0, 0.0
    c, s, t = row[_COS], row[_SIN], row[_T]
    if row[_KIND] == _MULTIPOLE:
        m = row[_SHAPE]
        angle = m * math.atan2(dy, dx)
        sine, cosine = math.sin(angle), math.cos(angle)
        along, across = c * cosine + s * sine, c * sine - s * cosine
        factor = row[_AMPLITUDE] * r ** (1.0 - t)
        radial, turned = factor * (2.0 - t) * along, -factor * m * across
        kappa = 0.5 * factor / r * ((2.0 - t) ** 2 - m * m) * along
        return (radial * dx - turned * dy) / r, (radial * dy + turned * dx) / r, kappa
    q = row[_SHAPE]
    u, v = c * dx + s * dy, c * dy - s * dx
    psi = math.sqrt(q * q * u * u + v * v)
    f = math.sqrt(1.0 - q * q)
    if f < _ROUND:
        au, av = u / psi, v / psi
    else:
        au, av = math.atan(f * u / psi) / f, math.atanh(f * v / psi) / f
    b = row[_AMPLITUDE]
    return b * (c * au - s * av), b * (s * au + c * av), 0.5 * b / psi
