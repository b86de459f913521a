"""A galaxy as a sum of Sersic profiles and images, and what its size and axis ratio are.

Magnitude is that of all its light. Its half-light radius is an aperture's, on the intermediate axis as that of a Sersic
profile: R for which half of the flux lies within sqrt(q u^2 + v^2 / q) <= R, about the nucleus, u along the major axis.
The ellipse is that of the second moments of the light within 2 R. For a Sersic profile these are its own r_eff, q and
angle. There is no Sersic index of such a galaxy.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq

from engine.conventions import FloatArray, pixel_centres
from engine.errors import SpecError
from engine.lensing.power_law import PowerLawLens
from engine.light.cell_means import profile_on_grid
from engine.light.pixels import PixelLight, pixel_constants, render_pixels
from engine.light.rendering import DEFAULT_TOLERANCE, render_sersic
from engine.light.sersic import SersicProfile, flux_in_circle

Component = SersicProfile | PixelLight
_CELLS = 320
_REACH = 3.2
"""Half a side of the field that a galaxy is measured on, in half-light radii."""
_WITHIN = 2.0
"""Half-light radii within which moments are taken."""
_STEPS, _CLOSE, _LARGER = 40, 1e-4, 1.6
_SAMPLES = 8


@dataclass(frozen=True)
class Galaxy:
    """A galaxy that is no Sersic profile, in the image or source frame.

    ``flux`` [e-/s], ``r_eff`` [arcsec], ``q`` and ``phi`` [rad] are those of the module's definitions, (``x``, ``y``)
    [arcsec] is the nucleus; the names are those of :class:`~engine.light.sersic.SersicProfile`.
    """

    components: tuple[Component, ...]
    r_eff: float
    q: float
    phi: float
    x: float = 0.0
    y: float = 0.0
    n: None = None

    @property
    def flux(self) -> float:
        """Total count rate [e-/s]."""
        return sum(component.flux for component in self.components)


Light = SersicProfile | Galaxy


def profiles_of(light: Light) -> tuple[SersicProfile, ...]:
    """The Sersic profiles in a galaxy, or it itself: what has a cusp."""
    return tuple(one for one in components_of(light) if isinstance(one, SersicProfile))


def components_of(light: Light) -> tuple[Component, ...]:
    """What a galaxy is the sum of."""
    return (light,) if isinstance(light, SersicProfile) else light.components


def render_light(
    light: Light,
    x: FloatArray,
    y: FloatArray,
    pixel_scale: float,
    lens: PowerLawLens | None = None,
    tolerance: float = DEFAULT_TOLERANCE,
) -> FloatArray:
    """Flux per pixel (ny, nx) [e-/s] of a galaxy; as :func:`engine.light.rendering.render_sersic`."""
    return _rendered(components_of(light), x, y, pixel_scale, lens, tolerance)


def _rendered(
    components: Sequence[Component],
    x: FloatArray,
    y: FloatArray,
    side: float,
    lens: PowerLawLens | None = None,
    tolerance: float = DEFAULT_TOLERANCE,
) -> FloatArray:
    images = [
        render_sersic(one, x, y, side, lens, tolerance)
        if isinstance(one, SersicProfile)
        else render_pixels(one, x, y, side, lens)
        for one in components
    ]
    return np.asarray(sum(images[1:], images[0]))


def light_on_grid(light: Light, x_edges: FloatArray, y_edges: FloatArray) -> FloatArray:
    """Mean surface brightness [e-/s arcsec^-2] over the cells between edges, (ny nx,)."""
    out = np.zeros((x_edges.size - 1) * (y_edges.size - 1))
    for one in components_of(light):
        means = profile_on_grid if isinstance(one, SersicProfile) else _means
        out += means(one, x_edges, y_edges)  # type: ignore[arg-type]
    return out


def _means(light: PixelLight, x_edges: FloatArray, y_edges: FloatArray) -> FloatArray:
    """The same of an image, from 8 x 8 points in a cell."""
    x, y = (
        (edges[:-1, None] + np.multiply.outer(np.diff(edges), (np.arange(_SAMPLES) + 0.5) / _SAMPLES)).ravel()
        for edges in (x_edges, y_edges)
    )
    found = brightness_at(light, x[None, :], y[:, None])
    ny, nx = y_edges.size - 1, x_edges.size - 1
    return np.asarray(found.reshape(ny, _SAMPLES, nx, _SAMPLES).mean(axis=(1, 3)).ravel())


def brightness_at(light: PixelLight, x: FloatArray, y: FloatArray) -> FloatArray:
    """Surface brightness [e-/s arcsec^-2] of an image at positions [arcsec] of shapes that broadcast."""
    c = pixel_constants(light)
    u = c.column + c.ux * (x - c.x) + c.uy * (y - c.y)
    v = c.row + c.vx * (x - c.x) + c.vy * (y - c.y)
    rows, columns = c.values.shape
    inside = (u > 0) & (u < columns - 1) & (v > 0) & (v < rows - 1)
    i, j = (np.where(inside, one, 0.0).astype(np.intp) for one in (u, v))
    s, t = u - i, v - j
    low = (1.0 - s) * c.values[j, i] + s * c.values[j, i + 1]
    high = (1.0 - s) * c.values[j + 1, i] + s * c.values[j + 1, i + 1]
    return np.where(inside, (1.0 - t) * low + t * high, 0.0)


def flux_within(light: Light, radius: float) -> float:
    """Flux [e-/s] within a circle of ``radius`` [arcsec] round the centre or nucleus."""
    if isinstance(light, SersicProfile):
        return flux_in_circle(light, radius)
    return _Field(light.components, light.x, light.y, 1.05 * radius).within(radius, 1.0, 0.0)


class _Field:
    """Light on a square field of cells round a point, for apertures on it."""

    def __init__(self, components: Sequence[Component], x: float, y: float, half: float) -> None:
        self.side = 2.0 * half / _CELLS
        axis = pixel_centres(_CELLS, self.side)
        self.flux = _rendered(components, x + axis, y + axis, self.side)
        self.dx, self.dy = np.meshgrid(axis, axis)

    def radius(self, q: float, phi: float) -> tuple[FloatArray, FloatArray]:
        """Elliptical radius [arcsec] of each cell, and by how much it grows across one."""
        c, s = math.cos(phi), math.sin(phi)
        u, v = c * self.dx + s * self.dy, c * self.dy - s * self.dx
        radius = np.sqrt(q * u * u + v * v / q)
        return radius, self.side * np.hypot(q * u, v / q) / radius

    def within(self, radius: float, q: float, phi: float) -> float:
        """Flux in an ellipse; of a cell on its edge the part that is inside."""
        r, across = self.radius(q, phi)
        return float((self.flux * np.clip(0.5 + (radius - r) / across, 0.0, 1.0)).sum())

    def half_light_radius(self, half: float, q: float, phi: float, most: float) -> float | None:
        """The radius that holds the flux ``half``; None where that is beyond ``most``."""
        if self.within(most, q, phi) <= half:
            return None
        return float(brentq(lambda radius: self.within(radius, q, phi) - half, 0.0, most, xtol=1e-6 * most))

    def ellipse(self, radius: float, q: float, phi: float) -> tuple[float, float]:
        """Axis ratio and angle of the second moments within an ellipse."""
        r, across = self.radius(q, phi)
        weight = self.flux * np.clip(0.5 + (radius - r) / across, 0.0, 1.0)
        xx, yy = (float((weight * one * one).sum()) for one in (self.dx, self.dy))
        xy = float((weight * self.dx * self.dy).sum())
        spread, mean = math.hypot(0.5 * (xx - yy), xy), 0.5 * (xx + yy)
        if not mean > spread:
            raise SpecError("host", f"moments {xx:g}, {yy:g}, {xy:g}", "a galaxy whose light has positive moments")
        # The moments go with the squares of the axes; an ellipse of q < 0.05 would not be told from a line.
        return max(math.sqrt((mean - spread) / (mean + spread)), 0.05), 0.5 * math.atan2(2.0 * xy, xx - yy)


def half_light_ellipse(components: Sequence[Component], scale: float) -> tuple[float, float, float]:
    """Half-light radius [arcsec], axis ratio and angle [rad] about the origin; ``scale`` [arcsec] is about its size.

    Found by going from ellipse to moments and back, good to 1e-3.

    Raises
    ------
    SpecError
        There is no such ellipse: noise outweighs the galaxy, say.
    """
    half = 0.5 * sum(component.flux for component in components)
    radius, q, phi, found = scale, 1.0, 0.0, None
    field = _Field(components, 0.0, 0.0, _REACH * radius)
    for _ in range(_STEPS):
        reach = 0.5 * _CELLS * field.side * math.sqrt(q)
        found = field.half_light_radius(half, q, phi, reach)
        if found is None or not 0.6 < 2.0 * _REACH * found / (_CELLS * field.side) < 1.4:
            # The field is too small, or its cells are too coarse.
            radius = _LARGER * radius if found is None else found
            field = _Field(components, 0.0, 0.0, _REACH * radius)
            continue
        new_q, new_phi = field.ellipse(min(_WITHIN * found, reach), q, phi)
        moved = abs(found / radius - 1.0) + abs(new_q - q) + 2.0 * abs(math.sin(new_phi - phi)) * (1.0 - new_q)
        radius, q, phi = found, new_q, new_phi
        if moved < _CLOSE:
            break
    if found is None:
        raise SpecError("host", f"half of the light beyond {radius:g} arcsec", "a galaxy with a half-light radius")
    return radius, q, phi


def galaxy_of(parts: Sequence[Component], flux: float, r_eff: float, x: float, y: float) -> Galaxy:
    """Components about the origin as a galaxy: in proportion, with a flux [e-/s] and half-light radius [arcsec]."""
    sizes = (one.r_eff if isinstance(one, SersicProfile) else one.side * min(one.values.shape) / 6 for one in parts)
    radius, q, phi = half_light_ellipse(parts, max(sizes))
    stretch, brighter = r_eff / radius, flux / sum(one.flux for one in parts)
    return Galaxy(tuple(_scaled(one, stretch, brighter, x, y) for one in parts), r_eff, q, phi, x, y)


def _scaled(one: Component, stretch: float, brighter: float, x: float, y: float) -> Component:
    place = {"x": x + stretch * one.x, "y": y + stretch * one.y}
    if isinstance(one, SersicProfile):
        return replace(one, flux=brighter * one.flux, r_eff=stretch * one.r_eff, **place)
    return replace(one, values=one.values * (brighter / stretch**2), side=stretch * one.side, **place)
