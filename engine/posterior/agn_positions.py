"""Positions of the AGN images as data: they are images of one point of the source plane."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from engine.conventions import FloatArray
from engine.lensing.power_law import PowerLawLens, convergence_and_shear, source_position

_LN_2PI = math.log(2.0 * math.pi)


@dataclass(frozen=True)
class AgnPositions:
    """Measured positions (images, 2) [arcsec, image frame] with a standard deviation on each axis [arcsec].

    The deviation is to hold what the model lens cannot do, substructure above all, beside the error of measurement.
    """

    positions: FloatArray
    sd: float

    def ln_likelihood(self, lens: PowerLawLens) -> float:
        """Ln probability of the positions given a lens, the source position marginalised over a flat prior.

        Position i errs by A_i^-1 (beta_i - beta) to first order, A the Jacobian d beta / d theta there: a Gaussian in
        beta, whose integral is known (Oguri 2010, eq. 10, without the marginalisation).
        """
        x, y = self.positions.T
        kappa, gamma1, gamma2 = convergence_and_shear(lens, x, y)
        jacobian = np.array([[1.0 - kappa - gamma1, -gamma2], [-gamma2, 1.0 - kappa + gamma1]]).transpose(2, 0, 1)
        inverse = np.linalg.inv(jacobian) / self.sd
        weight = inverse.transpose(0, 2, 1) @ inverse
        beta = np.stack(source_position(lens, x, y), axis=1)
        total = weight.sum(axis=0)
        mean = np.linalg.solve(total, np.einsum("kij,kj->i", weight, beta))
        away = np.einsum("kij,kj->ki", inverse, beta - mean)
        _, ln_total = np.linalg.slogdet(total)
        spare = float(x.size - 1)
        misfit = float((away**2).sum() + ln_total)
        return -0.5 * misfit - 2.0 * float(x.size) * math.log(self.sd) - spare * _LN_2PI
