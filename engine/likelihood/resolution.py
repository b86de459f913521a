"""How finely the data resolve the source: the resolution matrix R = A^-1 F of an inversion.

With amplitudes marginalised, the source of highest posterior is R times the true one, plus noise (Backus & Gilbert
1968; Menke 1989, chapter 4). Column j of R is what becomes of a point of light at node j.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from engine.conventions import FloatArray
from engine.likelihood.evidence import Inversion

_FWHM = 2.0 * math.sqrt(2.0 * math.log(2.0))


@dataclass(frozen=True)
class SourceResolution:
    """What the data, and not the prior, decide of each source pixel, and how far its light is spread.

    Attributes
    ----------
    data_share : array (ny, nx)
        The diagonal of R: 1 where the data alone decide the pixel, 0 where the prior does. Its sum is the number of
        parameters that the data determine. It does not depend on the units of the pixels.
    width : array (ny, nx)
        FWHM [arcsec] of the Gaussian whose square has the second moment about node j of the squared column j, each
        pixel a uniform cell: squared, so that the faint ripples far away do not count. About one cell where R is the
        identity; infinite for a pixel that no light comes from.
    """

    data_share: FloatArray
    width: FloatArray


def resolution_matrix(inversion: Inversion) -> FloatArray:
    """R = A^-1 F (ny nx, ny nx), for sources in terms of their brightness at the nodes."""
    solution, _ = lapack.dpotrs(inversion.factor, inversion.curvature, lower=0)
    return np.asarray(solution)


def source_resolution(inversion: Inversion) -> SourceResolution:
    """The resolution of each source pixel."""
    grid, r = inversion.grid, resolution_matrix(inversion)
    x, y = (axis.ravel() for axis in np.meshgrid(grid.x, grid.y))
    areas = grid.cell_areas.ravel()
    own = np.add.outer(np.diff(grid.y_edges) ** 2, np.diff(grid.x_edges) ** 2).ravel() / 12.0
    distance = np.subtract.outer(x, x) ** 2 + np.subtract.outer(y, y) ** 2 + own[:, None]
    weight = areas[:, None] * r**2
    total = weight.sum(axis=0)
    moment = np.full(total.size, math.inf)
    # In two dimensions the square of a Gaussian of deviation sigma has the second moment sigma^2.
    np.divide((weight * distance).sum(axis=0), total, out=moment, where=total > 0.0)
    return SourceResolution(
        data_share=np.diag(r).reshape(grid.shape).copy(),
        width=_FWHM * np.sqrt(moment).reshape(grid.shape),
    )
