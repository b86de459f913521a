"""B^T C^-1 B in blocks.

Two pixels couple where their responses share a pixel of the mask: those farther apart than twice the PSF's radius do
not. Pixels are taken in patches of ``TILE`` that are compact on the sky, and of the symmetric matrix W = B^T C^-1 B the
blocks (patch by patch) of the upper triangle are kept that are not zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from engine.compiled import contracted_kernel
from engine.conventions import FloatArray
from engine.likelihood.noise import NoiseFactor
from engine.source.lensing_matrix import RayBundle

TILE = 48
"""Pixels of a patch: a block of W (18 KiB) then fits the first-level cache beside what is made of it."""

_STRIP = 8
"""Rows of the image that a patch spans."""

_ROUNDING = 2.0**-50
"""Part of the largest entry of a column of C^-1 B below which another is no more than rounding."""

_NEGLIGIBLE = 1e-12
"""Blocks whose entries are all below this part of the geometric mean of their two diagonal entries are left out. Under
independent noise only zeros are; the inverse of a covariance falls off for ever, and ln Z changes by 1e-9 or less."""

IndexArray = NDArray[np.int64]


@dataclass(frozen=True)
class WTilde:
    """W = V + V^T of P pixels, V upper triangular in the order of ``order``, with half the diagonal of W.

    Attributes
    ----------
    order : array (P,)
        Pixel at each place; places TILE t to TILE (t + 1) are patch t.
    start : array (patches + 1,)
        Blocks start[t] to start[t + 1] are those of the columns of patch t.
    row_patch : array (blocks,)
        Patch of a block's rows, at most that of its columns.
    blocks : array (blocks, TILE, TILE)
        Zero beyond the last pixel.
    """

    order: IndexArray
    start: IndexArray
    row_patch: IndexArray
    blocks: FloatArray

    def dense(self) -> FloatArray:
        """W (P, P), pixels as in B."""
        p = self.order.size
        places = (self.start.size - 1) * TILE
        half = np.zeros((places, places))
        for patch in range(self.start.size - 1):
            for block in range(self.start[patch], self.start[patch + 1]):
                row = self.row_patch[block] * TILE
                half[row : row + TILE, patch * TILE : (patch + 1) * TILE] = self.blocks[block]
        out = np.empty((p, p))
        out[np.ix_(self.order, self.order)] = (half + half.T)[:p, :p]
        return out


def _patch_order(rays: RayBundle, total: int) -> IndexArray:
    """Pixels by strips of ``_STRIP`` image rows, within a strip by columns; columns of B that are no pixels last."""
    scale = math.sqrt(rays.pixel_area)
    x = rays.x.reshape(rays.pixels, -1).mean(axis=1)
    y = rays.y.reshape(rays.pixels, -1).mean(axis=1)
    column, row = np.rint((x - x.min()) / scale), np.rint((y - y.min()) / scale)
    order = np.lexsort((row, column, row // _STRIP))
    return np.concatenate([order, np.arange(rays.pixels, total)]).astype(np.int64)


@contracted_kernel
def _weigh(  # noqa: PLR0912 - loops of four and what is left of them
    rows: FloatArray, columns: FloatArray, values: FloatArray, low: int, high: int
) -> tuple[int, int]:
    """C^-1 values in place, of ``values`` (M, TILE) that are zero outside rows ``low`` to ``high``; which rows it has.

    C = R R^T: ``rows`` (M, b + 1) has R[m, m - b + k] at [m, k], ``columns`` (M, b + 1) R[m + k, m]. Both substitutions
    end where b rows on end are no more than rounding, since all that follows is made of these.
    """
    pixels, band = rows.shape[0], rows.shape[1] - 1
    largest, quiet, stop = 0.0, 0, pixels
    for m in range(low, pixels):
        k = max(low, m - band)
        while k + 4 <= m:
            at = k - m + band
            w0, w1, w2, w3 = rows[m, at], rows[m, at + 1], rows[m, at + 2], rows[m, at + 3]
            for j in range(TILE):
                values[m, j] -= (w0 * values[k, j] + w1 * values[k + 1, j]) + (
                    w2 * values[k + 2, j] + w3 * values[k + 3, j]
                )
            k += 4
        for i in range(k, m):
            for j in range(TILE):
                values[m, j] -= rows[m, i - m + band] * values[i, j]
        size = 0.0
        for j in range(TILE):
            values[m, j] /= rows[m, band]
            size = max(size, abs(values[m, j]))
        largest = max(largest, size)
        quiet = quiet + 1 if size <= _ROUNDING * largest else 0
        if m >= high - 1 and quiet >= band:
            stop = m + 1
            break
    largest, quiet = 0.0, 0
    for m in range(stop - 1, -1, -1):
        last = min(stop, m + band + 1)
        k = m + 1
        while k + 4 <= last:
            at = k - m
            w0, w1, w2, w3 = columns[m, at], columns[m, at + 1], columns[m, at + 2], columns[m, at + 3]
            for j in range(TILE):
                values[m, j] -= (w0 * values[k, j] + w1 * values[k + 1, j]) + (
                    w2 * values[k + 2, j] + w3 * values[k + 3, j]
                )
            k += 4
        for i in range(k, last):
            for j in range(TILE):
                values[m, j] -= columns[m, i - m] * values[i, j]
        size = 0.0
        for j in range(TILE):
            values[m, j] /= columns[m, 0]
            size = max(size, abs(values[m, j]))
        largest = max(largest, size)
        quiet = quiet + 1 if size <= _ROUNDING * largest else 0
        if m <= low and quiet >= band:
            return m, stop
    return 0, stop


@contracted_kernel
def _couple(  # noqa: PLR0912 - the same
    pointers: NDArray[np.int32],
    indices: NDArray[np.int32],
    values: FloatArray,
    weighed: FloatArray,
    low: int,
    high: int,
    diagonal: FloatArray,
    out: FloatArray,
) -> NDArray[np.bool_]:
    """V[:, patch] into ``out`` (patch + 1, TILE, TILE), and which of its blocks (patch + 1,) are to be kept.

    B^T is in sparse rows, ``weighed`` (M, TILE) is C^-1 B of the patch, zero outside of rows ``low`` to ``high``. The
    patch's part of ``diagonal`` (P,) of W is written.
    """
    patch, pixels = out.shape[0] - 1, pointers.size - 1
    used = np.zeros(weighed.shape[0], np.bool_)
    # Each column by its own largest entry: beside pixels that hardly count others may count 1e24 times as much.
    floor = np.zeros(TILE)
    for m in range(low, high):
        for k in range(TILE):
            floor[k] = max(floor[k], _ROUNDING * abs(weighed[m, k]))
    for m in range(low, high):
        for k in range(TILE):
            used[m] |= abs(weighed[m, k]) > floor[k]
    kept = np.zeros(patch + 1, np.bool_)
    where, what = np.empty(weighed.shape[0], np.int64), np.empty(weighed.shape[0])
    scale = np.zeros(TILE)
    for above in range(patch, -1, -1):
        block = out[above]
        for q in range(TILE):
            p = above * TILE + q
            for k in range(TILE):
                block[q, k] = 0.0
            count = 0
            if p < pixels:
                for e in range(pointers[p], pointers[p + 1]):
                    if used[indices[e]]:
                        where[count], what[count] = indices[e], values[e]
                        count += 1
            e = 0
            while e + 4 <= count:
                m0, m1, m2, m3 = where[e], where[e + 1], where[e + 2], where[e + 3]
                w0, w1, w2, w3 = what[e], what[e + 1], what[e + 2], what[e + 3]
                for k in range(TILE):
                    block[q, k] += (w0 * weighed[m0, k] + w1 * weighed[m1, k]) + (
                        w2 * weighed[m2, k] + w3 * weighed[m3, k]
                    )
                e += 4
            for i in range(e, count):
                for k in range(TILE):
                    block[q, k] += what[i] * weighed[where[i], k]
        if above == patch:
            for q in range(min(TILE, pixels - patch * TILE)):
                diagonal[patch * TILE + q] = block[q, q]
                scale[q] = math.sqrt(abs(block[q, q]))
                block[q, q] *= 0.5
                block[q, :q] = 0.0
        for q in range(min(TILE, pixels - above * TILE)):
            least = _NEGLIGIBLE * math.sqrt(abs(diagonal[above * TILE + q]))
            for k in range(TILE):
                kept[above] |= abs(block[q, k]) > least * scale[k]
    return kept


def _on_cache_lines(shape: tuple[int, ...]) -> FloatArray:
    """Memory that begins with a line of the cache: half of the wide loads would cross one, a tenth of an evaluation."""
    size, line = math.prod(shape), 8
    memory = np.empty(size + line)
    begin = -(memory.ctypes.data // memory.itemsize) % line
    return memory[begin : begin + size].reshape(shape)


def compute_w_tilde(blurring: sparse.csr_matrix, noise: NoiseFactor, rays: RayBundle) -> WTilde:
    """W = B^T C^-1 B for B (M, P), patch by patch, so that no matrix of M x M, M x P or P x P is ever made."""
    order = _patch_order(rays, blurring.shape[1])
    transposed = sparse.csr_matrix(blurring.T)[order]
    transposed.sum_duplicates()
    p = order.size
    patches = -(-p // TILE)
    rows, columns = noise.rows(), np.ascontiguousarray(noise.bands.T)
    diagonal = np.zeros(p)
    weighed = np.zeros((blurring.shape[0], TILE))
    start, row_patch, kept = np.zeros(patches + 1, dtype=np.int64), [], []
    for patch in range(patches):
        begin, end = transposed.indptr[patch * TILE], transposed.indptr[min(p, (patch + 1) * TILE)]
        low, high = 0, 0
        if end > begin:
            here = transposed[patch * TILE : (patch + 1) * TILE].tocoo()
            low, high = int(here.col.min()), int(here.col.max()) + 1
            weighed[here.col, here.row] = here.data
            low, high = _weigh(rows, columns, weighed, low, high)
        half = np.empty((patch + 1, TILE, TILE))
        found = np.flatnonzero(
            _couple(transposed.indptr, transposed.indices, transposed.data, weighed, low, high, diagonal, half)
        )
        weighed[low:high] = 0.0
        row_patch.append(found)
        kept.append(half[found])
        start[patch + 1] = start[patch] + found.size
    blocks = _on_cache_lines((int(start[-1]), TILE, TILE))
    for patch in reversed(range(patches)):
        blocks[start[patch] : start[patch + 1]] = kept.pop()
    return WTilde(order, start, np.concatenate(row_patch).astype(np.int64), blocks)
