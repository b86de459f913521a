"""Regularisation of the source: quadratic forms s^T H s that are full rank by construction.

In one dimension D_0 is the identity, D_1 the backward difference with a zero before the grid and one after it, and
D_2 the second difference with zeros beyond both ends: the source is pulled to zero outside the grid, which makes each
``D^T D`` positive definite. In two dimensions

    H = dx dy [ dx^(-2k) (1 x D_k^T D_k) + dy^(-2k) (D_k^T D_k x 1) ]

for order k = 1, 2 (dx dy times the identity for k = 0): the integral of the squared k-th derivatives over the source
plane. lambda thus means the same whatever the size of the grid, which follows the lens parameters. H is a Kronecker
sum, so ln|H| follows from the one-dimensional spectra, which are known in closed form.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
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
def _parts(name: RegularisationName, ny: int, nx: int) -> tuple[FloatArray, FloatArray]:
    """The dense x and y parts of H (dx = dy = 1), each of shape (ny nx, ny nx)."""
    order = _ORDER[name]
    if order == 0:
        return np.eye(ny * nx), np.zeros((ny * nx, ny * nx))
    along_x = sparse.kron(sparse.identity(ny), _one_dimensional(order, nx)).toarray()
    along_y = sparse.kron(_one_dimensional(order, ny), sparse.identity(nx)).toarray()
    along_x.setflags(write=False)
    along_y.setflags(write=False)
    return along_x, along_y


@cache
def _band_entries(name: RegularisationName, ny: int, nx: int) -> tuple[np.ndarray, np.ndarray, FloatArray, FloatArray]:
    """Row, column and both parts' values of the nonzero entries of H in its lower triangle."""
    along_x, along_y = _parts(name, ny, nx)
    rows, columns = np.nonzero(np.tril((along_x != 0) | (along_y != 0)))
    return rows, columns, along_x[rows, columns].copy(), along_y[rows, columns].copy()


def _weights(name: RegularisationName, dx: float, dy: float) -> tuple[float, float]:
    order = _ORDER[name]
    return dx * dy * dx ** (-2 * order), dx * dy * dy ** (-2 * order)


def regularisation_matrix(name: RegularisationName, shape: tuple[int, int], dx: float, dy: float) -> FloatArray:
    """H as a dense array of shape (ny nx, ny nx), for source pixels in row-major order."""
    along_x, along_y = _parts(name, *shape)
    wx, wy = _weights(name, dx, dy)
    return wx * along_x + wy * along_y


def add_regularisation(
    matrix: FloatArray, name: RegularisationName, shape: tuple[int, int], dx: float, dy: float, strength: float
) -> None:
    """Add ``strength`` H to the lower triangle of ``matrix`` in place."""
    rows, columns, along_x, along_y = _band_entries(name, *shape)
    wx, wy = _weights(name, dx, dy)
    matrix[rows, columns] += strength * (wx * along_x + wy * along_y)


def ln_determinant(name: RegularisationName, shape: tuple[int, int], dx: float, dy: float) -> float:
    """ln|H| from the one-dimensional spectra."""
    ny, nx = shape
    order = _ORDER[name]
    wx, wy = _weights(name, dx, dy)
    if order == 0:
        return ny * nx * math.log(wx)
    return float(np.log(wx * _spectrum(order, nx)[None, :] + wy * _spectrum(order, ny)[:, None]).sum())
