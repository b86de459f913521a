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


def pixel_flux(profile: SersicProfile, x: float, y: float, side: float) -> float:
    """Flux of a profile with phi = 0 in a square pixel, its cusp inside or not.

    With R the elliptical radius and F(R) the flux within it, F(R) / (2 pi R^2) times the position has the brightness
    for its divergence: the flux is what of that field leaves through the pixel's sides, where nothing is singular.
    """
    with mpmath.workdps(DIGITS):
        n, root = mpmath.mpf(profile.n), mpmath.sqrt(mpmath.mpf(profile.q))
        k = mpmath.findroot(
            lambda value: mpmath.gammainc(2 * n, 0, value, regularized=True) - mpmath.mpf("0.5"), 2 * n - 1 / 3
        )

        def leaving(u: mpmath.mpf, v: mpmath.mpf) -> mpmath.mpf:
            squared = u * u + v * v
            within = mpmath.gammainc(2 * n, 0, k * (mpmath.sqrt(squared) / profile.r_eff) ** (1 / n), regularized=True)
            return profile.flux * within / (2 * mpmath.pi * squared)

        half = mpmath.mpf(side) / 2
        left, right = ((mpmath.mpf(x) - profile.x + sign * half) * root for sign in (-1, 1))
        low, high = ((mpmath.mpf(y) - profile.y + sign * half) / root for sign in (-1, 1))
        across = [left, mpmath.mpf(0), right] if left < 0 < right else [left, right]
        up = [low, mpmath.mpf(0), high] if low < 0 < high else [low, high]
        total = mpmath.mpf(0)
        for edge, sign in ((left, -1), (right, 1)):
            total += sign * edge * mpmath.quad(lambda v, edge=edge: leaving(edge, v), up)
        for edge, sign in ((low, -1), (high, 1)):
            total += sign * edge * mpmath.quad(lambda u, edge=edge: leaving(u, edge), across)
        return float(total)


def weighted_products(columns: np.ndarray, noise: np.ndarray, pairs: list[tuple[int, int]]) -> list[float]:
    """Elements of B^T C^-1 B for B (M, P) and the standard deviations (M,) of independent noise."""
    with mpmath.workdps(DIGITS):
        exact = np.vectorize(mpmath.mpf, otypes=[object])
        white = exact(columns) / exact(noise)[:, None]
        return [float(white[:, i] @ white[:, j]) for i, j in pairs]


def moved_in_fourier_space(psf: np.ndarray, size: int, guard: int, dx: float, dy: float) -> np.ndarray:
    """A stamp padded to ``size`` (odd) pixels a side, moved by (dx, dy) pixels and averaged over each pixel."""
    with mpmath.workdps(DIGITS):
        frequencies = [mpmath.mpf(f - size if f > size // 2 else f) / size for f in range(size)]

        def along(shift: float) -> np.ndarray:
            def wave(m: int, f: mpmath.mpf) -> mpmath.mpf:
                return mpmath.sincpi(f) * mpmath.cos(2 * mpmath.pi * f * (m - mpmath.mpf(shift)))

            kernel = [mpmath.fsum(wave(m, f) for f in frequencies) / size for m in range(size)]
            return np.array([[kernel[(out - at) % size] for at in range(size)] for out in range(size)], dtype=object)

        padded = np.full((size, size), mpmath.mpf(0), dtype=object)
        inside = slice(guard, guard + len(psf))
        padded[inside, inside] = np.vectorize(mpmath.mpf, otypes=[object])(psf)
        return np.asarray(along(dy) @ padded @ along(dx).T).astype(float)


def spline_between(values: np.ndarray, offset: float) -> np.ndarray:
    """A cubic spline through ``values`` (n,), nothing beyond, seen at whole numbers less ``offset``, from -1 to n + 1.

    The coefficients are those of scipy's filter with mirrored ends, on the values with one zero on each side.
    """
    with mpmath.workdps(DIGITS):
        padded = [mpmath.mpf(0), *map(mpmath.mpf, values.tolist()), mpmath.mpf(0)]
        n = len(padded)
        matrix = mpmath.zeros(n, n)
        for i in range(n):
            matrix[i, i] = mpmath.mpf(4) / 6
            for beside in (i - 1, i + 1):
                matrix[i, abs(beside) if beside < n else 2 * (n - 1) - beside] += mpmath.mpf(1) / 6
        coefficients = mpmath.lu_solve(matrix, mpmath.matrix(padded))

        def basis(t: mpmath.mpf) -> mpmath.mpf:
            t = abs(t)
            return (4 - 6 * t**2 + 3 * t**3) / 6 if t < 1 else (2 - t) ** 3 / 6 if t < 2 else mpmath.mpf(0)

        shift = mpmath.mpf(offset)
        seen = [mpmath.fsum(coefficients[k] * basis(m - k - shift) for k in range(n)) for m in range(n)]
        return np.array([float(value) for value in seen])
