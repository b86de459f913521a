"""From image rays to source pixels: the sparse matrix L, with the sub-rays of an image pixel merged.

The source is piecewise bilinear between the nodes of a rectangular grid: the smallest rectangle round the traced rays
of the mask, with nodes on its edges. A ray outside the rectangle carries no light.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from engine.conventions import FloatArray
from engine.errors import InversionError
from engine.lensing.power_law import trace_rays


@dataclass(frozen=True)
class SourceGrid:
    """Nodes of the source: (ny, nx) of them from (x0, y0) in steps of dx, dy [arcsec]."""

    x0: float
    y0: float
    dx: float
    dy: float
    ny: int
    nx: int

    @property
    def shape(self) -> tuple[int, int]:
        """(ny, nx)."""
        return self.ny, self.nx

    @property
    def x(self) -> FloatArray:
        """Node coordinates along x [arcsec]."""
        return self.x0 + self.dx * np.arange(self.nx)

    @property
    def y(self) -> FloatArray:
        """Node coordinates along y [arcsec]."""
        return self.y0 + self.dy * np.arange(self.ny)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Edges of the pixels centred on the nodes: left, right, bottom, top [arcsec]."""
        return (
            self.x0 - 0.5 * self.dx,
            self.x0 + (self.nx - 0.5) * self.dx,
            self.y0 - 0.5 * self.dy,
            self.y0 + (self.ny - 0.5) * self.dy,
        )


@dataclass(frozen=True)
class RayBundle:
    """Rays of the image pixels that matter, ``subrays**2`` consecutive ones a pixel.

    ``x``, ``y`` are (pixels * subrays^2,) positions [arcsec]; ``in_mask`` (pixels,) is True for pixels of the mask,
    False for the margin whose light the PSF carries in; ``pixel_area`` [arcsec^2].
    """

    x: FloatArray
    y: FloatArray
    subrays: int
    in_mask: NDArray[np.bool_]
    pixel_area: float

    @property
    def pixels(self) -> int:
        """Number of image pixels with rays."""
        return self.in_mask.size


@dataclass(frozen=True)
class Mapping:
    """The matrix L in padded rows: entry e of row p maps source pixel ``columns[p, e]`` with ``weights[p, e]``.

    Weights are in arcsec^2: source values are surface brightness per arcsec^2, rows are fluxes per image pixel.
    ``entries`` (pixels,) counts the entries of each row.
    """

    grid: SourceGrid
    columns: NDArray[np.int32]
    weights: FloatArray
    entries: NDArray[np.int32]

    def dense(self) -> FloatArray:
        """L as an array of shape (pixels, ny nx)."""
        out = np.zeros((self.entries.size, self.grid.ny * self.grid.nx))
        for row, count in enumerate(self.entries):
            np.add.at(out[row], self.columns[row, :count], self.weights[row, :count])
        return out

    def apply(self, source: FloatArray) -> FloatArray:
        """Image-plane fluxes (pixels,) before the PSF, of a source (ny nx,)."""
        return _apply(self.columns, self.weights, self.entries, source)

    def transpose(self, image: FloatArray) -> FloatArray:
        """L^T times an image-plane vector (pixels,): shape (ny nx,)."""
        return _transpose(self.columns, self.weights, self.entries, image, self.grid.ny * self.grid.nx)


def cast_rays(
    mask: NDArray[np.bool_], margin: NDArray[np.bool_], x: FloatArray, y: FloatArray, scale: float, subrays: int
) -> RayBundle:
    """Rays of the pixels of ``mask`` or ``margin`` (ny, nx) with centres x (nx,), y (ny,) and side ``scale``."""
    rows, columns = np.nonzero(mask | margin)
    offsets = (np.arange(subrays) + 0.5) / subrays - 0.5
    oy, ox = np.meshgrid(offsets * scale, offsets * scale, indexing="ij")
    return RayBundle(
        x=(x[columns][:, None] + ox.ravel()[None, :]).ravel(),
        y=(y[rows][:, None] + oy.ravel()[None, :]).ravel(),
        subrays=subrays,
        in_mask=mask[rows, columns],
        pixel_area=scale * scale,
    )


