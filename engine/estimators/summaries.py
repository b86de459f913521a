"""Means, standard deviations and biases of the estimators over their draws."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from engine.conventions import position_angle, rate_to_magnitude
from engine.estimators.aperture import RADIUS, aperture_flux
from engine.estimators.draws import SourceDraw
from engine.estimators.sersic_fit import Refit
from engine.light.sersic import SersicProfile, flux_in_circle
from engine.result import Aperture, Estimate, Quantity


def galfit_radius(profile: SersicProfile) -> float:
    """Half-light radius on the major axis [arcsec], GALFIT's convention, from ours on the intermediate axis."""
    return profile.r_eff / math.sqrt(profile.q)


def _quantity(values: Sequence[float], truth: float | None) -> Quantity:
    array = np.array(values)
    return Quantity(float(array.mean()), float(array.std(ddof=1)) if array.size > 1 else 0.0, truth)


def _angle_quantity(angles: Sequence[float], truth: float | None) -> Quantity:
    """Mean and deviation of angles with period 180 degrees; the mean is given near the truth."""
    doubled = np.exp(2j * np.radians(np.array(angles)))
    centre = 0.5 * math.degrees(np.angle(doubled.mean()))
    away = np.array([math.remainder(angle - centre, 180.0) for angle in angles])
    mean = centre + float(away.mean())
    reference = 90.0 if truth is None else truth
    mean = reference + math.remainder(mean - reference, 180.0)
    return Quantity(mean, float(away.std(ddof=1)) if away.size > 1 else 0.0, truth)


def summarise(refit: Refit, zero_point: float, truth: SersicProfile | None) -> Estimate | None:
    """Mean, deviation and bias over the fits that succeeded; None where none did."""
    fits = [fit for fit in refit.fits if fit is not None]
    if not fits:
        return None
    profiles = [fit.profile for fit in fits]

    def quantity(of: Callable[[SersicProfile], float]) -> Quantity:
        return _quantity([of(profile) for profile in profiles], None if truth is None else of(truth))

    return Estimate(
        estimator=refit.estimator,
        index_prior=refit.index_prior,
        magnitude=quantity(lambda p: rate_to_magnitude(p.flux, zero_point)),
        r_eff=quantity(lambda p: p.r_eff),
        r_eff_galfit=quantity(galfit_radius),
        n=quantity(lambda p: p.n),
        q=quantity(lambda p: p.q),
        position_angle=_angle_quantity(
            [position_angle(p.phi) for p in profiles], None if truth is None else position_angle(truth.phi)
        ),
        x=quantity(lambda p: p.x),
        y=quantity(lambda p: p.y),
        draws=len(refit.fits),
        at_bound=sum(fit.n_at_bound or fit.r_eff_at_bound for fit in fits),
        n_at_bound=sum(fit.n_at_bound for fit in fits),
        r_eff_at_bound=sum(fit.r_eff_at_bound for fit in fits),
        failed=len(refit.fits) - len(fits),
    )


def summarise_aperture(
    draws: Sequence[SourceDraw], centres: Refit, zero_point: float, truth: SersicProfile | None
) -> Aperture | None:
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
    true = None if truth is None else rate_to_magnitude(flux_in_circle(truth, RADIUS), zero_point)
    return Aperture(
        radius=RADIUS,
        magnitude=_quantity(magnitudes, true),
        coverage=float(np.mean(shares)),
        draws=len(draws),
        failed=len(draws) - len(magnitudes),
    )
