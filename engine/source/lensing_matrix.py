"""From image rays to source pixels: the sparse matrix L, with the sub-rays of an image pixel merged.

The source is piecewise bilinear between the nodes of a rectangular grid: the smallest rectangle round the traced rays
of the mask, with nodes on its edges. Beyond the edges the source falls to zero within a quarter of a cell: a ray of the
margin that leaves the rectangle, as the lens changes, dims instead of going out, and ln Z has no jumps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from engine.compiled import inlined_kernel, kernel
from engine.conventions import FloatArray
from engine.errors import InversionError
from engine.lensing.power_law import PowerLawLens, lens_constants, trace_rays
from engine.source.envelope import Envelope, PlacedEnvelope
from engine.source.grid import SourceGrid
from engine.work import count

FALL = 0.25
"""Width of the fall beyond the edges, in cells: a hundredth of an arcsec, far more than a lens' posterior moves it."""


@dataclass(frozen=True)
class RayBundle:
    """Rays of the image pixels that matter, ``subrays**2`` consecutive ones a pixel.

    ``x``, ``y`` are (pixels * subrays^2,) positions [arcsec]; ``in_mask`` (pixels,) is True for pixels of the mask,
    False for the margin whose light the PSF carries in; ``pixel_area`` [arcsec^2]; ``anchors`` (k, 2) are image
    positions that map to the centre of the source: the AGN images. ``envelope`` is the brightness that is expected of
    the source, None where smoothness is asked of the brightness itself; ``centre`` is then an image position [arcsec]
    that maps to its centre, or None where the envelope has no defect (:class:`Envelope`).
    """

    x: FloatArray
    y: FloatArray
    subrays: int
    in_mask: NDArray[np.bool_]
    pixel_area: float
    anchors: FloatArray
    envelope: Envelope | None = None
    centre: tuple[float, float] | None = None

    @property
    def pixels(self) -> int:
        """Number of image pixels with rays."""
        return self.in_mask.size

    def of_envelope(self) -> FloatArray:
        """Flux of each pixel (pixels,) by its rays for the envelope itself, without floor, behind its own lens."""
        if self.envelope is None:
            raise ValueError("rays: got none, allowed are rays with an envelope")
        bare = replace(self, envelope=replace(self.envelope, floor=0.0), centre=None)
        return map_rays(bare, self.envelope.lens, (2, 2)).apply(np.ones(4))

    @property
    def columns(self) -> int:
        """Number of columns of the blurring matrix: one a pixel, and one for the defect where there is one."""
        return self.pixels + (self.centre is not None)


@dataclass(frozen=True)
class LensingMatrix:
    """The matrix L in padded rows: entry e of row p maps source pixel ``columns[p, e]`` with ``weights[p, e]``.

    Weights are in arcsec^2: source values are surface brightness per arcsec^2, rows are fluxes per image pixel.
    ``entries`` (pixels,) counts the entries of each row.
    """

    grid: SourceGrid
    columns: NDArray[np.int32]
    weights: FloatArray
    entries: NDArray[np.int32]
    envelope: PlacedEnvelope | None = None

    def dense(self) -> FloatArray:
        """L as an array of shape (pixels, ny nx)."""
        out = np.zeros((self.entries.size, self.grid.x.size * self.grid.y.size))
        for row, used in enumerate(self.entries):
            np.add.at(out[row], self.columns[row, :used], self.weights[row, :used])
        return out

    def of_brightness(self, envelope: FloatArray) -> LensingMatrix:
        """The same for sources given by their brightness at the nodes, of a matrix for their ratio to an envelope."""
        known = np.arange(self.columns.shape[1]) < self.entries[:, None]
        weights = np.zeros_like(self.weights)
        weights[known] = self.weights[known] / envelope[self.columns[known]]
        return replace(self, weights=weights, envelope=None)

    def apply(self, source: FloatArray) -> FloatArray:
        """Image-plane fluxes (pixels,) before the PSF, of a source (ny nx,)."""
        return np.asarray(_apply(self.columns, self.weights, self.entries, source))

    def transpose(self, image: FloatArray) -> FloatArray:
        """L^T times an image-plane vector (pixels,): shape (ny nx,)."""
        return np.asarray(
            _transpose(self.columns, self.weights, self.entries, image, self.grid.x.size * self.grid.y.size)
        )