@njit(nogil=True, cache=True)
def _bounds(bx: FloatArray, by: FloatArray, in_mask: NDArray[np.bool_], per_pixel: int) -> tuple[float, ...]:
    left, right, bottom, top = np.inf, -np.inf, np.inf, -np.inf
    for pixel in range(in_mask.size):
        if in_mask[pixel]:
            for ray in range(pixel * per_pixel, (pixel + 1) * per_pixel):
                left, right = min(left, bx[ray]), max(right, bx[ray])
                bottom, top = min(bottom, by[ray]), max(top, by[ray])
    return left, right, bottom, top


@njit(nogil=True, cache=True)
def _fill(
    bx: FloatArray,
    by: FloatArray,
    per_pixel: int,
    grid: tuple[float, float, float, float],
    ny: int,
    nx: int,
    ray_weight: float,
    columns: NDArray[np.int32],
    weights: FloatArray,
    entries: NDArray[np.int32],
) -> None:
    x0, y0, dx, dy = grid
    tiny = 1e-9
    for pixel in range(entries.size):
        used = 0
        for ray in range(pixel * per_pixel, (pixel + 1) * per_pixel):
            u = (bx[ray] - x0) / dx
            v = (by[ray] - y0) / dy
            # The ray that defines an edge lies on it up to rounding.
            if u < -tiny or v < -tiny or u > nx - 1 + tiny or v > ny - 1 + tiny:
                continue
            i = min(max(int(u), 0), nx - 2)
            j = min(max(int(v), 0), ny - 2)
            fx = u - i
            fy = v - j
            for k in range(4):
                a, b = k % 2, k // 2
                weight = ray_weight * (fx if a else 1.0 - fx) * (fy if b else 1.0 - fy)
                column = (j + b) * nx + i + a
                e = 0
                while e < used and columns[pixel, e] != column:
                    e += 1
                if e == used:
                    columns[pixel, e] = column
                    weights[pixel, e] = weight
                    used += 1
                else:
                    weights[pixel, e] += weight
        entries[pixel] = used


@njit(nogil=True, cache=True)
def _apply(
    columns: NDArray[np.int32], weights: FloatArray, entries: NDArray[np.int32], source: FloatArray
) -> FloatArray:
    out = np.zeros(entries.size)
    for p in range(entries.size):
        for e in range(entries[p]):
            out[p] += weights[p, e] * source[columns[p, e]]
    return out


@njit(nogil=True, cache=True)
def _transpose(
    columns: NDArray[np.int32], weights: FloatArray, entries: NDArray[np.int32], image: FloatArray, n: int
) -> FloatArray:
    out = np.zeros(n)
    for p in range(entries.size):
        for e in range(entries[p]):
            out[columns[p, e]] += weights[p, e] * image[p]
    return out


def map_rays(rays: RayBundle, lens_arguments: tuple[FloatArray, FloatArray], shape: tuple[int, int]) -> Mapping:
    """Trace the rays through the lens and lay the source grid of ``shape`` (ny, nx) round those of the mask.

    ``lens_arguments`` are those of :func:`engine.lensing.power_law.kernel_arguments`. An InversionError tells of a
    mask without pixels or rays that all fall on one line of the source plane.
    """
    ny, nx = shape
    if not rays.in_mask.any():
        raise InversionError("mask: it has no pixel, at least one is needed")
    bx, by = np.empty(rays.x.size), np.empty(rays.x.size)
    trace_rays(rays.x, rays.y, *lens_arguments, bx, by)
    per_pixel = rays.subrays**2
    left, right, bottom, top = _bounds(bx, by, rays.in_mask, per_pixel)
    if not (right > left and top > bottom):
        raise InversionError(
            f"mask: its rays span {right - left} x {top - bottom} arcsec of the source plane, an area is needed"
        )
    grid = SourceGrid(left, bottom, (right - left) / (nx - 1), (top - bottom) / (ny - 1), ny, nx)
    columns = np.empty((rays.pixels, 4 * per_pixel), dtype=np.int32)
    weights = np.empty((rays.pixels, 4 * per_pixel))
    entries = np.empty(rays.pixels, dtype=np.int32)
    ray_weight = rays.pixel_area / per_pixel
    _fill(bx, by, per_pixel, (left, bottom, grid.dx, grid.dy), ny, nx, ray_weight, columns, weights, entries)
    return Mapping(grid, columns, weights, entries)
