"""The numerical error of the host of a parametric fit, by linear response.

Where the fit ended its light is made once more, by finer means. What the model image lacks, dm, moves the parameters
by (J^T J)^-1 J^T dm, J being the fit's own whitened derivatives. What the residuals themselves say in the same way is
how far the search stopped from its minimum; it counts as rendering, whose error is as small.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from engine.conventions import FloatArray
from engine.parametric.parameters import HOST_FLUX
from engine.parametric.solution import Solution
from engine.result import IndexPrior

FINE_TOLERANCE = 1e-5
"""Of the host's light: finer than the fit's by a hundred, and what 1e-6 gives to a thirtieth of the difference."""


@dataclass(frozen=True)
class HostShift:
    """Shifts of ln flux, ln r_eff and n (3,) that finer ``rendering`` and a finer ``psf`` would bring."""

    rendering: FloatArray
    psf: FloatArray


def host_shifts(
    solution: Solution, jacobian: FloatArray, amplitudes: FloatArray, held: Mapping[IndexPrior, bool]
) -> dict[IndexPrior, HostShift]:
    """The shifts of the host with each prior of n, ``held`` where that holds n.

    Parameters
    ----------
    solution : Solution
    jacobian : array (rows, parameters + amplitudes)
        Of data and constraints at the solution, whitened.
    amplitudes : array (amplitudes,)
        The best ones there.
    """
    model, space, values = solution.model, solution.space, solution.values
    optics, column = model.observation.optics, model.columns(values)
    host = optics.sersic_image(space.host(values), solution.lens, FINE_TOLERANCE)[model.window].ravel() * model.weight
    flux = float(amplitudes[HOST_FLUX])
    rendering = flux * (host - column[:, HOST_FLUX]) - model.host_defect
    psf = np.zeros_like(rendering)
    if space.n_agn:
        stars = optics.point_sources(space.agn(values), amplitudes[: space.n_agn])[model.window].ravel() * model.weight
        psf = stars - column[:, : space.n_agn] @ amplitudes[: space.n_agn]
    # What a finer model has more of is taken away from the residuals.
    lacking = (model.decorrelated(dm) for dm in (rendering, psf))
    steps = [jacobian.T @ model.residuals(values), *(-jacobian[: host.size].T @ dm for dm in lacking)]
    right = np.stack(steps)
    bound = [space.names.index(name) for name in space.at_bound(values, solution.low, solution.high)]
    at_n = space.host_slice.start + 1
    return {
        prior: HostShift(*_response(jacobian, right, [*bound, at_n] if fixed else bound, space.host_slice, flux))
        for prior, fixed in held.items()
    }


def _response(
    jacobian: FloatArray, right: FloatArray, held: Sequence[int], host: slice, flux: float
) -> tuple[FloatArray, FloatArray]:
    """What shifts ln flux, ln r_eff and n, of the rows of ``right`` (3, parameters + amplitudes)."""
    free = np.delete(np.arange(jacobian.shape[1]), list(held))
    chosen = jacobian[:, free]
    scale = np.sqrt((chosen**2).sum(axis=0))
    scale[scale == 0.0] = 1.0
    scaled = chosen / scale
    inverse = np.linalg.pinv(scaled.T @ scaled, rcond=1e-12, hermitian=True)
    shifts = np.zeros((len(right), jacobian.shape[1]))
    shifts[:, free] = (right[:, free] / scale) @ inverse / scale
    found = np.column_stack([shifts[:, HOST_FLUX] / flux, shifts[:, host.start], shifts[:, host.start + 1]])
    return found[0] + found[1], found[2]
