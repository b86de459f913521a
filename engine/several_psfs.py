"""One image by several PSFs: each is fitted, and the answer is that of all of them, weighted by how well they do.

Bayesian model averaging with the weights of the BIC (Schwarz 1978), tempered by chi^2 per degree of freedom where that
is above one: differences of a chi^2 mean nothing that noise of the same misfit would make.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from engine.conventions import FloatArray
from engine.imaging.observation import Observation
from engine.parametric.fit import ParametricFit


@dataclass(frozen=True)
class PsfFit:
    """What the fit with one PSF comes to.

    ``place`` is that of the PSF among those given, ``weight`` its part of the answer; the host is without the others'.
    """

    place: int
    weight: float
    chi2_per_dof: float
    flux: float
    flux_error: float


def averaged(
    observation: Observation, fits: Sequence[tuple[int, ParametricFit]]
) -> tuple[int, ParametricFit, tuple[PsfFit, ...]]:
    """The place of the best PSF, its fit with the uncertainties of all, and what each came to.

    Host posteriors are those of the mixture (mean and covariance); the lens stays the best PSF's, its covariance is
    the second moment of the mixture about it.
    """
    scores = np.array([_score(observation, fit) for _, fit in fits])
    misfit = min(fit.misfit for _, fit in fits)
    weights = np.exp((scores - scores.max()) / misfit)
    weights /= weights.sum()
    told = tuple(
        PsfFit(
            place,
            float(weight),
            fit.chi2 / fit.degrees_of_freedom,
            math.exp(float(fit.hosts["wide"].mean[0])),
            math.exp(float(fit.hosts["wide"].mean[0])) * math.sqrt(float(fit.hosts["wide"].covariance[0, 0])),
        )
        for weight, (place, fit) in zip(weights, fits, strict=True)
    )
    place, best = fits[int(np.argmax(weights))]
    hosts = dict(best.hosts)
    for prior, posterior in best.hosts.items():
        parts = [
            (weight, fit.hosts[prior]) for weight, (_, fit) in zip(weights, fits, strict=True) if prior in fit.hosts
        ]
        share = np.array([weight for weight, _ in parts]) / sum(weight for weight, _ in parts)
        means = np.array([host.mean for _, host in parts])
        mean = share @ means
        covariance = sum(
            (part * (host.covariance + np.outer(away, away)))
            for part, (_, host), away in zip(share, parts, means - mean, strict=True)
        )
        hosts[prior] = replace(posterior, mean=mean, covariance=np.asarray(covariance))
    return place, replace(best, hosts=hosts, lens_covariance=_about(best, fits, weights)), told


def _score(observation: Observation, fit: ParametricFit) -> float:
    """-BIC/2: ln likelihood, the error of the PSF in its noise, less the price of the parameters."""
    counted = np.isfinite(fit.sigma)
    residual = (observation.image - fit.model)[counted] / fit.sigma[counted]
    parameters = residual.size - fit.degrees_of_freedom
    ln_likelihood = -0.5 * float(residual @ residual) - float(np.log(fit.sigma[counted]).sum())
    return ln_likelihood - 0.5 * parameters * math.log(residual.size)


def _about(best: ParametricFit, fits: Sequence[tuple[int, ParametricFit]], weights: FloatArray) -> FloatArray:
    """Second moment (k, k) of the lens about that of the best, of the fits that have its parameters."""
    alike = [(w, fit) for w, (_, fit) in zip(weights, fits, strict=True) if fit.lens_names == best.lens_names]
    total = sum(weight for weight, _ in alike)
    out = np.zeros_like(best.lens_covariance)
    for weight, fit in alike:
        away = np.array(
            [
                math.remainder(getattr(fit.lens, name) - getattr(best.lens, name), math.pi)
                if name == "phi"
                else getattr(fit.lens, name) - getattr(best.lens, name)
                for name in best.lens_names
            ]
        )
        out += weight / total * (fit.lens_covariance + np.outer(away, away))
    return out