def cast_rays(
    mask: NDArray[np.bool_],
    margin: NDArray[np.bool_],
    x: FloatArray,
    y: FloatArray,
    scale: float,
    subrays: int,
    anchors: FloatArray | None = None,
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
        anchors=np.empty((0, 2)) if anchors is None else np.asarray(anchors, dtype=np.float64).reshape(-1, 2),
    )


@kernel
def _bounds(bx: FloatArray, by: FloatArray, in_mask: NDArray[np.bool_], per_pixel: int) -> tuple[float, ...]:
    """Left, right, bottom and top [arcsec] of the mapped rays (pixels per_pixel,) of the pixels in the mask."""
    left, right, bottom, top = np.inf, -np.inf, np.inf, -np.inf
    for pixel in range(in_mask.size):
        if in_mask[pixel]:
            for ray in range(pixel * per_pixel, (pixel + 1) * per_pixel):
                left, right = min(left, bx[ray]), max(right, bx[ray])
                bottom, top = min(bottom, by[ray]), max(top, by[ray])
    return left, right, bottom, top


@inlined_kernel
def _cell_of(value: float, nodes: FloatArray, guess: int) -> int:
    """Index of the cell that holds a value: i between nodes i and i + 1, -1 and n - 1 beyond the ends."""
    i = min(max(guess, -1), nodes.size - 1)
    while i >= 0 and value < nodes[i]:
        i -= 1
    while i < nodes.size - 1 and value >= nodes[i + 1]:
        i += 1
    return i


@inlined_kernel
def _fraction(value: float, nodes: FloatArray, i: int) -> float:
    """How far into cell i a value is, in units of the cell; outside 0..1 beyond the cells at the ends too."""
    last = nodes.size - 1
    if i < 0:
        return float(1.0 - (nodes[0] - value) / (FALL * (nodes[1] - nodes[0])))
    if i == last:
        return float((value - nodes[last]) / (FALL * (nodes[last] - nodes[last - 1])))
    return float((value - nodes[i]) / (nodes[i + 1] - nodes[i]))


