"""A source without negative brightness: post-processing of a solved inversion, never part of the evidence.

The evidence and the posterior are those of a Gaussian prior, which knows no sign; a truncated one has no closed
evidence. What is found here is the non-negative source closest to the data and the prior, for pictures and for
estimators that take logarithms.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from engine.conventions import FloatArray
from engine.errors import InversionError
from engine.inversion.evidence import Inversion


@dataclass(frozen=True)
class NonNegativeSource:
    """The best source without negative values.

    ``source`` is (ny, nx), e-/s per arcsec^2; ``held`` marks the pixels that the bound keeps at zero;
    ``penalty_increase`` is by how much chi^2 + lambda s^T H s rises above its unbounded minimum: a large one says that
    the data themselves ask for negative light.
    """

    source: FloatArray
    held: NDArray[np.bool_]
    penalty_increase: float


def non_negative_source(inversion: Inversion) -> NonNegativeSource:
    """The source s >= 0 with the least s^T A s - 2 s^T D, for the same A and D, amplitudes marginalised.

    With A = U^T U and the unbounded solution s_0 this is the least |U (s - s_0)|^2: non-negative least squares (Lawson
    & Hanson 1974). The amplitudes of AGN, deflector and background stay free of sign and follow the source.

    Raises
    ------
    InversionError
        The active set did not settle.
    """
    root = np.triu(inversion.factor)
    try:
        source, rest = nnls(root, root @ inversion.source.ravel())
    except RuntimeError as error:
        raise InversionError(
            f"non-negative source of {inversion.source.size} pixels: {error}; a larger lambda is needed"
        ) from error
    source = np.asarray(source).reshape(inversion.grid.shape)
    return NonNegativeSource(source, source == 0.0, float(rest) ** 2)
