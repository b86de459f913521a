"""Regularisation of the source: quadratic forms s^T H s that are full rank by construction.

In one dimension D_1 is the difference of neighbours with a zero beyond both ends, and D_2 the second difference with
zeros beyond both ends: the source is pulled to zero outside the grid, which makes each ``D^T D`` positive definite. On
an even grid

    H = 1 x D_k^T D_k + D_k^T D_k x 1          (k = 1 gradient, 2 curvature; the identity for k = 0),

a Kronecker sum, so that ln|H| follows from the one-dimensional spectra, which are known in closed form.

H does not depend on the lens, and its determinant is computed once: a change of the grid's size with the lens only
rescales lambda, which is free.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from engine.conventions import FloatArray
from engine.spec.analysis import RegularisationName

_ORDER: dict[RegularisationName, int] = {"gradient": 1, "curvature": 2}


@dataclass(frozen=True)
class SourceModel:
    """How the source is described: ``shape`` (ny, nx) nodes and the ``regularisation``."""

    shape: tuple[int, int] = (30, 30)
    regularisation: RegularisationName = "curvature"


def _differences(order: int, n: int) -> sparse.csr_matrix:
    """D_k of n points with zeros beyond both ends: (n + 1, n) for k = 1, (n, n) for k = 2."""
    if order == 1:
        return sparse.diags([1.0, -1.0], [0, -1], shape=(n + 1, n), format="csr")
    return sparse.diags([1.0, -2.0, 1.0], [-1, 0, 1], shape=(n, n), format="csr")


@cache
def _spectrum(order: int, n: int) -> FloatArray:
    """Eigenvalues of D_k^T D_k: those of the tridiagonal (-1, 2, -1) matrix, 4 sin^2(pi j / (2 n + 2)), to the k."""
    j = np.arange(1, n + 1)
    return np.asarray((4.0 * np.sin(0.5 * math.pi * j / (n + 1)) ** 2) ** order)


def _difference_root(model: SourceModel, order: int) -> sparse.csr_matrix:
    """The differences along x and along y, stacked."""
    ny, nx = model.shape
    along_x = sparse.kron(sparse.identity(ny), _differences(order, nx))
    along_y = sparse.kron(_differences(order, ny), sparse.identity(nx))
    return sparse.vstack([along_x, along_y], format="csr")


@cache
def sparse_regularisation(model: SourceModel) -> sparse.csr_matrix:
    """H as a sparse matrix (ny nx, ny nx), for source pixels in row-major order; not to be changed."""
    if model.regularisation == "zeroth":
        root = sparse.identity(model.shape[0] * model.shape[1], format="csr")
    else:
        root = _difference_root(model, _ORDER[model.regularisation])
    h = (root.T @ root).tocsr()
    h.data.setflags(write=False)
    return h


@cache
def _lower_entries(model: SourceModel) -> tuple[NDArray[np.intp], NDArray[np.intp], FloatArray]:
    """Row, column and value of the nonzero entries of H in its lower triangle."""
    lower = sparse.tril(sparse_regularisation(model), format="coo")
    return lower.row.astype(np.intp), lower.col.astype(np.intp), lower.data.copy()


def add_regularisation(matrix: FloatArray, model: SourceModel, strength: float) -> None:
    """Add ``strength`` H to the lower triangle of ``matrix`` in place."""
    rows, columns, values = _lower_entries(model)
    matrix[rows, columns] += strength * values


@cache
def ln_determinant(model: SourceModel) -> float:
    """ln|H|, from the one-dimensional spectra."""
    if model.regularisation == "zeroth":
        return 0.0
    ny, nx = model.shape
    order = _ORDER[model.regularisation]
    return float(np.log(_spectrum(order, nx)[None, :] + _spectrum(order, ny)[:, None]).sum())
