"""The evidence along each parameter: how it falls off from its maximum, and how rough it is on the way."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from engine.conventions import FloatArray

DEFAULT_OFFSETS = np.linspace(-3.0, 3.0, 25)
"""In standard deviations: a rise or a jump of ln Z a quarter of one wide is still seen."""


@dataclass(frozen=True)
class EvidenceTrace:
    """Ln Z along one parameter.

    ``offsets`` (n,) are steps of the parameter from ``centre`` in units of its ``sd``; ``ln_evidence`` (n,) is ln Z
    there less that at the centre, minus infinity outside the prior and where the inversion is refused. ``truth`` is the
    true value as an offset, None where none is shown.
    """

    name: str
    centre: float
    sd: float
    offsets: FloatArray
    ln_evidence: FloatArray
    truth: float | None = None


def trace_evidence(
    target: Callable[[FloatArray], float],
    names: Sequence[str],
    mean: FloatArray,
    covariance: FloatArray,
    *,
    offsets: FloatArray = DEFAULT_OFFSETS,
) -> tuple[EvidenceTrace, ...]:
    """Trace ln Z through ``mean`` along each of d parameters.

    As one parameter moves, the others follow with their conditional means under the Gaussian N(mean, covariance): the
    path runs along the ridge, t sd_k from the mean at offset t, and where the Gaussian is right ln Z falls as -t^2 / 2.

    Parameters
    ----------
    target : callable
        Ln Z of a vector (d,).
    names : sequence of str
        Of the parameters.
    mean, covariance : arrays (d,), (d, d)
        The Gaussian approximation of the posterior.
    offsets : array (n,)
        In standard deviations.
    """
    centre = target(mean)
    traces = []
    for k, name in enumerate(names):
        sd = math.sqrt(float(covariance[k, k]))
        along = covariance[:, k] / sd
        values = np.array([target(mean + t * along) for t in offsets])
        traces.append(EvidenceTrace(name, float(mean[k]), sd, np.asarray(offsets), values - centre))
    return tuple(traces)
