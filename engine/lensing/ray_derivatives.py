"""Derivatives of where rays meet the source plane by the parameters of the lens, analytically.

With the notation of :mod:`engine.lensing.power_law` the deflection is alpha = e^{i phi} A,
A = K R^{1-t} e^{i phi'} S(w; f, t), K = 2 b^t / (1 + q), w = e^{2 i phi'}. Its derivatives need two more series beside
S: that with the coefficients k a_k / f, which is dS/df and gives dS/dphi', and that with d a_k / dt.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from engine.compiled import inlined_kernel
from engine.conventions import FloatArray
from engine.errors import SpecError
from engine.lensing.power_law import PowerLawLens

LENS_DERIVATIVES = 6
"""By theta_E, e1, e2, slope, x and y; those by the shear are the ray's own position."""

_ROUND = 1e-6
"""Ellipticity from which on a lens has a direction; the derivatives by e1 and e2 are smooth through the circle."""
_TOLERANCE = 1e-9
_LEAST_RADIUS = 1e-3
"""Distance [arcsec] from the centre of the lens inside which the deflection is not differentiated any nearer."""


class RayConstants(NamedTuple):
    """A lens as :func:`ray_derivatives` takes it: as in :class:`~engine.lensing.power_law.LensConstants`, and more.

    ``front`` is 2 b / (1 + q), ``by_theta`` and ``front_by_f`` are d ln K by theta_E and by f, ``q_by_f`` is dq/df;
    (``cos2``, ``sin2``) are those of 2 phi; ``series`` (3, k) are the coefficients of S, dS/df and dS/dt, the highest
    power first.
    """

    b: float
    q: float
    f: float
    t: float
    cos: float
    sin: float
    cos2: float
    sin2: float
    x: float
    y: float
    gamma1: float
    gamma2: float
    front: float
    by_theta: float
    front_by_f: float
    q_by_f: float
    series: FloatArray


def ray_constants(lens: PowerLawLens) -> RayConstants:
    """The constants of a lens; a round one is taken for one that is next to round."""
    if lens.perturbers:
        raise SpecError("perturbers", lens.perturbers, "none in a lens that is fitted")
    q, t = min(lens.q, (1.0 - _ROUND) / (1.0 + _ROUND)), float(lens.slope - 1.0)
    f = (1.0 - q) / (1.0 + q)
    q_by_f = -2.0 / (1.0 + f) ** 2
    return RayConstants(
        b=lens.theta_E * math.sqrt(q),
        q=q,
        f=f,
        t=t,
        cos=math.cos(lens.phi),
        sin=math.sin(lens.phi),
        cos2=math.cos(2.0 * lens.phi),
        sin2=math.sin(2.0 * lens.phi),
        x=float(lens.x),
        y=float(lens.y),
        gamma1=float(lens.gamma1),
        gamma2=float(lens.gamma2),
        front=2.0 * lens.theta_E * math.sqrt(q) / (1.0 + q),
        by_theta=t / lens.theta_E,
        front_by_f=(0.5 * t / q - 1.0 / (1.0 + q)) * q_by_f,
        q_by_f=q_by_f,
        series=_series(f, t),
    )


def _series(f: float, t: float) -> FloatArray:
    """Coefficients (3, k) of S, dS/df and dS/dt, from the highest power of w down."""
    value, by_f, ln_by_t = [1.0], [0.0], 0.0
    by_t = [0.0]
    # Of the three dS/df falls most slowly, as k f^(k - 1).
    while len(value) < 2 or abs(by_f[-1]) > _TOLERANCE * (1.0 - f):
        k = len(value)
        ratio = -(2 * k - 2 + t) / (2 * k + 2 - t)
        by_f.append(k * ratio * value[-1])
        value.append(f * ratio * value[-1])
        ln_by_t += 1.0 / (2 * k - 2 + t) + 1.0 / (2 * k + 2 - t)
        by_t.append(value[-1] * ln_by_t)
    return np.ascontiguousarray(np.array([value, by_f, by_t])[:, ::-1])


@inlined_kernel
def ray_derivatives(x: float, y: float, c: RayConstants, by_x: FloatArray, by_y: FloatArray) -> tuple[float, float]:
    """Source position of an image position [arcsec]; ``by_x`` and ``by_y`` (LENS_DERIVATIVES,) get its derivatives.

    ``c`` is from :func:`ray_constants`. By gamma1 the derivatives are (-x, y), by gamma2 (-y, -x).
    """
    dx, dy = x - c.x, y - c.y
    along, across = c.cos * dx + c.sin * dy, c.cos * dy - c.sin * dx
    u, v = c.q * along, across
    inverse = 1.0 / max(math.sqrt(u * u + v * v), _LEAST_RADIUS)
    cos1, sin1 = u * inverse, v * inverse
    wr, wi = cos1 * cos1 - sin1 * sin1, 2.0 * cos1 * sin1
    # In real numbers: the three chains side by side, and no care for infinities as in complex products.
    sr, si, fr, fi, tr, ti = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(c.series.shape[1]):
        sr, si = sr * wr - si * wi + c.series[0, k], sr * wi + si * wr
        fr, fi = fr * wr - fi * wi + c.series[1, k], fr * wi + fi * wr
        tr, ti = tr * wr - ti * wi + c.series[2, k], tr * wi + ti * wr
    s, s_f, s_t = complex(sr, si), complex(fr, fi), complex(tr, ti)
    ln_ratio = math.log(c.b * inverse)
    front = complex(c.cos * cos1 - c.sin * sin1, c.cos * sin1 + c.sin * cos1) * (
        c.front * math.exp((c.t - 1.0) * ln_ratio)
    )
    alpha = front * s
    by_ln_r = (1.0 - c.t) * alpha
    by_angle = 1j * (alpha + 2.0 * c.f * front * s_f)
    by_u, by_v = inverse * (cos1 * by_ln_r - sin1 * by_angle), inverse * (sin1 * by_ln_r + cos1 * by_angle)
    by_along = c.q * by_u
    by_phi = 1j * alpha + across * by_along - along * by_v
    by_f = c.front_by_f * alpha + front * s_f + (c.q_by_f * along) * by_u
    turned = by_phi * (0.5 / c.f)
    terms = (
        c.by_theta * alpha,
        c.cos2 * by_f - c.sin2 * turned,
        c.sin2 * by_f + c.cos2 * turned,
        ln_ratio * alpha + front * s_t,
        c.sin * by_v - c.cos * by_along,
        -c.sin * by_along - c.cos * by_v,
    )
    for k in range(6):
        by_x[k], by_y[k] = -terms[k].real, -terms[k].imag
    shear_x, shear_y = c.gamma1 * x + c.gamma2 * y, c.gamma2 * x - c.gamma1 * y
    return x - alpha.real - shear_x, y - alpha.imag - shear_y
