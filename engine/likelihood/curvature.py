"""The curvature matrix F = L^T (B^T C^-1 B - T T^T) L of a lens from the blocks of W (:mod:`.w_tilde`)."""

from __future__ import annotations

import threading
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas

from engine.compiled import contracted_kernel
from engine.conventions import FloatArray
from engine.likelihood.w_tilde import TILE, IndexArray, WTilde
from engine.source.lensing_matrix import LensingMatrix

CHUNK = 64
"""Source pixels that the second product works on at once."""

_CACHE = 640 * 1024
"""Bytes of the second-level cache that L^T V of one patch may take, of all lenses that share a pass over W."""


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
