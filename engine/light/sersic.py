"""The Sersic profile with R = sqrt(q x^2 + y^2/q), x along the major axis (intermediate-axis half-light radius)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import gamma, gammainc, gammaincinv

from engine.conventions import FloatArray
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


def sersic_k(n: float) -> float:
    """k(n) for which r_eff encloses half of the flux: the median of the gamma distribution of shape 2n."""
    return float(gammaincinv(2.0 * n, 0.5))


def sersic_normalisation(n: float, r_eff: float) -> float:
    """Central factor I_0 [arcsec^-2] of a profile of unit flux: I = I_0 exp(-k (R/r_eff)^(1/n)).

    The total flux is 2 pi n r_eff^2 k^(-2n) Gamma(2n) I_0; the axis ratio drops out for intermediate-axis radii.
    """
    k = sersic_k(n)
    return float(k ** (2.0 * n) / (2.0 * math.pi * n * r_eff**2 * gamma(2.0 * n)))


def kernel_arguments(profile: SersicProfile) -> FloatArray:
    """Packed parameters for the compiled kernels: I_0, k, 1/(2n), 1/r_eff^2, q, cos, sin, x, y."""
    return np.array(
        [
            profile.flux * sersic_normalisation(profile.n, profile.r_eff),
            sersic_k(profile.n),
            0.5 / profile.n,
            1.0 / profile.r_eff**2,
            profile.q,
            math.cos(profile.phi),
            math.sin(profile.phi),
            profile.x,
            profile.y,
        ]
    )


def surface_brightness(profile: SersicProfile, x: FloatArray, y: FloatArray) -> FloatArray:
    """Surface brightness [e-/s arcsec^-2] at positions [arcsec]; arrays of any one shape."""
    i0, k, half_inverse_n, inverse_r2, q, c, s, x0, y0 = kernel_arguments(profile)
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
