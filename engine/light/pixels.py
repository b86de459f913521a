"""Light on square pixels: an image of a galaxy as a surface brightness, seen directly or through a lens.

The brightness is bilinear between the centres of the pixels and falls to zero within a pixel of the outermost, so that
its integral is the sum of the pixels. It is what it is: nothing is interpolated that a finer image would show. It is
integrated over pixels of the image plane by the midpoint rule on sub-rays, :data:`RAYS` to a pixel of the galaxy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from engine.compiled import kernel
from engine.conventions import FloatArray
from engine.errors import SpecError
from engine.lensing.power_law import LensConstants, PowerLawLens, lens_constants, trace_rays
from engine.work import count

RAYS = 3.0
"""Sub-rays at least along a pixel of the galaxy where nothing is magnified (:data:`engine.light.pixels`, tests)."""
_LEAST, _MOST = 2, 16


@dataclass(frozen=True)
class PixelLight:
    """A galaxy on pixels, in the image or source frame.

    Attributes
    ----------
    values : array (rows, columns)
        Surface brightness [e-/s arcsec^-2] at the centres of the pixels.
    side : float
        Of a pixel [arcsec].
    column, row : float
        Of the point that stands at (x, y), counted from the centre of the first pixel.
    q, phi : float
        Its rows run along phi [rad, counter-clockwise from +x]; a circle of the image is seen as an ellipse of axis
        ratio q and the same area, with its major axis along the rows.
    x, y : float
        Where that point stands [arcsec].
    """

    values: FloatArray
    side: float
    column: float
    row: float
    q: float = 1.0
    phi: float = 0.0
    x: float = 0.0
    y: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what is no image."""
        if self.values.ndim != 2 or not np.isfinite(self.values).all():
            raise SpecError("values", self.values.shape, "a two-dimensional image of finite numbers")
        if not self.side > 0:
            raise SpecError("side", self.side, "a positive length")
        if not 0 < self.q <= 1:
            raise SpecError("q", self.q, "an axis ratio in (0, 1]")

    @property
    def flux(self) -> float:
        """Total count rate [e-/s]."""
        return float(self.values.sum()) * self.side**2


class PixelConstants(NamedTuple):
    """An image as the kernels take it: (column, row) = (column0, row0) + matrix (dx, dy); ``values`` has a dark rim."""

    values: FloatArray
    ux: float
    uy: float
    vx: float
    vy: float
    column: float
    row: float
    x: float
    y: float


def pixel_constants(light: PixelLight) -> PixelConstants:
    """The constants of an image; a rim of two dark pixels spares the kernels the question where it ends."""
    c, s = math.cos(light.phi), math.sin(light.phi)
    along, across = math.sqrt(light.q) / light.side, 1.0 / (math.sqrt(light.q) * light.side)
    return PixelConstants(
        values=np.ascontiguousarray(np.pad(light.values, 2), dtype=np.float64),
        ux=along * c,
        uy=along * s,
        vx=-across * s,
        vy=across * c,
        column=float(light.column) + 2.0,
        row=float(light.row) + 2.0,
        x=float(light.x),
        y=float(light.y),
    )


@kernel
def look_up_pixels(x: float, y: float, light: PixelConstants) -> float:
    """Surface brightness [e-/s arcsec^-2] at a point."""
    dx, dy = x - light.x, y - light.y
    u = light.column + light.ux * dx + light.uy * dy
    v = light.row + light.vx * dx + light.vy * dy
    rows, columns = light.values.shape
    if not (0.0 < u < columns - 1.0 and 0.0 < v < rows - 1.0):
        return 0.0
    i, j = int(u), int(v)
    s, t = u - i, v - j
    low = (1.0 - s) * light.values[j, i] + s * light.values[j, i + 1]
    high = (1.0 - s) * light.values[j + 1, i] + s * light.values[j + 1, i + 1]
    value: float = (1.0 - t) * low + t * high
    return value


@kernel
def _row_directly(x: FloatArray, y: float, side: float, rays: int, light: PixelConstants, out: FloatArray) -> None:
    """Flux (nx,) of a row of pixels, from rays x rays sub-rays each."""
    for i in range(x.size):
        total = 0.0
        for k in range(rays * rays):
            dx, dy = ((k % rays) + 0.5) / rays - 0.5, ((k // rays) + 0.5) / rays - 0.5
            total += look_up_pixels(x[i] + dx * side, y + dy * side, light)
        out[i] = total * (side / rays) ** 2


@kernel
def _row_through_lens(
    x: FloatArray, y: float, side: float, rays: int, light: PixelConstants, lens: LensConstants, out: FloatArray
) -> None:
    """The same behind a lens."""
    each = rays * rays
    px, py = np.empty(x.size * each), np.empty(x.size * each)
    for i in range(x.size):
        for k in range(each):
            px[i * each + k] = x[i] + (((k % rays) + 0.5) / rays - 0.5) * side
            py[i * each + k] = y + (((k // rays) + 0.5) / rays - 0.5) * side
    bx, by = np.empty(px.size), np.empty(px.size)
    trace_rays(px, py, lens, bx, by)
    for i in range(x.size):
        total = 0.0
        for k in range(i * each, (i + 1) * each):
            total += look_up_pixels(bx[k], by[k], light)
        out[i] = total * (side / rays) ** 2


def render_pixels(
    light: PixelLight,
    x: FloatArray,
    y: FloatArray,
    pixel_scale: float,
    lens: PowerLawLens | None = None,
    rays_per_pixel: float = RAYS,
) -> FloatArray:
    """Flux per pixel (ny, nx) [e-/s] of an image on a regular grid of square pixels with centres x (nx,), y (ny,)."""
    needed = rays_per_pixel * pixel_scale / (light.side * math.sqrt(light.q))
    rays = min(max(math.ceil(needed), _LEAST), _MOST)
    constants, out = pixel_constants(light), np.empty((y.size, x.size))
    behind = None if lens is None else lens_constants(lens)
    for row, centre in zip(out, y, strict=True):
        if behind is None:
            _row_directly(x, float(centre), pixel_scale, rays, constants, row)
        else:
            _row_through_lens(x, float(centre), pixel_scale, rays, constants, behind, row)
    count("pixels_rendered", out.size)
    if behind is not None:
        count("rays_traced", out.size * rays**2)
    return out
