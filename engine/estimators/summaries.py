"""Means and standard deviations of the estimators over their draws."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from engine.conventions import FloatArray, position_angle, rate_to_magnitude
from engine.estimators.aperture import RADIUS, aperture_flux
from engine.estimators.draws import SourceDraw
from engine.estimators.sersic_fit import Refit
from engine.light.galaxy import Light
from engine.result import Aperture, Estimate, Quantity


def galfit_radius(profile: Light) -> float:
    """Half-light radius on the major axis [arcsec], GALFIT's convention, from ours on the intermediate axis."""
    return profile.r_eff / math.sqrt(profile.q)


def _quantity(values: Sequence[float], *, log_normal: bool = False) -> Quantity:
    array = np.array(values)
    return Quantity(float(array.mean()), float(array.std(ddof=1)) if array.size > 1 else 0.0, log_normal=log_normal)


def mean_angle(angles: FloatArray, weights: FloatArray, *, ddof: int = 0) -> Quantity:
    """Mean, in 0..180, and deviation of angles (k,) [deg] with period 180 degrees and weights (k,) of sum one."""
    doubled = np.exp(2j * np.radians(angles))
    centre = 0.5 * math.degrees(np.angle(weights @ doubled))
    away = np.remainder(angles - centre + 90.0, 180.0) - 90.0
    mean = float(weights @ away)
    variance = float(weights @ (away - mean) ** 2) * (angles.size / (angles.size - ddof) if angles.size > ddof else 0.0)
    return Quantity((centre + mean) % 180.0, math.sqrt(variance))


def summarise(refit: Refit, zero_point: float) -> Estimate | None:
    """Mean and deviation over the fits that succeeded; None where none did."""
    fits = [fit for fit in refit.fits if fit is not None]
    if not fits:
        return None
    profiles = [fit.profile for fit in fits]
    angles = np.array([position_angle(profile.phi) for profile in profiles])
    return Estimate(
        estimator=refit.estimator,
        index_prior=refit.index_prior,
        magnitude=_quantity([rate_to_magnitude(profile.flux, zero_point) for profile in profiles]),
        r_eff=_quantity([profile.r_eff for profile in profiles], log_normal=True),
        r_eff_galfit=_quantity([galfit_radius(profile) for profile in profiles], log_normal=True),
        n=_quantity([profile.n for profile in profiles]),
        q=_quantity([profile.q for profile in profiles]),
        position_angle=mean_angle(angles, np.full(angles.size, 1.0 / angles.size), ddof=1),
        x=_quantity([profile.x for profile in profiles]),
        y=_quantity([profile.y for profile in profiles]),
        draws=len(refit.fits),
        at_bound=sum(fit.n_at_bound or fit.r_eff_at_bound for fit in fits),
        n_at_bound=sum(fit.n_at_bound for fit in fits),
        r_eff_at_bound=sum(fit.r_eff_at_bound for fit in fits),
        failed=len(refit.fits) - len(fits),
    )


@dataclass(frozen=True)
class Summary:
    """What the fits to drawn sources answer, and a warning for each answer that is not there."""

    estimates: tuple[Estimate, ...]
    aperture: Aperture | None
    warnings: tuple[str, ...]


def summarise_all(draws: Sequence[SourceDraw], refits: Sequence[Refit], zero_point: float) -> Summary:
    """The answers of all estimators, and the light of the maps where ``paper`` says where its middle is."""
    answers = [summarise(refit, zero_point) for refit in refits]
    warnings = [
        f"{refit.estimator} estimator, n {refit.index_prior}: not one of {len(refit.fits)} draws could be fitted"
        for refit, answer in zip(refits, answers, strict=True)
        if answer is None
    ]
    aperture = None
    for refit in refits:
        if (refit.estimator, refit.index_prior) == ("paper", "wide"):
            aperture = summarise_aperture(draws, refit, zero_point)
            if aperture is None:
                warnings.append("aperture: no drawn source has light within it")
    return Summary(tuple(answer for answer in answers if answer is not None), aperture, tuple(warnings))


def summarise_aperture(draws: Sequence[SourceDraw], centres: Refit, zero_point: float) -> Aperture | None:
    """Magnitude of the drawn maps within the aperture round the fits' centres; None where no draw has one."""
    magnitudes, shares = [], []
    for draw, fit in zip(draws, centres.fits, strict=True):
        if fit is None:
            continue
        flux, share = aperture_flux(draw.grid, draw.drawn, fit.profile.x, fit.profile.y, RADIUS)
        if flux > 0:
            magnitudes.append(rate_to_magnitude(flux, zero_point))
            shares.append(share)
    if not magnitudes:
        return None
    return Aperture(
        radius=RADIUS,
        magnitude=_quantity(magnitudes),
        coverage=float(np.mean(shares)),
        draws=len(draws),
        failed=len(draws) - len(magnitudes),
    )
