"""From the host of a specification to light in the source plane."""

from __future__ import annotations

import math
from functools import lru_cache

from engine.conventions import image_angle, magnitude_to_rate
from engine.errors import SpecError
from engine.light.galaxy import Galaxy, Light, galaxy_of
from engine.light.pixels import PixelLight
from engine.light.sersic import SersicProfile
from engine.simulation.made import made_components
from engine.spec.host import Host, HostImage, HostShape
from engine.spec.sky import LensSystem


def host_light(host: Host, system: LensSystem, zero_point: float, x: float, y: float) -> Light:
    """A host with its centre or nucleus at (x, y) [arcsec]: a Sersic profile, or a galaxy."""
    angle = system.host_position_angle if host.position_angle is None else host.position_angle
    q = system.host_q if host.q is None else host.q
    flux = magnitude_to_rate(host.magnitude, zero_point)
    if host.n is not None:
        return SersicProfile(flux=flux, r_eff=host.r_eff, n=host.n, q=q, phi=image_angle(angle), x=x, y=y)
    shape = HostShape(image=host.image, made=host.made)
    turned = host.position_angle or 0.0 if host.image is not None else angle
    return _galaxy(shape, q, turned, flux, host.r_eff, x, y)


@lru_cache(maxsize=64)
def _galaxy(shape: HostShape, q: float, angle: float, flux: float, r_eff: float, x: float, y: float) -> Galaxy:
    """A galaxy, which is measured once: truth and picture are of the same."""
    if shape.image is not None:
        return galaxy_of((image_component(shape.image, angle),), flux, r_eff, x, y)
    if shape.made is None:
        raise SpecError("host", "a Sersic profile", "an image or a galaxy that is made up")
    return galaxy_of(made_components(shape.made, q, image_angle(angle)), flux, r_eff, x, y)


def image_component(image: HostImage, angle: float) -> PixelLight:
    """An image with pixels of unit side, turned by ``angle`` [deg] East of North, its nucleus at the origin."""
    # Rows from the South, West on the right: the image frame has x to the West and y to the North.
    return PixelLight(image.array(), 1.0, *image.nucleus, phi=math.radians(angle))
