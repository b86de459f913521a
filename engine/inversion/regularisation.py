"""Regularisation of the source: quadratic forms s^T H s that are full rank by construction.

In one dimension D_1 is the difference of neighbours with a zero beyond both ends, and D_2 the second difference with
zeros beyond both ends: the source is pulled to zero outside the grid, which makes each ``D^T D`` positive definite. In
two dimensions

    H = 1 x D_k^T D_k + D_k^T D_k x 1          (k = 1 gradient, 2 curvature; the identity for k = 0),

a Kronecker sum, so that ln|H| follows from the one-dimensional spectra, which are known in closed form. Differences are
taken from node to node: where the grid is finer the source may change faster. A change of the grid's size with the lens
parameters only rescales lambda, which is free.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from engine.conventions import FloatArray
from engine.spec import RegularisationName

_ORDER: dict[RegularisationName, int] = {"zeroth": 0, "gradient": 1, "curvature": 2}


def _one_dimensional(order: int, n: int) -> sparse.csr_matrix:
    """D_k^T D_k of n points as a sparse matrix."""
    if order == 1:
        # n + 1 differences of (0, s_1 .. s_n, 0): their sum of squares is the tridiagonal matrix (-1, 2, -1).
        return sparse.diags([-1.0, 2.0, -1.0], [-1, 0, 1], shape=(n, n), format="csr")
    second = sparse.diags([1.0, -2.0, 1.0], [-1, 0, 1], shape=(n, n), format="csr")
    return (second.T @ second).tocsr()


@cache
def _spectrum(order: int, n: int) -> FloatArray:
    """Eigenvalues of D_k^T D_k: those of the tridiagonal (-1, 2, -1) matrix, 4 sin^2(pi j / (2 n + 2)), to the k."""
    j = np.arange(1, n + 1)
    return np.asarray((4.0 * np.sin(0.5 * math.pi * j / (n + 1)) ** 2) ** order)


@cache
def regularisation_matrix(name: RegularisationName, shape: tuple[int, int]) -> FloatArray:
    """H as a dense read-only array of shape (ny nx, ny nx), for source pixels in row-major order."""
    ny, nx = shape
    order = _ORDER[name]
    if order == 0:
        h = np.eye(ny * nx)
    else:
        h = (
            sparse.kron(sparse.identity(ny), _one_dimensional(order, nx))
            + sparse.kron(_one_dimensional(order, ny), sparse.identity(nx))
        ).toarray()
    h.setflags(write=False)
    return h


@cache
def _lower_entries(
    name: RegularisationName, shape: tuple[int, int]
) -> tuple[NDArray[np.intp], NDArray[np.intp], FloatArray]:
    """Row, column and value of the nonzero entries of H in its lower triangle."""
    h = regularisation_matrix(name, shape)
    rows, columns = np.nonzero(np.tril(h))
    return rows, columns, h[rows, columns].copy()


def add_regularisation(matrix: FloatArray, name: RegularisationName, shape: tuple[int, int], strength: float) -> None:
    """Add ``strength`` H to the lower triangle of ``matrix`` in place."""
    rows, columns, values = _lower_entries(name, shape)
    matrix[rows, columns] += strength * values


@cache
def ln_determinant(name: RegularisationName, shape: tuple[int, int]) -> float:
    """ln|H| from the one-dimensional spectra."""
    ny, nx = shape
    order = _ORDER[name]
    if order == 0:
        return 0.0
    return float(np.log(_spectrum(order, nx)[None, :] + _spectrum(order, ny)[:, None]).sum())
