"""What a measurement is called: whether its host is there, its model fits, and its answer is the data's."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from engine.parametric.fit import ParametricFit
from engine.parametric.host_posterior import COORDINATES
from engine.parametric.poor_fit import POOR_FIT
from engine.reconstruction import brightest_limit, undetected
from engine.result import Estimate

MeasurementStatus = Literal["ok", "poor_fit", "not_detected", "prior_dominated"]
_ARC_SEEN = 25.0
"""Signal-to-noise of all of an arc from which on it is there, however little is known of its host's light: the noise
alone, fitted by any host, comes to five to twelve."""
_PRIOR_WIDTHS = {"ln_r_eff": 1.3, "n": 2.2}
"""Standard deviations of the host's parameters that its bounds alone would give, nearly."""


def status_of(fit: ParametricFit, host: Estimate, chi2_per_dof: float) -> MeasurementStatus:
    """``poor_fit`` before ``not_detected`` before ``prior_dominated`` before ``ok``."""
    if chi2_per_dof > POOR_FIT:
        return "poor_fit"
    if not_detected(fit, host):
        return "not_detected"
    if undetected(host):
        return "prior_dominated"
    return "prior_dominated" if prior_dominated(fit) else "ok"


def not_detected(fit: ParametricFit, host: Estimate) -> bool:
    """Whether the image shows no host: one whose flux is that of noise, and no arc either.

    The flux of a plain arc's host is unknown as well where its size is, as beside a deflector's wings.
    """
    counted = np.isfinite(fit.sigma)
    seen = math.sqrt(float(np.sum((fit.arc[counted] / fit.sigma[counted]) ** 2)))
    return bool(undetected(host)) and seen < _ARC_SEEN


def prior_dominated(fit: ParametricFit) -> tuple[str, ...]:
    """Names of parameters that a bound or a prior decides and not the data."""
    posterior = fit.hosts["wide"]
    deviations = np.sqrt(np.diag(posterior.covariance))
    wide = [f"host.{name}" for name, width in _PRIOR_WIDTHS.items() if deviations[COORDINATES.index(name)] > width]
    return (*fit.at_bound, *(name for name in wide if name not in fit.at_bound))


def magnitude_limit(fit: ParametricFit, host: Estimate) -> float | None:
    """The magnitude that a host which is not detected is fainter than (95 %); None for one that is."""
    return brightest_limit(host) if not_detected(fit, host) else None
