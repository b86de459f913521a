"""An inversion written out: every matrix explicit, pixel by pixel, nothing shared with the engine's arithmetic."""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import lu_factor, lu_solve
from scipy.signal import convolve2d

from engine.imaging.optics.stamp_matrix import blurring_matrix
from engine.lensing.power_law import PowerLawLens
from engine.likelihood.amplitudes import LinearData, MarginalLikelihood, marginalise_amplitudes
from engine.source.lensing_matrix import RayBundle, cast_rays
from engine.source.regularisation import SourceModel
from tests.engine.plain_matrices import hats, nodes_round, regularisation, traced

LENS = PowerLawLens(0.8, 0.8, 0.4, 2.05, 0.02, -0.01, 0.03, 0.02)
SCALE = 0.1
SIDE = 25
ANCHORS = np.array([[0.7, 0.2], [-0.5, 0.6]])
_STAMP = np.arange(-4, 5)


def _gaussian(x: np.ndarray, y: np.ndarray, width: float) -> np.ndarray:
    return np.exp(-0.5 * (x**2 + y**2) / width**2)


def stamp(name: str) -> np.ndarray:
    x, y = np.meshgrid(_STAMP, _STAMP)
    psf = {
        "symmetric": _gaussian(x, y, 1.4),
        "asymmetric": _gaussian(x - 0.6, y + 0.3, 1.2) + 0.1 * _gaussian(x + 2, y - 1, 0.8),
        "negative wings": _gaussian(x, y, 1.2) - 0.01,
        "wide": _gaussian(x, y, 3.0),
        "one pixel": np.where((x == 0) & (y == 0), 1.0, 0.0),
    }[name]
    return psf / psf.sum()


Pixels = tuple[np.ndarray, np.ndarray]


def stamp_likelihood(
    linear: LinearData, kernel: np.ndarray, rays: RayBundle, to: Pixels, of: Pixels
) -> MarginalLikelihood:
    """The engine's likelihood with one PSF kernel between the pixels of the mask and those with rays."""
    return marginalise_amplitudes(linear, blurring_matrix(kernel, to, of), rays)


