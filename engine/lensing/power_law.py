"""Deflection and Jacobian of the elliptical power law with external shear.

The convergence is ``kappa = (2 - t)/2 (theta_E / sqrt(q x^2 + y^2/q))^t`` with t = gamma' - 1 and x along the major
axis. With b = theta_E sqrt(q), R e^{i phi} = q x + i y and f = (1 - q)/(1 + q), the complex deflection is (Tessore &
Metcalf 2015, eq. 13)

    alpha = 2 b / (1 + q) (b / R)^(t - 1) e^{i phi} 2F1(1, t/2; 2 - t/2; -f e^{2 i phi}).

The hypergeometric series is a polynomial in w = e^{2 i phi} with real coefficients a_0 = 1,
a_k = -f (2k - 2 + t)/(2k + 2 - t) a_{k-1}. Its terms fall at least as fast as f^k (t < 2), so the tail after term K is
below |a_K| f / (1 - f), and the count is chosen to bring that bound below rounding. It is summed by Horner's rule.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from engine.compiled import inlined_kernel, kernel
from engine.conventions import FloatArray
from engine.errors import SpecError
from engine.lensing.perturbers import Perturber, perturb_jacobian, perturb_point, perturber_rows

SERIES_TOLERANCE = 1e-16
_BLOCK = 64


@dataclass(frozen=True)
class PowerLawLens:
    """Elliptical power law with shear in the image frame.

    Attributes
    ----------
    theta_E : float
        Einstein radius on the intermediate axis [arcsec].
    q, phi : float
        Axis ratio, and angle of the major axis [rad, counter-clockwise from +x].
    slope : float
        gamma' of the three-dimensional density, 1 < gamma' < 3.
    x, y : float
        Centre [arcsec].
    gamma1, gamma2 : float
        External shear about the origin of the frame.
    perturbers : tuple
        Multipoles of the power law, and satellites (:mod:`engine.lensing.perturbers`).
    """

    theta_E: float
    q: float
    phi: float
    slope: float
    x: float = 0.0
    y: float = 0.0
    gamma1: float = 0.0
    gamma2: float = 0.0
    perturbers: tuple[Perturber, ...] = field(default=(), kw_only=True)

    def __post_init__(self) -> None:
        """Refuse what the formulas do not cover."""
        if not self.theta_E > 0:
            raise SpecError("theta_E", self.theta_E, "a positive Einstein radius")
        if not 0 < self.q <= 1:
            raise SpecError("q", self.q, "an axis ratio in (0, 1]")
        if not 1 < self.slope < 3:
            raise SpecError("slope", self.slope, "1 < gamma' < 3")
        values = (self.phi, self.x, self.y, self.gamma1, self.gamma2)
        if not all(map(math.isfinite, values)):
            raise SpecError("lens", values, "finite angle, centre and shear")

    @property
    def sheared(self) -> bool:
        """Whether there is an external shear."""
        return self.gamma1 != 0.0 or self.gamma2 != 0.0

    def with_values(self, **values: float) -> PowerLawLens:
        """A copy with some parameters replaced."""
        return replace(self, **values)  # type: ignore[arg-type]  # none of them is the perturbers


def series_coefficients(q: float, t: float, tolerance: float = SERIES_TOLERANCE) -> FloatArray:
    """Coefficients a_0 .. a_K of the deflection series, K the first for which the tail is below ``tolerance``."""
    f = (1.0 - q) / (1.0 + q)
    coefficients = [1.0]
    while abs(coefficients[-1]) * f > tolerance * (1.0 - f):
        k = len(coefficients)
        coefficients.append(-f * (2 * k - 2 + t) / (2 * k + 2 - t) * coefficients[-1])
    return np.array(coefficients)


class LensConstants(NamedTuple):
    """A lens as the compiled kernels take it.

    ``b`` is theta_E sqrt(q) [arcsec], (``cos``, ``sin``) those of phi, ``t`` is slope - 1, ``x`` and ``y`` the centre
    [arcsec], ``gamma1`` and ``gamma2`` the shear, ``series`` (k,) the coefficients of the deflection,
    ``perturbers`` (p, 8) the rows of :func:`engine.lensing.perturbers.perturber_rows`.
    """

    b: float
    q: float
    cos: float
    sin: float
    t: float
    x: float
    y: float
    gamma1: float
    gamma2: float
    series: FloatArray
    perturbers: FloatArray


def lens_constants(lens: PowerLawLens) -> LensConstants:
    """The constants of a lens."""
    t = float(lens.slope - 1.0)
    # A whole number would be another type to the kernels.
    return LensConstants(
        b=lens.theta_E * math.sqrt(lens.q),
        q=float(lens.q),
        cos=math.cos(lens.phi),
        sin=math.sin(lens.phi),
        t=t,
        x=float(lens.x),
        y=float(lens.y),
        gamma1=float(lens.gamma1),
        gamma2=float(lens.gamma2),
        series=series_coefficients(lens.q, t),
        perturbers=perturber_rows(lens.perturbers, lens.theta_E, t, lens.x, lens.y),
    )


@inlined_kernel
def deflect_point(x: float, y: float, lens: LensConstants) -> tuple[float, float]:
    """Deflection (alpha_x, alpha_y) [arcsec] at one point; ``lens`` from :func:`lens_constants`.

    At the centre of the lens the symmetric value, zero, is returned.
    """
    b, q, c, s, t = lens.b, lens.q, lens.cos, lens.sin, lens.t
    dx, dy = x - lens.x, y - lens.y
    u = q * (c * dx + s * dy)
    v = c * dy - s * dx
    r2 = u * u + v * v
    shear_x = lens.gamma1 * x + lens.gamma2 * y
    shear_y = lens.gamma2 * x - lens.gamma1 * y
    if lens.perturbers.shape[0]:
        more_x, more_y = perturb_point(x, y, lens.perturbers)
        shear_x += more_x
        shear_y += more_y
    if r2 == 0.0:
        return shear_x, shear_y
    r = math.sqrt(r2)
    cos1, sin1 = u / r, v / r
    wr, wi = cos1 * cos1 - sin1 * sin1, 2.0 * cos1 * sin1
    sr, si = lens.series[lens.series.size - 1], 0.0
    for k in range(lens.series.size - 2, -1, -1):
        sr, si = lens.series[k] + sr * wr - si * wi, sr * wi + si * wr
    scale = 2.0 * b / (1.0 + q)
    if t != 1.0:
        scale *= (b / r) ** (t - 1.0)
    ar = scale * (cos1 * sr - sin1 * si)
    ai = scale * (cos1 * si + sin1 * sr)
    return c * ar - s * ai + shear_x, s * ar + c * ai + shear_y


@inlined_kernel
def _map_rays(x: FloatArray, y: FloatArray, lens: LensConstants, bx: FloatArray, by: FloatArray, traced: bool) -> None:
    """Source positions (``traced``) or deflections of image positions, written into ``bx`` and ``by``.

    Works in blocks whose loops over points are innermost, so that the compiler can vectorise the series.
    """
    b, q, c, s, t = lens.b, lens.q, lens.cos, lens.sin, lens.t
    scale0 = 2.0 * b / (1.0 + q)
    cos1 = np.empty(_BLOCK)
    sin1 = np.empty(_BLOCK)
    radius = np.empty(_BLOCK)
    wr = np.empty(_BLOCK)
    wi = np.empty(_BLOCK)
    sr = np.empty(_BLOCK)
    si = np.empty(_BLOCK)
    for start in range(0, x.size, _BLOCK):
        m = min(_BLOCK, x.size - start)
        for i in range(m):
            dx, dy = x[start + i] - lens.x, y[start + i] - lens.y
            u = q * (c * dx + s * dy)
            v = c * dy - s * dx
            r = math.sqrt(u * u + v * v)
            radius[i] = r
            inverse = 1.0 / r if r > 0.0 else 0.0
            u *= inverse
            v *= inverse
            cos1[i] = u
            sin1[i] = v
            wr[i] = u * u - v * v
            wi[i] = 2.0 * u * v
            sr[i] = lens.series[lens.series.size - 1]
            si[i] = 0.0
        for k in range(lens.series.size - 2, -1, -1):
            ak = lens.series[k]
            for i in range(m):
                re = ak + sr[i] * wr[i] - si[i] * wi[i]
                si[i] = sr[i] * wi[i] + si[i] * wr[i]
                sr[i] = re
        if t != 1.0:
            for i in range(m):
                radius[i] = scale0 * (b / radius[i]) ** (t - 1.0) if radius[i] > 0.0 else 0.0
        else:
            for i in range(m):
                radius[i] = scale0
        for i in range(m):
            ar = radius[i] * (cos1[i] * sr[i] - sin1[i] * si[i])
            ai = radius[i] * (cos1[i] * si[i] + sin1[i] * sr[i])
            xi, yi = x[start + i], y[start + i]
            alpha_x = c * ar - s * ai + lens.gamma1 * xi + lens.gamma2 * yi
            alpha_y = s * ar + c * ai + lens.gamma2 * xi - lens.gamma1 * yi
            bx[start + i] = xi - alpha_x if traced else alpha_x
            by[start + i] = yi - alpha_y if traced else alpha_y
    if lens.perturbers.shape[0]:
        for i in range(x.size):
            more_x, more_y = perturb_point(x[i], y[i], lens.perturbers)
            bx[i] += -more_x if traced else more_x
            by[i] += -more_y if traced else more_y


@kernel
def trace_rays(x: FloatArray, y: FloatArray, lens: LensConstants, bx: FloatArray, by: FloatArray) -> None:
    """Source positions of image positions, written into ``bx`` and ``by``; all (k,), in arcsec."""
    _map_rays(x, y, lens, bx, by, True)


@kernel
def _deflect_rays(x: FloatArray, y: FloatArray, lens: LensConstants, ax: FloatArray, ay: FloatArray) -> None:
    """Deflections [arcsec] at image positions (k,) [arcsec], written into ``ax`` and ``ay`` (k,)."""
    # Not x - (x - alpha): far from the lens that would lose the digits of alpha.
    _map_rays(x, y, lens, ax, ay, False)


@inlined_kernel
def jacobian_point(x: float, y: float, lens: LensConstants) -> tuple[float, float, float]:
    """Convergence and shear (kappa, g1, g2) at one point; at the centre of the lens kappa is infinite.

    The deflection is homogeneous of degree 1 - t, so z kappa + z* gamma = (1 - t) alpha (Euler), which gives the
    shear from kappa and alpha without differences.
    """
    b, q, c, s, t = lens.b, lens.q, lens.cos, lens.sin, lens.t
    dx, dy = x - lens.x, y - lens.y
    more, more1, more2 = 0.0, lens.gamma1, lens.gamma2
    if dx == 0.0 and dy == 0.0:
        return np.inf, more1, more2
    ax, ay = deflect_point(x, y, lens)
    ax -= lens.gamma1 * x + lens.gamma2 * y
    ay -= lens.gamma2 * x - lens.gamma1 * y
    if lens.perturbers.shape[0]:
        more_x, more_y = perturb_point(x, y, lens.perturbers)
        ax -= more_x
        ay -= more_y
        more, extra1, extra2 = perturb_jacobian(x, y, lens.perturbers)
        more1 += extra1
        more2 += extra2
    u = q * (c * dx + s * dy)
    v = c * dy - s * dx
    kappa = 0.5 * (2.0 - t) * (b / math.sqrt(u * u + v * v)) ** t
    r2 = dx * dx + dy * dy
    # gamma = [(1 - t) alpha - z kappa] / z*  =  [(1 - t) alpha - z kappa] z / |z|^2
    re = (1.0 - t) * ax - dx * kappa
    im = (1.0 - t) * ay - dy * kappa
    return kappa + more, (re * dx - im * dy) / r2 + more1, (re * dy + im * dx) / r2 + more2


@kernel
def _convergence_and_shear(x: FloatArray, y: FloatArray, lens: LensConstants, out: FloatArray) -> None:
    """Convergence and shear components at image positions (k,) [arcsec], written into ``out`` (3, k)."""
    for i in range(x.size):
        out[0, i], out[1, i], out[2, i] = jacobian_point(x[i], y[i], lens)


def _flat(x: FloatArray, y: FloatArray) -> tuple[tuple[int, ...], FloatArray, FloatArray]:
    """The common shape of two arrays, and both as contiguous vectors."""
    x, y = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
    return x.shape, np.ascontiguousarray(x).ravel(), np.ascontiguousarray(y).ravel()


def deflection(lens: PowerLawLens, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Deflection angles [arcsec] at image positions [arcsec]; arrays of any one shape."""
    shape, x, y = _flat(x, y)
    ax, ay = np.empty(x.size), np.empty(x.size)
    _deflect_rays(x, y, lens_constants(lens), ax, ay)
    return ax.reshape(shape), ay.reshape(shape)


def source_position(lens: PowerLawLens, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Source-plane positions [arcsec] of image positions [arcsec]; arrays of any one shape."""
    shape, x, y = _flat(x, y)
    bx, by = np.empty(x.size), np.empty(x.size)
    trace_rays(x, y, lens_constants(lens), bx, by)
    return bx.reshape(shape), by.reshape(shape)


def convergence_and_shear(
    lens: PowerLawLens, x: FloatArray, y: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Convergence and total shear components at image positions; at the centre of the lens the first is infinite."""
    shape, x, y = _flat(x, y)
    out = np.empty((3, x.size))
    _convergence_and_shear(x, y, lens_constants(lens), out)
    return out[0].reshape(shape), out[1].reshape(shape), out[2].reshape(shape)


def magnification(lens: PowerLawLens, x: FloatArray, y: FloatArray) -> FloatArray:
    """Signed magnification 1 / [(1 - kappa)^2 - gamma^2]: infinite on a critical curve, zero at the lens' centre."""
    kappa, gamma1, gamma2 = convergence_and_shear(lens, x, y)
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / ((1.0 - kappa) ** 2 - gamma1**2 - gamma2**2))
