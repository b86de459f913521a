"""The conventions of hostlens; every other module imports them from here.

*Sky frame*: x to the East, y to the North, arcsec; position angles in degrees East of North. Catalogues and
specifications use it.

*Image frame*: x along increasing pixel columns, y along increasing pixel rows, arcsec, origin at the centre of the
image; angles in radians counter-clockwise from +x. Our own images are North up, East left, so ``x_image = -x_East``;
:class:`Orientation` says how anybody's stands on the sky. All numeric modules use the image frame;
:mod:`engine.simulation.scene` converts into it, and :mod:`engine.on_sky` converts the answers back.

Einstein radii and half-light radii are on the intermediate axis, ``R = sqrt(q x^2 + y^2 / q)`` with x along the major
axis; magnitudes are AB; surface brightness is in e-/s per pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

MOST_ELLIPTICAL = 0.9
"""Largest e = (1 - q)/(1 + q), q = 0.05, that ellipticity components stand for."""


def image_angle(position_angle_deg: float) -> float:
    """Angle in the image frame [rad] of a position angle [deg East of North].

    East of North means towards -x in an image with East to the left: phi = PA + 90 deg.
    """
    return math.remainder(math.radians(position_angle_deg + 90.0), math.pi)


def position_angle(phi: float) -> float:
    """Position angle [deg East of North, in 0..180] of an image-frame angle [rad]."""
    return (math.degrees(phi) - 90.0) % 180.0


@dataclass(frozen=True)
class Orientation:
    """How an image stands on the sky.

    Attributes
    ----------
    north
        Image-frame angle of North [rad]; pi/2 where North is up.
    mirrored
        Whether East lies clockwise of North in the image, to the right where North is up.
    """

    north: float = math.pi / 2.0
    mirrored: bool = False

    def position_angle(self, phi: float) -> float:
        """Position angle [deg East of North, in 0..180] of an axis at an image-frame angle [rad]."""
        return math.degrees(self._from_north(phi)) % 180.0

    def on_sky(self, x: float, y: float) -> tuple[float, float]:
        """(East, North) [arcsec] of an image-frame position [arcsec]."""
        angle, r = self._from_north(math.atan2(y, x)), math.hypot(x, y)
        return r * math.sin(angle), r * math.cos(angle)

    def _from_north(self, phi: float) -> float:
        return self.north - phi if self.mirrored else phi - self.north


NORTH_UP = Orientation()


def sky_to_image(position: tuple[float, float]) -> tuple[float, float]:
    """Image-frame position of a sky-frame one [arcsec]; its own inverse."""
    return -position[0], position[1]


def sky_to_image_shear(shear: tuple[float, float]) -> tuple[float, float]:
    """Image-frame shear (gamma1, gamma2) of a sky-frame one; mirroring x flips the sign of gamma2."""
    return shear[0], -shear[1]


def ellipticity(q: float, phi: float) -> tuple[float, float]:
    """Components (e1, e2) = e (cos 2 phi, sin 2 phi), e = (1 - q)/(1 + q), of an axis ratio and an angle [rad].

    They are smooth through the circle, where axis ratio and angle are not.
    """
    e = (1.0 - q) / (1.0 + q)
    return e * math.cos(2.0 * phi), e * math.sin(2.0 * phi)


def axis_ratio_and_angle(e1: float, e2: float) -> tuple[float, float]:
    """Axis ratio and angle [rad] of ellipticity components; e is cut at :data:`MOST_ELLIPTICAL`."""
    e = min(math.hypot(e1, e2), MOST_ELLIPTICAL)
    return (1.0 - e) / (1.0 + e), 0.5 * math.atan2(e2, e1)


def ellipticity_jacobian(e1: float, e2: float) -> FloatArray:
    """Derivatives (2, 2) of :func:`axis_ratio_and_angle` by the components; at the circle those close to it."""
    e = max(math.hypot(e1, e2), 1e-4)
    slope = -2.0 / (1.0 + e) ** 2
    return np.array([[slope * e1 / e, slope * e2 / e], [-0.5 * e2 / e**2, 0.5 * e1 / e**2]])


def magnitude_to_rate(magnitude: float, zero_point: float) -> float:
    """Count rate [e-/s] of an AB magnitude."""
    return float(10.0 ** (0.4 * (zero_point - magnitude)))


def rate_to_magnitude(rate: float, zero_point: float) -> float:
    """AB magnitude of a count rate [e-/s], which must be positive."""
    if not rate > 0:
        raise ValueError(f"rate: got {rate!r}, allowed is a positive count rate")
    return zero_point - 2.5 * math.log10(rate)


def pixel_centres(n: int, scale: float) -> FloatArray:
    """Coordinates [arcsec] of the centres of n pixels along one axis, with the origin at the middle of the axis."""
    return (np.arange(n, dtype=np.float64) - (n - 1) / 2.0) * scale