@dataclass(frozen=True)
class Explicit:
    """A scene of 25 x 25 pixels of 0.1 arcsec, by the names of its parts."""

    mask: str = "ring"
    psf: str = "asymmetric"
    subrays: int = 2
    columns: tuple[str, ...] = ("agn", "deflector", "background")
    correlated: bool = False
    lens: PowerLawLens = LENS
    seed: int = 0

    @property
    def axes(self) -> tuple[np.ndarray, np.ndarray]:
        axis = (np.arange(SIDE) - (SIDE - 1) / 2) * SCALE
        x, y = np.meshgrid(axis, axis)
        return x, y

    @cached_property
    def chosen(self) -> np.ndarray:
        x, y = self.axes
        r = np.hypot(x, y)
        ring = (r > 0.35) & (r < 1.1)
        return {
            "ring": ring,
            "partial": ring & (x > -0.3),
            "holes": ring & (np.random.default_rng(99).random(r.shape) > 0.15),
            "disc": r < 1.0,
        }[self.mask]

    @cached_property
    def rayed(self) -> np.ndarray:
        x, y = self.axes
        return self.chosen | (np.hypot(x, y) < 1.2)

    @cached_property
    def linear(self) -> LinearData:
        rng = np.random.default_rng(self.seed)
        x, y = self.axes
        psf = stamp(self.psf)
        images = {
            "agn": [convolve2d(np.hypot(x - a, y - b) < 0.06, psf, mode="same") for a, b in ((0.7, 0.2), (-0.5, 0.6))],
            "deflector": [convolve2d(np.exp(-3 * np.hypot(x, y)), psf, mode="same")],
            "background": [np.ones_like(x)],
        }
        columns = [image[self.chosen] for name in self.columns for image in images[name]]
        m = int(self.chosen.sum())
        u = np.stack(columns, axis=1) if columns else np.zeros((m, 0))
        sigma = rng.uniform(0.5, 1.5, m)
        covariance = sigma**2
        if self.correlated:
            rows, cols = np.nonzero(self.chosen)
            distance = np.hypot(np.subtract.outer(rows, rows), np.subtract.outer(cols, cols))
            covariance = np.outer(sigma, sigma) * np.exp(-0.5 * (distance / 0.8) ** 2)
        arc = convolve2d(20.0 * _gaussian(np.hypot(x, y) - 0.75, 0 * x, 0.2) * (1 + 0.5 * x), psf, mode="same")
        data = arc[self.chosen] + 30.0 * u.sum(axis=1) + sigma * rng.normal(size=m)
        return LinearData(data, covariance, np.ascontiguousarray(u))

    def likelihood(self) -> MarginalLikelihood:
        x, y = self.axes
        rays = cast_rays(self.chosen, self.rayed & ~self.chosen, x[0], y[:, 0], SCALE, self.subrays, ANCHORS)
        return stamp_likelihood(
            self.linear, stamp(self.psf), rays, np.nonzero(self.chosen), np.nonzero(self.rayed | self.chosen)
        )

    def _rays(self) -> tuple[np.ndarray, np.ndarray]:
        """Source positions (rows, columns, subrays^2) of all pixels' rays."""
        x, y = self.axes
        steps = ((np.arange(self.subrays) + 0.5) / self.subrays - 0.5) * SCALE
        dx, dy = (d.ravel() for d in np.meshgrid(steps, steps))
        return traced(self.lens, x[..., None] + dx, y[..., None] + dy)

    def nodes(self, model: SourceModel) -> tuple[np.ndarray, np.ndarray]:
        out = []
        for values, n in zip(self._rays(), model.shape[::-1], strict=True):
            out.append(nodes_round(values[self.chosen], n))
        return out[0], out[1]

    def source_columns(self, model: SourceModel) -> np.ndarray:
        """B L of shape (M, ny nx): each pixel's light of each node, then convolved image by image."""
        (x, y), (bx, by) = self.nodes(model), self._rays()
        ny, nx = model.shape
        light = np.zeros((SIDE, SIDE, ny, nx))
        for row, column in np.argwhere(self.rayed):
            for u, v in zip(bx[row, column], by[row, column], strict=True):
                a, b = hats(x, u), hats(y, v)
                light[row, column] += np.outer(b, a)
        light *= SCALE**2 / self.subrays**2
        psf, flat = stamp(self.psf), light.reshape(SIDE, SIDE, ny * nx)
        blurred = np.zeros_like(flat)
        reach = psf.shape[0] // 2
        for dy, dx in np.ndindex(psf.shape):
            # What pixel (r, c) receives of pixel (r - dy + reach, c - dx + reach).
            sy, sx = dy - reach, dx - reach
            to = (slice(max(sy, 0), SIDE + min(sy, 0)), slice(max(sx, 0), SIDE + min(sx, 0)))
            of = (slice(max(-sy, 0), SIDE + min(-sy, 0)), slice(max(-sx, 0), SIDE + min(-sx, 0)))
            blurred[to] += psf[dy, dx] * flat[of]
        return blurred[self.chosen]

    def solve(self, ln_lambda: float, model: SourceModel) -> "Answer":
        """ln Z, solution and LU factors of A, with the amplitudes as extra columns of G."""
        linear = self.linear
        g = np.hstack([self.source_columns(model), linear.columns])
        n, k, m = model.shape[0] * model.shape[1], linear.columns.shape[1], linear.data.size
        c = np.diag(linear.covariance) if linear.covariance.ndim == 1 else linear.covariance
        h = regularisation(model)
        inverse = np.linalg.inv(c)
        a = g.T @ inverse @ g
        a[:n, :n] += math.exp(ln_lambda) * h
        d = g.T @ (inverse @ linear.data)
        lu = lu_factor(a)
        solution = lu_solve(lu, d)
        rest = linear.data - g @ solution
        # The chi^2 and the penalty apart, not d^T C^-1 d - D^T A^-1 D, in which digits cancel.
        value = -0.5 * rest @ inverse @ rest
        value -= 0.5 * math.exp(ln_lambda) * solution[:n] @ h @ solution[:n]
        value += 0.5 * (np.linalg.slogdet(h)[1] - np.log(np.abs(np.diag(lu[0]))).sum() + n * ln_lambda)
        value -= 0.5 * np.linalg.slogdet(c)[1] + 0.5 * (m - k) * math.log(2 * math.pi)
        return Answer(float(value), solution[:n], solution[n:], lu)

    def changed(self, **values: object) -> "Explicit":
        return replace(self, **values)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Answer:
    ln_evidence: float
    source: np.ndarray
    amplitudes: np.ndarray
    lu: tuple[np.ndarray, np.ndarray]

    def covariance_columns(self, which: np.ndarray) -> np.ndarray:
        """Columns (n, len(which)) of the posterior covariance of the source."""
        unit = np.zeros((self.lu[0].shape[0], which.size))
        unit[which, np.arange(which.size)] = 1.0
        return lu_solve(self.lu, unit)[: self.source.size]
