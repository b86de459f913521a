"""The formulas of the kernels in arithmetic of fifty digits (mpmath), sharing nothing with the engine but parameters.

Derivatives are differences over 1e-15: at fifty digits that leaves thirty.
"""

import math

import mpmath
import numpy as np

from engine.lensing.power_law import PowerLawLens
from engine.light.sersic import SersicProfile

DIGITS = 50
_STEP = mpmath.mpf(10) ** -15


def _power_law(lens: PowerLawLens, z: mpmath.mpc) -> mpmath.mpc:
    """Tessore & Metcalf (2015), eq. 13, with the hypergeometric function itself."""
    t, q = mpmath.mpf(lens.slope) - 1, mpmath.mpf(lens.q)
    turn = mpmath.expj(mpmath.mpf(lens.phi))
    inside = (z - mpmath.mpc(lens.x, lens.y)) / turn
    u, v = q * inside.real, inside.imag
    radius = mpmath.sqrt(u * u + v * v)
    phase = mpmath.mpc(u, v) / radius
    b, f = lens.theta_E * mpmath.sqrt(q), (1 - q) / (1 + q)
    series = mpmath.hyp2f1(1, t / 2, 2 - t / 2, -f * phase**2)
    return 2 * b / (1 + q) * (b / radius) ** (t - 1) * phase * series * turn


def deflection(lens: PowerLawLens, x: float, y: float) -> complex:
    """The deflection at a position, as alpha_x + i alpha_y."""
    with mpmath.workdps(DIGITS):
        z = mpmath.mpc(x, y)
        return complex(_power_law(lens, z) + mpmath.mpc(lens.gamma1, lens.gamma2) * mpmath.conj(z))


def jacobian(lens: PowerLawLens, x: float, y: float) -> tuple[float, float, float, float]:
    """Convergence, both components of the shear, and the determinant of the lens equation's Jacobian."""
    with mpmath.workdps(DIGITS):

        def slope(step: mpmath.mpc) -> mpmath.mpc:
            z = mpmath.mpc(x, y)
            ahead, behind = z + step, z - step
            difference = _power_law(lens, ahead) - _power_law(lens, behind)
            difference += mpmath.mpc(lens.gamma1, lens.gamma2) * mpmath.conj(ahead - behind)
            return difference / (2 * _STEP)

        across, up = slope(mpmath.mpc(_STEP, 0)), slope(mpmath.mpc(0, _STEP))
        kappa, gamma1, gamma2 = (across.real + up.imag) / 2, (across.real - up.imag) / 2, across.imag
        return float(kappa), float(gamma1), float(gamma2), float((1 - kappa) ** 2 - gamma1**2 - gamma2**2)


def brightness(profile: SersicProfile, x: float, y: float) -> float:
    """Surface brightness of a Sersic profile, its k the root of the incomplete gamma function."""
    with mpmath.workdps(DIGITS):
        n, q = mpmath.mpf(profile.n), mpmath.mpf(profile.q)
        k = mpmath.findroot(
            lambda value: mpmath.gammainc(2 * n, 0, value, regularized=True) - mpmath.mpf("0.5"), 2 * n - 1 / 3
        )
        turned = mpmath.mpc(mpmath.mpf(x) - profile.x, mpmath.mpf(y) - profile.y) / mpmath.expj(mpmath.mpf(profile.phi))
        radius = mpmath.sqrt(q * turned.real**2 + turned.imag**2 / q)
        central = (
            profile.flux * k ** (2 * n) / (2 * mpmath.pi * n * mpmath.mpf(profile.r_eff) ** 2 * mpmath.gamma(2 * n))
        )
        return float(central * mpmath.exp(-k * (radius / profile.r_eff) ** (1 / n)))


def evidence(
    design: np.ndarray,
    noise: np.ndarray,
    data: np.ndarray,
    regularisation: np.ndarray,
    ln_lambda: float,
    amplitudes: int,
) -> tuple[float, np.ndarray]:
    """Ln Z and the source of d = G s + noise: ``design`` (M, n + k), the k amplitudes behind; ``noise`` (M,)."""
    with mpmath.workdps(DIGITS):
        exact = np.vectorize(mpmath.mpf, otypes=[object])
        white, d = exact(design) / exact(noise)[:, None], exact(data) / exact(noise)
        m, n = len(data), design.shape[1] - amplitudes
        h = exact(regularisation)
        a = white.T @ white
        a[:n, :n] += mpmath.exp(ln_lambda) * h
        factor = _cholesky(a)
        solution = _solve(factor, white.T @ d)
        rest = d - white @ solution
        penalty = mpmath.exp(ln_lambda) * (solution[:n] @ h @ solution[:n])
        ln_z = -(rest @ rest + penalty) / 2 - _ln_determinant(factor) / 2 + _ln_determinant(_cholesky(h)) / 2
        ln_z += mpmath.mpf(n) * ln_lambda / 2 - sum(map(mpmath.log, exact(noise)))
        ln_z -= mpmath.mpf(m - amplitudes) / 2 * mpmath.log(2 * mpmath.pi)
        return float(ln_z), solution[:n].astype(float)


def _cholesky(a: np.ndarray) -> np.ndarray:
    factor = np.full(a.shape, mpmath.mpf(0), dtype=object)
    for j in range(len(a)):
        column = a[j:, j] - factor[j:, :j] @ factor[j, :j] if j else a[j:, j].copy()
        factor[j:, j] = column / mpmath.sqrt(column[0])
    return factor


def _solve(factor: np.ndarray, values: np.ndarray) -> np.ndarray:
    out = values.copy()
    size = len(out)
    for i in range(size):
        out[i] = (out[i] - (factor[i, :i] @ out[:i] if i else 0)) / factor[i, i]
    for i in reversed(range(size)):
        out[i] = (out[i] - (factor[i + 1 :, i] @ out[i + 1 :] if i + 1 < size else 0)) / factor[i, i]
    return out


def _ln_determinant(factor: np.ndarray) -> mpmath.mpf:
    return 2 * sum(map(mpmath.log, np.diag(factor)))


def ring(number: int, low: float, high: float) -> list[tuple[float, float]]:
    """Positions whose distances from the origin grow from ``low`` to ``high``, in all directions."""
    return [
        (r * math.cos(2.4 * k), r * math.sin(2.4 * k)) for k, r in enumerate(np.geomspace(low, high, number).tolist())
    ]
