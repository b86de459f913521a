"""The fit of an image with what its model may be wrong by: the stamp of the PSF, and the host's shape.

What the residuals of a fit say of both corrects the stamp and is marginalised in the next fit, a few times over. Where
the exposures are known they are asked only if the residuals where AGN images and arcs shine are not those of noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.conventions import FloatArray
from engine.parametric.parameters import HOST_FLUX
from engine.parametric.psf_error import laid_modes, stamp_modes
from engine.parametric.shared_error import ModelError, SharedError, likeliest_errors
from engine.parametric.solution import Solution
from engine.parametric.source_error import lensed_modes

MOVED = (0.5, 1.0, 2.0, 4.0)
"""Errors of moved stamps beside that of the stamp, in units of what they are allowed, that are tried."""
_GAIN = 10.0
"""ln of the evidence for errors of the model from which on they are believed."""


@dataclass(frozen=True, eq=False)
class Learned:
    """What a fit teaches: the errors, their columns for the next fit, and the error of moved stamps beside them."""

    error: ModelError
    shared: SharedError
    left: float


def learned(
    solution: Solution,
    given: FloatArray,
    known: ModelError | None,
    base: FloatArray,
    stamps: FloatArray,
    fitted: NDArray[np.bool_],
    left: Sequence[float] = MOVED,
) -> Learned | None:
    """What a fit of the whole image says of the errors of its model; None where it shows none.

    Parameters
    ----------
    solution : Solution
        With the stamp ``given`` (n, n), corrected by what was ``known`` before.
    base, stamps : arrays (ny, nx)
        Deviation of the pixels without the light of AGN images, infinite where a pixel is not valid; variance that
        moved stamps of these are allowed.
    fitted : array (ny, nx)
        Pixels that count.
    left : sequence of numbers
        Errors of moved stamps beside that of the stamp, in units of what they are allowed, that are tried.
    """
    model, space = solution.model, solution.space
    amplitudes, _, _ = model.amplitudes(solution.values)
    host = np.zeros((model.data.size, 0))
    # One that is as large as the ring is the deflector's wings or the sky: its departures would be theirs.
    if space.host(solution.values).r_eff < solution.lens.theta_E:
        host = _flat(lensed_modes(model, solution.values, float(amplitudes[HOST_FLUX])))
    modes = stamp_modes(given) if space.n_agn else np.zeros((0, *given.shape))
    psf = _flat(laid_modes(modes, _places(solution), model.shape))
    residual = model.unwhitened(model.missed(solution.values)[:, None], np.ones(1))[model.window].ravel()
    if known is not None and space.n_agn:
        # Of the stamp that was given: what the correction made of it is part of the error.
        residual = residual + laid_modes(known.correction[None], _places(solution), model.shape).ravel()
    counted = fitted.ravel() & np.isfinite(base.ravel()) & (model.weight > 0)
    noise, moved = base.ravel()[counted] ** 2, stamps.ravel()[counted]
    sigmas = [(error, np.sqrt(noise + error**2 * moved)) for error in (left if space.n_agn else (1.0,))]
    found = likeliest_errors([host[counted], psf[counted]], residual[counted], sigmas)
    if found.gain < _GAIN:
        return None
    of_host, of_psf = found.strengths
    correction = of_psf * found.amplitudes[host.shape[1] :]
    mean = np.concatenate([np.zeros(host.shape[1]), found.amplitudes[host.shape[1] :]])
    return Learned(
        error=ModelError(
            of_psf,
            of_host,
            found.gain,
            np.tensordot(correction, modes, axes=1),
            flux_without=float(amplitudes[HOST_FLUX]) if known is None else known.flux_without,
        ),
        shared=SharedError(np.concatenate([of_host * host, of_psf * psf], axis=1), mean, host.shape[1]),
        left=found.left,
    )


def _flat(images: FloatArray) -> FloatArray:
    """Columns (pixels, m) of images (m, ny, nx)."""
    return images.reshape(len(images), images.shape[1] * images.shape[2]).T


def _places(solution: Solution) -> list[tuple[float, float, float]]:
    """Column and row in the model's window, and flux [e-/s], of the AGN images."""
    model, scale = solution.model, solution.model.observation.pixel_scale
    ny, nx = model.observation.shape
    rows, columns = model.window
    return [
        (found.x / scale + (nx - 1) / 2.0 - columns.start, found.y / scale + (ny - 1) / 2.0 - rows.start, found.flux)
        for found in solution.agn()
    ]
