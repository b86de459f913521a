"""A small scene with everything that an inversion needs, and the dense matrices that it should amount to."""

import math

import numpy as np

from engine.imaging.optics.stamp_matrix import blurring_matrix
from engine.lensing.power_law import PowerLawLens
from engine.likelihood.amplitudes import LinearData, MarginalLikelihood, marginalise_amplitudes
from engine.source.lensing_matrix import cast_rays
from engine.source.regularisation import SourceModel
from tests.engine.plain_matrices import lensing_matrix, nodes_round, regularisation, traced

LENS = PowerLawLens(0.8, 0.8, 0.4, 2.05, 0.02, -0.01, 0.03, 0.02)
SCALE = 0.1


class Case:
    """A small scene with everything that an inversion needs, and the dense matrices it should amount to."""

    def __init__(
        self,
        *,
        mask: str = "ring",
        psf: str = "asymmetric",
        subrays: int = 2,
        amplitudes: int = 3,
        correlated: bool = False,
        amplitude_sd: float | None = None,
        seed: int = 0,
    ) -> None:
        rng = np.random.default_rng(seed)
        n = 27
        axis = (np.arange(n) - (n - 1) / 2) * SCALE
        x, y = np.meshgrid(axis, axis)
        r = np.hypot(x, y)
        chosen = {
            "ring": (r > 0.35) & (r < 1.25),
            "partial": (r > 0.35) & (r < 1.25) & (x > -0.3),
            "holes": (r > 0.35) & (r < 1.25) & (rng.random(r.shape) > 0.1),
        }[mask]
        self.psf = {
            "gaussian": np.exp(-0.5 * (np.add.outer(np.arange(-4, 5) ** 2, np.arange(-4, 5) ** 2)) / 1.4**2),
            "asymmetric": np.exp(-0.5 * np.add.outer(np.arange(-4, 5) ** 2, (np.arange(-4, 5) - 0.6) ** 2) / 1.5),
            "negative wings": np.exp(-0.5 * np.add.outer(np.arange(-4, 5) ** 2, np.arange(-4, 5) ** 2) / 1.2**2) - 0.01,
        }[psf]
        self.psf = self.psf / self.psf.sum()
        margin = np.hypot(x, y) < 1.5
        self.rays = cast_rays(chosen, margin, axis, axis, SCALE, subrays, np.array([[0.7, 0.2], [-0.5, 0.6]]))
        self.mask, self.rayed = chosen, chosen | margin
        m = int(chosen.sum())
        sigma = rng.uniform(0.5, 1.5, m)
        if correlated:
            rows, columns = np.nonzero(chosen)
            distance = np.hypot(np.subtract.outer(rows, rows), np.subtract.outer(columns, columns))
            self.covariance = np.outer(sigma, sigma) * np.exp(-0.5 * (distance / 0.8) ** 2)
        else:
            self.covariance = sigma**2
        self.columns = rng.normal(size=(m, amplitudes)) + 0.3
        x, y = (v.reshape(-1, subrays**2)[self.rays.in_mask] for v in traced(LENS, self.rays.x, self.rays.y))
        sx, sy = np.meshgrid(nodes_round(x, 12), nodes_round(y, 12))
        source = 4000.0 * np.exp(-0.5 * ((sx - 0.05) ** 2 + (sy + 0.03) ** 2) / 0.15**2)
        self.blurring = blurring_matrix(self.psf, np.nonzero(self.mask), np.nonzero(self.rayed))
        light = lensing_matrix(self.rays, LENS, (12, 12)) @ source.ravel()
        self.data = self.blurring @ light + self.columns.sum(axis=1) + sigma * rng.normal(size=m)
        # The last amplitude alone has a Gaussian prior.
        self.precisions = np.zeros(amplitudes)
        if amplitude_sd is not None:
            self.precisions[-1] = amplitude_sd**-2
        self.linear = LinearData(self.data, self.covariance, self.columns, self.precisions)

    def likelihood(self) -> MarginalLikelihood:
        return marginalise_amplitudes(self.linear, self.blurring, self.rays)

    def lensing_matrix(self, lens: PowerLawLens, shape: tuple[int, int]) -> np.ndarray:
        """L (P, ny nx), made otherwise than the engine's."""
        return lensing_matrix(self.rays, lens, shape)

    def oracle(self, lens: PowerLawLens, ln_lambda: float, model: SourceModel) -> tuple[float, np.ndarray, np.ndarray]:
        """ln Z, source and its covariance from explicit G, C, H with the amplitudes as extra columns of G."""
        g = np.hstack([self.blurring @ self.lensing_matrix(lens, model.shape), self.columns])
        n, k, m = model.shape[0] * model.shape[1], self.columns.shape[1], self.data.size
        c = np.diag(self.covariance) if self.covariance.ndim == 1 else self.covariance
        inverse = np.linalg.inv(c)
        h = regularisation(model)
        a = g.T @ inverse @ g
        a[:n, :n] += math.exp(ln_lambda) * h
        a[n:, n:] += np.diag(self.precisions)
        d = g.T @ inverse @ self.data
        solution = np.linalg.solve(a, d)
        value = -0.5 * (self.data @ inverse @ self.data - d @ solution)
        value += -0.5 * np.linalg.slogdet(a)[1] + 0.5 * np.linalg.slogdet(h)[1] + 0.5 * n * ln_lambda
        value += -0.5 * np.linalg.slogdet(c)[1] - 0.5 * (m - k) * math.log(2 * math.pi)
        proper = self.precisions[self.precisions > 0]
        value += 0.5 * np.log(proper / (2 * math.pi)).sum()
        return float(value), solution, np.linalg.inv(a)
