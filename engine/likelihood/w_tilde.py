"""B^T C^-1 B in blocks, and the curvature matrix from it.

Two pixels couple where their responses share a pixel of the mask: those farther apart than twice the PSF's radius do
not. Pixels are taken in patches of ``TILE`` that are compact on the sky, and of the symmetric matrix W = B^T C^-1 B the
blocks (patch by patch) of the upper triangle are kept that are not zero.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import blas

from engine.compiled import contracted_kernel
from engine.conventions import FloatArray
from engine.likelihood.noise import NoiseFactor
from engine.source.lensing_matrix import LensingMatrix, RayBundle

TILE = 48
"""Pixels of a patch: a block of W (18 KiB) then fits the first-level cache beside what is made of it."""

CHUNK = 64
"""Source pixels that the second product works on at once."""

_CACHE = 640 * 1024
"""Bytes of the second-level cache that L^T V of one patch may take, of all lenses that share a pass over W."""

_STRIP = 8
"""Rows of the image that a patch spans."""

_NEGLIGIBLE = 2.0**-56
"""Blocks whose entries are all below this part of the geometric mean of their two diagonal entries are left out: less
than the rounding of the sums they are made of. Under independent noise only zeros are."""

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
def _patch_columns(
    pointers: NDArray[np.int32],
    indices: NDArray[np.int32],
    values: FloatArray,
    white: FloatArray,
    used: NDArray[np.bool_],
    out: FloatArray,
) -> None:
    """The first len(out) rows of B^T (sparse rows) times ``white`` (M, TILE), whose rows outside ``used`` are zero."""
    for p in range(out.shape[0]):
        for k in range(TILE):
            out[p, k] = 0.0
        for e in range(pointers[p], pointers[p + 1]):
            m = indices[e]
            if used[m]:
                for k in range(TILE):
                    out[p, k] += values[e] * white[m, k]


def compute_w_tilde(blurring: sparse.csr_matrix, noise: NoiseFactor, rays: RayBundle) -> WTilde:
    """W = B^T C^-1 B for B (M, P), patch by patch, so that no matrix of M x P or P x P is ever made."""
    order = _patch_order(rays, blurring.shape[1])
    transposed = sparse.csr_matrix(blurring.T)[order]
    transposed.sort_indices()
    p = order.size
    patches = -(-p // TILE)
    diagonal = np.zeros(p)
    start, row_patch, kept = np.zeros(patches + 1, dtype=np.int64), [], []
    for patch in range(patches):
        first, last = patch * TILE, min(p, (patch + 1) * TILE)
        response = np.zeros((blurring.shape[0], TILE))
        response[:, : last - first] = transposed[first:last].toarray().T
        weighed = noise.whiten_transposed(noise.whiten(response))
        size = np.abs(weighed).max(axis=1)
        used = size > _NEGLIGIBLE * size.max(initial=0.0)
        columns = np.zeros(((patch + 1) * TILE, TILE))
        _patch_columns(
            transposed.indptr,
            transposed.indices,
            transposed.data,
            np.ascontiguousarray(weighed),
            used,
            columns[:last],
        )
        own = columns[first:]
        diagonal[first:last] = np.diag(own)[: last - first]
        own[:] = np.triu(own, 1) + 0.5 * np.diag(np.diag(own))
        floor = _NEGLIGIBLE * np.sqrt(np.abs(diagonal[:last]))
        floor_here = np.zeros(TILE)
        floor_here[: last - first] = np.sqrt(np.abs(diagonal[first:last]))
        counts = np.abs(columns[:last]) > floor[:, None] * floor_here
        rows = np.flatnonzero(np.add.reduceat(counts.any(axis=1), np.arange(0, last, TILE)))
        row_patch.append(rows)
        kept.append(columns.reshape(patch + 1, TILE, TILE)[rows])
        start[patch + 1] = start[patch] + rows.size
    blocks = np.empty((int(start[-1]), TILE, TILE))
    for patch in reversed(range(patches)):
        blocks[start[patch] : start[patch + 1]] = kept.pop()
    return WTilde(order, start, np.concatenate(row_patch).astype(np.int64), blocks)


@contracted_kernel
def _gather_patches(
    order: IndexArray, columns: NDArray[np.int32], weights: FloatArray, entries: NDArray[np.int32], n: int
) -> tuple[IndexArray, IndexArray, IndexArray, IndexArray, FloatArray]:
    """L by patches: the source pixels that a patch maps to, and for each of them its pixels and weights.

    Source pixels ``source[first[t]:first[t + 1]]`` are those of patch t; the entries of the l-th lie in
    ``pointer[l]:pointer[l + 1]`` of ``place`` (within the patch) and ``weight``.
    """
    pixels = order.size
    patches = -(-pixels // TILE)
    total = 0
    for p in range(pixels):
        total += entries[p]
    first = np.zeros(patches + 1, np.int64)
    source, pointer = np.empty(total, np.int64), np.zeros(total + 1, np.int64)
    place, weight = np.empty(total, np.int64), np.empty(total)
    count, slot = np.zeros(n, np.int64), np.empty(n, np.int64)
    used = 0
    for patch in range(patches):
        start, stop = patch * TILE, min(pixels, (patch + 1) * TILE)
        low, high = n, -1
        for q in range(start, stop):
            for e in range(entries[order[q]]):
                column = columns[order[q], e]
                count[column] += 1
                low, high = min(low, column), max(high, column)
        for column in range(low, high + 1):
            if count[column] > 0:
                source[used] = column
                slot[column] = pointer[used]
                pointer[used + 1] = pointer[used] + count[column]
                count[column] = 0
                used += 1
        for q in range(start, stop):
            p = order[q]
            for e in range(entries[p]):
                column = columns[p, e]
                place[slot[column]], weight[slot[column]] = q - start, weights[p, e]
                slot[column] += 1
        first[patch + 1] = used
    return first, source, pointer, place, weight


def _gather_all(
    w_tilde: WTilde, lensings: Sequence[LensingMatrix], n: int
) -> tuple[IndexArray, IndexArray, IndexArray, IndexArray, FloatArray]:
    """The patches of several L one behind the other; of ``first`` (lenses, patches + 1) a row belongs to each."""
    gathered = [_gather_patches(w_tilde.order, each.columns, each.weights, each.entries, n) for each in lensings]
    used = [int(first[-1]) for first, *_ in gathered]
    total = [int(pointer[u]) for (_, _, pointer, _, _), u in zip(gathered, used, strict=True)]
    sources, entries = np.cumsum([0, *used]), np.cumsum([0, *total])
    return (
        np.stack([first + at for (first, *_), at in zip(gathered, sources[:-1], strict=True)]),
        np.concatenate([source[:u] for (_, source, *_), u in zip(gathered, used, strict=True)]),
        np.concatenate(
            [*(p[:u] + at for (_, _, p, _, _), u, at in zip(gathered, used, entries[:-1], strict=True)), entries[-1:]]
        ),
        np.concatenate([place[:m] for (_, _, _, place, _), m in zip(gathered, total, strict=True)]),
        np.concatenate([weight[:m] for (*_, weight), m in zip(gathered, total, strict=True)]),
    )


@contracted_kernel
def _half_curvature(  # noqa: PLR0912 - the two products are written out: inlined from a function they take 25 % longer
    start: IndexArray,
    row_patch: IndexArray,
    blocks: FloatArray,
    first: IndexArray,
    source: IndexArray,
    pointer: IndexArray,
    place: IndexArray,
    weight: FloatArray,
    n: int,
) -> FloatArray:
    """G = L^T V L of each lens in chunks (lenses, chunks, n, CHUNK): its G[i, c CHUNK + k] is half[lens, c, i, k].

    A block of W is fetched once for all lenses. For each patch T = L^T V[:, patch] is added up in ``t`` from the blocks
    above it; chunk by chunk of T, its transpose is then spread over the rows of G that the patch maps to. Four rows at
    a time: a row of the result is then loaded and stored once for four products.
    """
    chunks = -(-n // CHUNK)
    # Arrays made here are known to overlap nothing, which saves more in the loops than making them costs.
    lenses = first.shape[0]
    halves = np.zeros((lenses, chunks, n, CHUNK))
    all_t = np.empty((lenses, chunks * CHUNK, TILE))
    # The odd width keeps the rows of the transpose off each other's cache sets.
    turned = np.empty((TILE, CHUNK + 8))
    for patch in range(start.size - 1):
        all_t[:, :, :] = 0.0
        for block in range(start[patch], start[patch + 1]):
            above = row_patch[block]
            for lens in range(lenses):
                t = all_t[lens]
                for u in range(first[lens, above], first[lens, above + 1]):
                    i = source[u]
                    e, stop = pointer[u], pointer[u + 1]
                    while e + 4 <= stop:
                        p0, p1, p2, p3 = place[e], place[e + 1], place[e + 2], place[e + 3]
                        w0, w1, w2, w3 = weight[e], weight[e + 1], weight[e + 2], weight[e + 3]
                        for k in range(TILE):
                            t[i, k] += (w0 * blocks[block, p0, k] + w1 * blocks[block, p1, k]) + (
                                w2 * blocks[block, p2, k] + w3 * blocks[block, p3, k]
                            )
                        e += 4
                    if e + 2 <= stop:
                        p0, p1, w0, w1 = place[e], place[e + 1], weight[e], weight[e + 1]
                        for k in range(TILE):
                            t[i, k] += w0 * blocks[block, p0, k] + w1 * blocks[block, p1, k]
                        e += 2
                    if e < stop:
                        p0, w0 = place[e], weight[e]
                        for k in range(TILE):
                            t[i, k] += w0 * blocks[block, p0, k]
        for lens in range(lenses):
            t, half = all_t[lens], halves[lens]
            for c in range(chunks):
                for i in range(CHUNK):
                    for k in range(TILE):
                        turned[k, i] = t[c * CHUNK + i, k]
                for u in range(first[lens, patch], first[lens, patch + 1]):
                    i = source[u]
                    e, stop = pointer[u], pointer[u + 1]
                    while e + 4 <= stop:
                        p0, p1, p2, p3 = place[e], place[e + 1], place[e + 2], place[e + 3]
                        w0, w1, w2, w3 = weight[e], weight[e + 1], weight[e + 2], weight[e + 3]
                        for k in range(CHUNK):
                            half[c, i, k] += (w0 * turned[p0, k] + w1 * turned[p1, k]) + (
                                w2 * turned[p2, k] + w3 * turned[p3, k]
                            )
                        e += 4
                    if e + 2 <= stop:
                        p0, p1, w0, w1 = place[e], place[e + 1], weight[e], weight[e + 1]
                        for k in range(CHUNK):
                            half[c, i, k] += w0 * turned[p0, k] + w1 * turned[p1, k]
                        e += 2
                    if e < stop:
                        p0, w0 = place[e], weight[e]
                        for k in range(CHUNK):
                            half[c, i, k] += w0 * turned[p0, k]
    return halves


@contracted_kernel
def _spread(
    columns: NDArray[np.int32], weights: FloatArray, entries: NDArray[np.int32], border: FloatArray, n: int
) -> FloatArray:
    """(L^T border)^T (k, n), for a border (P, k)."""
    out = np.zeros((border.shape[1], n))
    for p in range(entries.size):
        for e in range(entries[p]):
            for k in range(border.shape[1]):
                out[k, columns[p, e]] += weights[p, e] * border[p, k]
    return out


@contracted_kernel
def _join(half: FloatArray, out: FloatArray) -> None:
    """G + G^T into the upper triangle of ``out`` (n, n)."""
    n = out.shape[0]
    for c in range(half.shape[0]):
        for d in range(c + 1):
            for i in range(d * CHUNK, min(n, (d + 1) * CHUNK)):
                for j in range(max(i, c * CHUNK), min(n, (c + 1) * CHUNK)):
                    out[i, j] = half[c, i, j - c * CHUNK] + half[d, j, i - d * CHUNK]


class _Workspace(threading.local):
    """Arrays that each thread makes once and uses again in every evaluation of the same size."""

    def __init__(self) -> None:
        self._arrays: dict[str, FloatArray] = {}

    def array(self, name: str, shape: tuple[int, ...]) -> FloatArray:
        """An array of that shape with whatever it holds."""
        found = self._arrays.get(name)
        if found is None or found.shape != shape:
            found = self._arrays[name] = np.empty(shape)
        return found


workspace = _Workspace()


def together(n: int) -> int:
    """How many lenses share a pass over W for n source pixels: 4 for 20 x 20, one for 30 x 30."""
    return max(1, _CACHE // (8 * TILE * n))


def curvature_matrices(
    w_tilde: WTilde, border: FloatArray, lensings: Sequence[LensingMatrix], out: Sequence[FloatArray] | None = None
) -> list[FloatArray]:
    """F = L^T (W - T T^T) L (n, n) of each L, in Fortran order, valid in the lower triangle.

    Up to :func:`together` of them cost less than one by one, since W is larger than the caches; bits are the same.

    Parameters
    ----------
    w_tilde : WTilde
        W of the P image pixels.
    border : array (P, k)
        T: what the marginalised amplitudes take away.
    lensings : sequence of LensingMatrix
        The L of each lens, all onto grids of the same size.
    out : sequence of arrays (n, n), optional
        C-ordered memory for each result.
    """
    if not lensings:
        return []
    n = lensings[0].grid.x.size * lensings[0].grid.y.size
    halves = _half_curvature(w_tilde.start, w_tilde.row_patch, w_tilde.blocks, *_gather_all(w_tilde, lensings, n), n)
    found = []
    for k, lensing in enumerate(lensings):
        memory = np.empty((n, n)) if out is None else out[k]
        _join(halves[k], memory)
        # Seen in Fortran order, the upper triangle is the lower one, which LAPACK factorises fastest.
        f = memory.T
        if border.shape[1]:
            spread = _spread(lensing.columns, lensing.weights, lensing.entries, border, n)
            f = blas.dsyrk(-1.0, spread.T, beta=1.0, c=f, lower=1, overwrite_c=1)
        found.append(np.asarray(f))
    return found


def curvature_matrix(w_tilde: WTilde, border: FloatArray, lensing: LensingMatrix) -> FloatArray:
    """F of one L, as :func:`curvature_matrices` has it."""
    return curvature_matrices(w_tilde, border, [lensing])[0]
