"""The deflection: how many terms of its series, against the integral over the lens' elliptical shells."""

from __future__ import annotations

import numpy as np
from scipy.integrate import quad_vec

from engine.accuracy import peers
from engine.accuracy.curves import Curve, Knob, Point
from engine.accuracy.subject import Subject
from engine.accuracy.timing import Measuring, least_cpu
from engine.codes.installed import installed
from engine.conventions import FloatArray
from engine.lensing.power_law import (
    SERIES_TOLERANCE,
    LensConstants,
    PowerLawLens,
    lens_constants,
    series_coefficients,
    trace_rays,
)

STAGE = "deflection"
SERIES = Knob(
    stage=STAGE,
    name="series tolerance",
    place="engine.lensing.power_law.SERIES_TOLERANCE",
    quantity="largest error of a deflection",
    unit="arcsec",
    work="source positions of 10,000 rays",
    reference="the integral over elliptical shells (Schramm 1990), by adaptive quadrature",
)
_TOLERANCES = (1e-2, 1e-3, 1e-4, 1e-6, 1e-8, 1e-12)
_RAYS, _CHECKED = 10_000, 40
FLOOR = 2e-14
"""Rounding of the integral, and of positions of an arcsec or two."""


def shell_deflection(lens: PowerLawLens, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Deflection [arcsec] at positions (k,): no hypergeometric function, no series (Schramm 1990; Keeton 2001, eq. 15).

    With p = 2/(2 - t) and u = w^p the integrand has no singularity.
    """
    c, s, q, t = np.cos(lens.phi), np.sin(lens.phi), lens.q, lens.slope - 1.0
    dx, dy = x - lens.x, y - lens.y
    u, v = c * dx + s * dy, c * dy - s * dx
    power, spread = 2.0 / (2.0 - t), 1.0 - q * q

    def integrand(w: float) -> FloatArray:
        fraction = w**power
        shell = 1.0 - spread * fraction
        # kappa at the shell, without w^(-1), which du = p w^(p - 1) dw takes up.
        radius = np.sqrt(q * (u * u + v * v / shell))
        kappa = 0.5 * (2.0 - t) * (lens.theta_E / radius) ** t
        return np.asarray(power * kappa * np.stack([shell**-0.5 * np.ones_like(u), shell**-1.5 * np.ones_like(u)]))

    (j0, j1), _ = quad_vec(integrand, 0.0, 1.0, epsabs=1e-15, epsrel=1e-14, limit=2000)
    ax, ay = q * u * j0, q * v * j1
    shear_x, shear_y = lens.gamma1 * x + lens.gamma2 * y, lens.gamma2 * x - lens.gamma1 * y
    return c * ax - s * ay + shear_x, s * ax + c * ay + shear_y


def _constants(lens: PowerLawLens, tolerance: float) -> LensConstants:
    return lens_constants(lens)._replace(series=series_coefficients(lens.q, lens.slope - 1.0, tolerance))


def measure(subject: Subject) -> list[Curve]:
    """The one knob of this stage."""
    lens = subject.scene.lens
    x, y = np.random.default_rng(0).uniform(-subject.reach, subject.reach, (2, _RAYS))
    bx, by = np.empty(_RAYS), np.empty(_RAYS)
    few = slice(_CHECKED)
    exact_x, exact_y = shell_deflection(lens, x[few], y[few])

    def error(ax: FloatArray, ay: FloatArray) -> float:
        return float(max(np.abs(ax[few] - exact_x).max(), np.abs(ay[few] - exact_y).max()))

    found = Measuring(SERIES, FLOOR)
    for tolerance in (*_TOLERANCES, SERIES_TOLERANCE):

        def one(tolerance: float = tolerance) -> tuple[float, float]:
            constants = _constants(lens, tolerance)
            cost = least_cpu(lambda: trace_rays(x, y, constants, bx, by))
            return cost, error(x - bx, y - by)

        found.add(f"{tolerance:.0e}", one, default=tolerance == SERIES_TOLERANCE)
    if installed("lenstronomy"):
        for profile in ("EPL_NUMBA", "EPL"):
            work = peers.lenstronomy_deflection(lens, profile, x, y)
            found.add_peers([Point(profile, least_cpu(work), error(*work()), peer="lenstronomy")])
    return [found.curve()]
