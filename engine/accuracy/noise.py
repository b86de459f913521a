"""How far the correlations of the drizzled noise are followed, against a general sparse solve of all of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from engine.accuracy.curves import Curve, Knob
from engine.accuracy.subject import Subject
from engine.accuracy.timing import Measuring, least_cpu
from engine.conventions import FloatArray
from engine.likelihood.noise import factorise_noise
from engine.likelihood.w_tilde import compute_w_tilde

STAGE = "noise"
BAND = Knob(
    stage=STAGE,
    name="noise covariance band",
    place="Analysis.noise_treatment",
    quantity="relative error of the stated error of the arc's flux, all else known",
    unit="relative",
    work="noise factorised and W~ made, once a run",
    reference="the whole covariance, by a general sparse LU instead of the banded Cholesky factor",
)
_REACHES = (0, 1, 2)


@dataclass(frozen=True)
class _Data:
    """Covariance (M, M) of the fitted pixels, their rows and columns in the image, and the arc's light (M,) in them."""

    covariance: sparse.csr_matrix
    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    arc: FloatArray

    def within(self, reach: int) -> sparse.csr_matrix | FloatArray:
        """The covariance without correlations of pixels further apart than ``reach`` along a side."""
        if reach == 0:
            return np.asarray(self.covariance.diagonal())
        entries = self.covariance.tocoo()
        near = np.maximum(
            np.abs(self.rows[entries.row] - self.rows[entries.col]),
            np.abs(self.columns[entries.row] - self.columns[entries.col]),
        )
        kept = near <= reach
        indices = (entries.row[kept], entries.col[kept])
        return sparse.csr_matrix((entries.data[kept], indices), shape=self.covariance.shape)


def measure(subject: Subject) -> list[Curve]:
    """How far the band reaches."""
    problem, observation = subject.problem(noise_treatment="covariance"), subject.simulation.observation
    if observation.covariance is None:
        raise ValueError("observation: got none with a covariance, allowed is a simulated one")
    chosen = np.flatnonzero(problem.mask)
    rows, columns = np.nonzero(problem.mask)
    covariance = observation.covariance.tocsr()[chosen][:, chosen]
    data = _Data(covariance, rows, columns, subject.simulation.arc[problem.mask])
    solved = splu(sparse.csc_matrix(covariance)).solve(data.arc)
    truth = float(data.arc @ solved) ** -0.5
    entries = covariance.tocoo()
    furthest = int(np.abs(rows[entries.row] - rows[entries.col]).max())
    likelihood = problem.likelihood
    found = Measuring(BAND, floor=1e-9)
    for reach in (*(r for r in _REACHES if r < furthest), furthest):

        def one(reach: int = reach) -> tuple[float, float]:
            kept = data.within(reach)
            white = factorise_noise(kept).whiten(data.arc)
            # The error that this weighting states: of the noise as it takes it to be.
            stated = float(white @ white) ** -0.5
            cost = least_cpu(lambda: compute_w_tilde(likelihood.blurring, factorise_noise(kept), likelihood.rays))
            return cost, abs(stated / truth - 1.0)

        setting = {0: "diagonal", furthest: "all correlations"}.get(reach, f"{reach} pixels")
        found.add(setting, one, default=reach == furthest)
    return [found.curve()]
