"""The parameters of the model of an image: one space for its fit, its bounds, its priors and its uncertainty."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from engine.conventions import FloatArray, axis_ratio_and_angle, ellipticity, ellipticity_jacobian
from engine.lensing.power_law import PowerLawLens
from engine.light.sersic import SHAPE, SersicProfile, profile_of
from engine.result import INDEX_RANGES
from engine.spec.priors import LensParameterName, ParameterPrior

LENS: tuple[LensParameterName, ...] = ("theta_E", "q", "phi", "slope", "x", "y")
SHEAR: tuple[LensParameterName, ...] = ("gamma1", "gamma2")
"""Lens parameters as physicists have them; a fit has e1 and e2 in the places of q and phi."""
HOST_FLUX, BACKGROUND = -2, -1
"""Places among the amplitudes."""

SLOPE_RANGE, SHEAR_RANGE = (1.3, 2.7), (-0.4, 0.4)
GALAXY_SLOPES, GALAXY_SHEARS = (1.5, 2.6), (-0.2, 0.2)
"""Behind a galaxy that is more than one profile; its (e1, e2) and centre are within these of those of its light."""
_LIGHT_REACH, _LIGHT_OFFSET = 0.25, 0.12
_ELLIPTICITY_RANGE = (-0.6, 0.6)
_EINSTEIN_RADII = (0.4, 1.8)
"""Bounds of theta_E in units of where a fit begins; the host lies within one theta_E of the lens."""
_CENTRE_REACH = 0.4
"""How far lens and deflector may move [arcsec]."""
_AGN_REACH = 2.0
"""How far an AGN image may move [pixels]."""
_DEFLECTOR_RADII, _DEFLECTOR_INDICES, _HOST_RADII = (0.03, 20.0), (0.5, 9.0), (0.02, 5.0)
_LEAST_ROOM = 1e-5
"""Between two bounds: least squares want some."""
_BOUND_MARGIN = 1e-3
"""Part of the way between two bounds that is at the bound."""


def lens_of(values: Sequence[float] | FloatArray) -> PowerLawLens:
    """The lens of the parameters theta_E, e1, e2, slope, x, y (and gamma1, gamma2)."""
    theta_E, e1, e2, slope, x, y, *shear = map(float, values)
    return PowerLawLens(theta_E, *axis_ratio_and_angle(e1, e2), slope, x, y, *shear)


def own_parameter(name: LensParameterName) -> bool:
    """Whether a fit has a parameter for it, and not two that it is made of, as q and phi are."""
    return name not in ("q", "phi")


@dataclass(frozen=True)
class KnownLight:
    """What is known of the light of a deflector whose shape is not fitted: centre [arcsec], (e1, e2), its Gaussians."""

    centre: tuple[float, float]
    ellipticity: tuple[float, float]
    gaussians: tuple[SersicProfile, ...]


@dataclass(frozen=True)
class ParameterSpace:
    """Which components the model has, and where their parameters stand in a vector.

    A vector is [AGN x, y ...][deflector: SHAPE][lens: theta_E, e1, e2, slope, x, y and gamma1, gamma2 with shear]
    [host: SHAPE]; the amplitudes, which are linear, are [AGN ...][deflector][host][background]. Where the deflector's
    light is Gaussians of known shape (``light``) it has no parameters, and as many amplitudes as there are Gaussians.
    A lens that does not shine is about the ``middle`` [arcsec].
    """

    n_agn: int
    deflector: bool
    shear: bool
    light: KnownLight | None = None
    middle: tuple[float, float] = (0.0, 0.0)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, as ``agn1.x``, ``lens.theta_E`` or ``host.ln_r_eff``."""
        names = [f"agn{k + 1}.{axis}" for k in range(self.n_agn) for axis in "xy"]
        names += [f"deflector.{name}" for name in SHAPE] if self.deflector else []
        names += [f"lens.{name}" for name in ("theta_E", "e1", "e2", *self.lens_names[3:])]
        return (*names, *(f"host.{name}" for name in SHAPE))

    @property
    def lens_names(self) -> tuple[LensParameterName, ...]:
        """Names of the lens parameters as physicists have them."""
        return LENS + SHEAR if self.shear else LENS

    @property
    def deflector_slice(self) -> slice:
        """Parameters of the deflector's light; empty where it has none."""
        return slice(2 * self.n_agn, 2 * self.n_agn + (len(SHAPE) if self.deflector else 0))

    @property
    def lens_slice(self) -> slice:
        """Parameters of the lens."""
        first = self.deflector_slice.stop
        return slice(first, first + len(self.lens_names))

    @property
    def host_slice(self) -> slice:
        """Parameters of the host."""
        return slice(self.lens_slice.stop, self.size)

    @property
    def size(self) -> int:
        """Number of nonlinear parameters."""
        return int(self.lens_slice.stop) + len(SHAPE)

    @property
    def amplitudes(self) -> int:
        """Number of linear ones."""
        return self.n_agn + int(self.deflector) + self.gaussians + 2

    @property
    def gaussians(self) -> int:
        """Number of Gaussians that the deflector's light is made of."""
        return 0 if self.light is None else len(self.light.gaussians)

    def agn(self, values: FloatArray) -> FloatArray:
        """Positions (n_agn, 2) [arcsec] of the AGN images."""
        return values[: 2 * self.n_agn].reshape(-1, 2)

    def lens(self, values: FloatArray) -> PowerLawLens:
        """The lens of a vector."""
        return lens_of(values[self.lens_slice])

    def host(self, values: FloatArray, flux: float = 1.0) -> SersicProfile:
        """The host of a vector."""
        return profile_of(values[self.host_slice], flux)

    def vector(
        self,
        agn: Sequence[tuple[float, float]],
        lens: PowerLawLens,
        host_radius: float,
        source: tuple[float, float],
    ) -> FloatArray:
        """Where a fit begins.

        The deflector's light is as large as the Einstein radius; the host, at ``source`` [arcsec], has ``host_radius``
        times that. Both are nearly round: at the circle itself an angle is nothing.
        """
        nearly_round = (0.0, 0.01)
        values: list[float] = [coordinate for place in agn for coordinate in place]
        if self.deflector:
            values += [math.log(lens.theta_E), 4.0, *nearly_round, lens.x, lens.y]
        values += [lens.theta_E, *ellipticity(lens.q, lens.phi), lens.slope, lens.x, lens.y]
        values += [lens.gamma1, lens.gamma2] if self.shear else []
        return np.array([*values, math.log(host_radius * lens.theta_E), 2.0, *nearly_round, *source])

    def with_shear(self, values: FloatArray, *, shear: bool) -> FloatArray:
        """The same vector with or without the shear, which is zero where there was none."""
        stop = self.lens_slice.stop
        if self.shear == shear:
            return values
        return np.insert(values, stop, [0.0, 0.0]) if shear else np.delete(values, [stop - 2, stop - 1])

    def bounds(
        self, start: FloatArray, pixel_scale: float, priors: Mapping[LensParameterName, ParameterPrior]
    ) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest values of a fit from ``start``, those of the priors included that have a parameter."""
        theta_E, _, _, _, x, y = start[self.lens_slice][:6].tolist()
        e, reach = _ELLIPTICITY_RANGE, _AGN_REACH * pixel_scale
        near = [(x - _CENTRE_REACH, x + _CENTRE_REACH), (y - _CENTRE_REACH, y + _CENTRE_REACH)]
        sides = [(value - reach, value + reach) for value in start[: 2 * self.n_agn].tolist()]
        sides += [_logs(_DEFLECTOR_RADII), _DEFLECTOR_INDICES, e, e, *near] if self.deflector else []
        shapes, slopes, shears = [e, e], SLOPE_RANGE, SHEAR_RANGE
        if self.light is not None:
            shapes = [(value - _LIGHT_REACH, value + _LIGHT_REACH) for value in self.light.ellipticity]
            near = [(value - _LIGHT_OFFSET, value + _LIGHT_OFFSET) for value in self.light.centre]
            slopes, shears = GALAXY_SLOPES, GALAXY_SHEARS
        sides += [(_EINSTEIN_RADII[0] * theta_E, _EINSTEIN_RADII[1] * theta_E), *shapes, slopes, *near]
        sides += [shears, shears] if self.shear else []
        sides += [_logs(_HOST_RADII), INDEX_RANGES["wide"], e, e]
        sides += [(x - theta_E, x + theta_E), (y - theta_E, y + theta_E)]
        low, high = np.array(sides).T
        for name, prior in priors.items():
            if own_parameter(name) and name in self.lens_names:
                k = self.lens_slice.start + self.lens_names.index(name)
                low[k] = low[k] if prior.low is None else min(max(low[k], prior.low), high[k] - _LEAST_ROOM)
                high[k] = high[k] if prior.high is None else max(min(high[k], prior.high), low[k] + _LEAST_ROOM)
        return low, high

    def at_bound(self, values: FloatArray, low: FloatArray, high: FloatArray) -> tuple[str, ...]:
        """Names of the parameters that are at one of these bounds, or beyond."""
        margin = _BOUND_MARGIN * (high - low)
        outside = ~((low + margin < values) & (values < high - margin))
        return tuple(self.names[k] for k in np.flatnonzero(outside))

    def lens_covariance(self, covariance: FloatArray, values: FloatArray) -> FloatArray:
        """Covariance (k, k) of the parameters :attr:`lens_names`, of that of a vector: by the chain rule."""
        where = self.lens_slice
        chain = np.eye(where.stop - where.start)
        chain[1:3, 1:3] = ellipticity_jacobian(*values[where][1:3].tolist())
        return np.asarray(chain @ covariance[where, where] @ chain.T)

    def host_block(self, covariance: FloatArray, flux: float) -> FloatArray:
        """Covariance (7, 7) of ln flux and the host's parameters, of one of vector and amplitudes together."""
        chosen = [self.size + self.amplitudes + HOST_FLUX, *range(self.host_slice.start, self.host_slice.stop)]
        scale = np.array([1.0 / flux, *np.ones(len(SHAPE))])
        return np.asarray(covariance[np.ix_(chosen, chosen)] * np.outer(scale, scale))


def _logs(bounds: tuple[float, float]) -> tuple[float, float]:
    return math.log(bounds[0]), math.log(bounds[1])