@kernel
def _fill(
    bx: FloatArray,
    by: FloatArray,
    per_pixel: int,
    x: FloatArray,
    y: FloatArray,
    ray_weight: float,
    envelope: FloatArray,
    columns: NDArray[np.int32],
    weights: FloatArray,
    entries: NDArray[np.int32],
) -> None:
    """Rows of L from mapped rays (pixels per_pixel,) [arcsec] and nodes ``x`` (nx,), ``y`` (ny,).

    A ray stands for ``ray_weight`` arcsec^2, times ``envelope`` at each ray where that is not empty. ``columns`` and
    ``weights`` (pixels, 4 per_pixel) and ``entries`` (pixels,) are written, as :class:`LensingMatrix` has them.
    """
    nx = x.size
    i, j = 0, 0
    for pixel in range(entries.size):
        used = 0
        for ray in range(pixel * per_pixel, (pixel + 1) * per_pixel):
            u, v = bx[ray], by[ray]
            light = ray_weight
            if envelope.size:
                # Beyond the grid the source goes on as its envelope does.
                u, v = min(max(u, x[0]), x[-1]), min(max(v, y[0]), y[-1])
                light *= envelope[ray]
            # Neighbouring rays fall into neighbouring cells: the last cell is a good guess.
            i = _cell_of(u, x, i)
            j = _cell_of(v, y, j)
            fx, fy = _fraction(u, x, i), _fraction(v, y, j)
            if not (0.0 <= fx <= 1.0 and 0.0 <= fy <= 1.0):
                continue
            for k in range(4):
                a, b = i + k % 2, j + k // 2
                # The nodes beyond the ends are zero.
                if a < 0 or b < 0 or a >= nx or b >= y.size:
                    continue
                weight = light * (fx if k % 2 else 1.0 - fx) * (fy if k // 2 else 1.0 - fy)
                column = b * nx + a
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


@kernel
def _apply(
    columns: NDArray[np.int32], weights: FloatArray, entries: NDArray[np.int32], source: FloatArray
) -> FloatArray:
    """L times a source (ny nx,): fluxes (pixels,)."""
    out = np.zeros(entries.size)
    for p in range(entries.size):
        for e in range(entries[p]):
            out[p] += weights[p, e] * source[columns[p, e]]
    return out


@kernel
def _transpose(
    columns: NDArray[np.int32], weights: FloatArray, entries: NDArray[np.int32], image: FloatArray, n: int
) -> FloatArray:
    """L^T times an image (pixels,): shape (n,)."""
    out = np.zeros(n)
    for p in range(entries.size):
        for e in range(entries[p]):
            out[columns[p, e]] += weights[p, e] * image[p]
    return out


def map_rays(rays: RayBundle, lens: PowerLawLens, shape: tuple[int, int]) -> LensingMatrix:
    """Trace the rays through the lens and lay the source grid of ``shape`` (ny, nx) round those of the mask.

    Where the rays have an envelope, the source is that times a function bilinear between the nodes. An InversionError
    tells of a mask without pixels or rays that all fall on one line of the source plane.
    """
    (ny, nx), constants = shape, lens_constants(lens)
    if not rays.in_mask.any():
        raise InversionError("mask: it has no pixel, at least one is needed")
    bx, by = np.empty(rays.x.size), np.empty(rays.x.size)
    trace_rays(rays.x, rays.y, constants, bx, by)
    count("rays_traced", bx.size)
    per_pixel = rays.subrays**2
    left, right, bottom, top = _bounds(bx, by, rays.in_mask, per_pixel)
    if not (right > left and top > bottom):
        raise InversionError(
            f"mask: its rays span {right - left} x {top - bottom} arcsec of the source plane, an area is needed"
        )
    grid = SourceGrid(np.linspace(left, right, nx), np.linspace(bottom, top, ny))
    at_rays = np.empty(0)
    placed = None
    if rays.envelope is not None:
        centre_x, centre_y = 0.5 * (left + right), 0.5 * (bottom + top)
        if rays.anchors.size:
            ax, ay = np.empty(len(rays.anchors)), np.empty(len(rays.anchors))
            anchor_x, anchor_y = np.ascontiguousarray(rays.anchors.T)
            trace_rays(anchor_x, anchor_y, constants, ax, ay)
            centre_x, centre_y = float(ax.mean()), float(ay.mean())
        placed = rays.envelope.placed(centre_x, centre_y, math.sqrt((right - left) * (top - bottom)))
        at_rays = placed.at(bx, by)
    columns = np.empty((rays.columns, 4 * per_pixel), dtype=np.int32)
    weights = np.empty((rays.columns, 4 * per_pixel))
    entries = np.empty(rays.columns, dtype=np.int32)
    _fill(
        bx,
        by,
        per_pixel,
        grid.x,
        grid.y,
        rays.pixel_area / per_pixel,
        at_rays,
        columns,
        weights,
        entries[: rays.pixels],
    )
    if rays.centre is not None:
        # The defect goes with t at the centre of the host: one ray, whose light is t itself.
        cx, cy = np.empty(1), np.empty(1)
        trace_rays(np.array([rays.centre[0]]), np.array([rays.centre[1]]), constants, cx, cy)
        last = slice(rays.pixels, None)
        _fill(cx, cy, 1, grid.x, grid.y, 1.0, np.ones(1), columns[last], weights[last], entries[last])
    return LensingMatrix(grid, columns, weights, entries, placed)
