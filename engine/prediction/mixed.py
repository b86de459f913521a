"""Ridge regression on runs that come in groups, one for each lens, whose members share an effect.

y_i = w . phi_i + u_g h_i + v_i with w_j ~ N(0, a_j^2), u_g ~ N(0, tau^2), v_i ~ N(0, d_i^2): a Gaussian process whose
kernel is a polynomial of the features and a constant within a lens (Rasmussen & Williams 2006, sections 2.1 and 2.7),
solved in the space of the coefficients, of which there are some forty.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from engine.conventions import FloatArray

IntArray = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class GroupedRidge:
    """The posterior of the coefficients: ``precision`` (p, p) and ``weighted`` (p,), of all and of each group alone.

    ``ln_evidence`` is that of the data under the prior.
    """

    precision: FloatArray
    weighted: FloatArray
    of_group: FloatArray
    weighted_of_group: FloatArray
    ln_evidence: float

    @cached_property
    def posterior(self) -> tuple[FloatArray, FloatArray]:
        """Mean (p,) and covariance (p, p) of the coefficients by all groups."""
        return self.coefficients()

    def coefficients(self, without: int | None = None) -> tuple[FloatArray, FloatArray]:
        """Mean (p,) and covariance (p, p) of the coefficients, by all groups or by all but one."""
        precision, weighted = self.precision, self.weighted
        if without is not None:
            precision, weighted = precision - self.of_group[without], weighted - self.weighted_of_group[without]
        covariance = cho_solve(cho_factor(precision), np.eye(len(weighted)))
        return covariance @ weighted, covariance


def fit_grouped(
    phi: FloatArray,
    y: FloatArray,
    amplitude: FloatArray,
    group: IntArray,
    effect: FloatArray,
    noise: FloatArray,
) -> GroupedRidge:
    """Regress y (runs,) on phi (runs, p), whose coefficients have prior deviations ``amplitude`` (p,).

    ``group`` (runs,) counts lenses from 0 on; ``effect`` (runs,) is tau h_i and ``noise`` (runs,) the d_i.
    """
    n_groups = int(group.max()) + 1
    inverse = 1.0 / noise**2
    shared = effect * inverse
    # Sherman and Morrison, group by group: V^-1 = D^-1 - D^-1 e e' D^-1 / (1 + e' D^-1 e).
    held = 1.0 + np.bincount(group, weights=effect * shared, minlength=n_groups)
    through = _summed(phi * shared[:, None], group, n_groups)
    y_through = np.bincount(group, weights=y * shared, minlength=n_groups)
    of_group = -through[:, :, None] * through[:, None, :] / held[:, None, None]
    weighted_of_group = -through * (y_through / held)[:, None] + _summed(phi * (y * inverse)[:, None], group, n_groups)
    for place in range(n_groups):
        mine = phi[group == place]
        of_group[place] += mine.T @ (mine * inverse[group == place][:, None])
    precision = of_group.sum(axis=0) + np.diag(1.0 / amplitude**2)
    weighted = weighted_of_group.sum(axis=0)
    factor = cho_factor(precision)
    fitted = float(weighted @ cho_solve(factor, weighted))
    squares = float(np.sum(y**2 * inverse) - np.sum(y_through**2 / held))
    ln_determinant = float(
        2.0 * np.sum(np.log(noise))
        + np.sum(np.log(held))
        + 2.0 * np.sum(np.log(np.diag(factor[0])))
        + 2.0 * np.sum(np.log(amplitude))
    )
    ln_evidence = -0.5 * (squares - fitted + ln_determinant + len(y) * math.log(2.0 * math.pi))
    return GroupedRidge(precision, weighted, of_group, weighted_of_group, ln_evidence)


def _summed(rows: FloatArray, group: IntArray, n_groups: int) -> FloatArray:
    """Sums of rows (runs, p) by group, (groups, p)."""
    out = np.zeros((n_groups, rows.shape[1]))
    np.add.at(out, group, rows)
    return out
