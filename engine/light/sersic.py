"""The Sersic profile with R = sqrt(q x^2 + y^2/q), x along the major axis (intermediate-axis half-light radius)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import gamma, gammainc, gammaincinv

from engine.conventions import FloatArray, axis_ratio_and_angle, ellipticity
from engine.errors import SpecError


@dataclass(frozen=True)
class SersicProfile:
    """A Sersic profile in the image or source frame.

    Attributes
    ----------
    flux : float
        Total count rate [e-/s].
    r_eff : float
        Half-light radius on the intermediate axis [arcsec].
    n, q, phi : float
        Index, axis ratio, angle of the major axis [rad, counter-clockwise from +x].
    x, y : float
        Centre [arcsec].
    """

    flux: float
    r_eff: float
    n: float
    q: float
    phi: float
    x: float = 0.0
    y: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what the profile does not cover."""
        if not self.r_eff > 0:
            raise SpecError("r_eff", self.r_eff, "a positive radius")
        if not 0.2 <= self.n <= 20:
            raise SpecError("n", self.n, "a Sersic index between 0.2 and 20")
        if not 0 < self.q <= 1:
            raise SpecError("q", self.q, "an axis ratio in (0, 1]")


SHAPE = ("ln_r_eff", "n", "e1", "e2", "x", "y")
"""What a profile has besides its flux, as parameters of a fit: r_eff, x and y in arcsec, ellipticity components."""


def shape_of(profile: SersicProfile) -> FloatArray:
    """The parameters (6,) :data:`SHAPE` of a profile."""
    return np.array(
        [math.log(profile.r_eff), profile.n, *ellipticity(profile.q, profile.phi), profile.x, profile.y]
    )  # fmt: skip


def profile_of(shape: Sequence[float] | FloatArray, flux: float = 1.0) -> SersicProfile:
    """The profile of parameters :data:`SHAPE` and a flux [e-/s]."""
    ln_r, n, e1, e2, x, y = map(float, shape)
    return SersicProfile(flux, math.exp(ln_r), n, *axis_ratio_and_angle(e1, e2), x, y)


def sersic_k(n: float) -> float:
    """k(n) for which r_eff encloses half of the flux: the median of the gamma distribution of shape 2n."""
    return float(gammaincinv(2.0 * n, 0.5))


def sersic_normalisation(n: float, r_eff: float) -> float:
    """Central factor I_0 [arcsec^-2] of a profile of unit flux: I = I_0 exp(-k (R/r_eff)^(1/n)).

    The total flux is 2 pi n r_eff^2 k^(-2n) Gamma(2n) I_0; the axis ratio drops out for intermediate-axis radii.
    """
    k = sersic_k(n)
    return float(k ** (2.0 * n) / (2.0 * math.pi * n * r_eff**2 * gamma(2.0 * n)))


class SersicConstants(NamedTuple):
    """A profile as the compiled kernels take it: I = central exp(-k (R^2 inverse_r2)^half_inverse_n).

    ``central`` [e-/s arcsec^-2], ``half_inverse_n`` is 1 / 2n, ``inverse_r2`` is r_eff^-2 [arcsec^-2], (``cos``,
    ``sin``) those of phi, ``x`` and ``y`` the centre [arcsec].
    """

    central: float
    k: float
    half_inverse_n: float
    inverse_r2: float
    q: float
    cos: float
    sin: float
    x: float
    y: float


def sersic_constants(profile: SersicProfile) -> SersicConstants:
    """The constants of a profile."""
    # A whole number would be another type to the kernels.
    return SersicConstants(
        central=float(profile.flux * sersic_normalisation(profile.n, profile.r_eff)),
        k=sersic_k(profile.n),
        half_inverse_n=0.5 / profile.n,
        inverse_r2=1.0 / profile.r_eff**2,
        q=float(profile.q),
        cos=math.cos(profile.phi),
        sin=math.sin(profile.phi),
        x=float(profile.x),
        y=float(profile.y),
    )


def surface_brightness(profile: SersicProfile, x: FloatArray, y: FloatArray) -> FloatArray:
    """Surface brightness [e-/s arcsec^-2] at positions [arcsec]; arrays of any one shape."""
    i0, k, half_inverse_n, inverse_r2, q, c, s, x0, y0 = sersic_constants(profile)
    u = c * (x - x0) + s * (y - y0)
    v = c * (y - y0) - s * (x - x0)
    return np.asarray(i0 * np.exp(-k * ((q * u * u + v * v / q) * inverse_r2) ** half_inverse_n))


def mean_surface_brightness(magnitude: float, r_eff: float) -> float:
    """Mean surface brightness inside r_eff [mag arcsec^-2]: half of the light over pi r_eff^2."""
    return magnitude + 2.5 * math.log10(2.0 * math.pi * r_eff**2)


def flux_in_circle(profile: SersicProfile, radius: float) -> float:
    """Flux [e-/s] within a circle of ``radius`` [arcsec] round the centre of the profile.

    In the direction t the profile radius grows by g(t) = sqrt(q cos^2 t + sin^2 t / q) with distance, so that direction
    holds P(2n, k (g radius / r_eff)^(1/n)) / g^2 of the flux per 2 pi; the mean over a period converges exponentially.
    """
    t = 2.0 * math.pi * np.arange(512) / 512
    g2 = profile.q * np.cos(t) ** 2 + np.sin(t) ** 2 / profile.q
    inner = sersic_k(profile.n) * (g2 * (radius / profile.r_eff) ** 2) ** (0.5 / profile.n)
    return profile.flux * float((gammainc(2.0 * profile.n, inner) / g2).mean())


def effective_brightness(profile: SersicProfile) -> float:
    """Surface brightness at the half-light radius, for unit flux [arcsec^-2]."""
    return sersic_normalisation(profile.n, profile.r_eff) * float(np.exp(-sersic_k(profile.n)))
