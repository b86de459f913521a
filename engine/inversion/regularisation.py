"""Regularisation of the source: quadratic forms s^T H s that are full rank by construction.

In one dimension D_1 is the difference of neighbours with a zero beyond both ends, and D_2 the second difference with
zeros beyond both ends: the source is pulled to zero outside the grid, which makes each ``D^T D`` positive definite. On
an even grid

    H = 1 x D_k^T D_k + D_k^T D_k x 1          (k = 1 gradient, 2 curvature; the identity for k = 0),

a Kronecker sum, so that ln|H| follows from the one-dimensional spectra, which are known in closed form.

Where the nodes crowd round the AGN, cells off the centre are thin: differences from node to node alone would leave the
source free to vary across them, in stripes. There each squared k-th derivative is integrated over the source plane with
a weight h^(2k-2), h being the longer side of the cell: the same structure costs the same in every direction, and the
source may change on the scale of the grid. With sides h_x, h_y the row of D_k along x gets the weight

    (h_x h_y / h^2) (h / h_x)^(2k),

which is one on an even grid. The sides are those of the nominal grid, centred and with cells of one on average: H does
not depend on the lens, and its determinant is computed once. A change of the grid's size with the lens parameters only
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
from engine.inversion.nodes import spaced_nodes
from engine.spec import RegularisationName

_ORDER: dict[RegularisationName, int] = {"zeroth": 0, "gradient": 1, "curvature": 2}


@dataclass(frozen=True)
class SourceModel:
    """How the source is described: (ny, nx) nodes, the regularisation, and the crowding of the nodes (None: even)."""

    shape: tuple[int, int] = (30, 30)
    regularisation: RegularisationName = "curvature"
    softening: float | None = None


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


def _sides(order: int, n: int, softening: float | None) -> tuple[FloatArray, FloatArray]:
    """Sides of the nominal cells at the nodes (n,), and at the rows of D_k along the same axis."""
    half = 0.5 * (n - 1)
    nodes = spaced_nodes(-half, half, n, 0.0, softening)
    at_nodes = np.gradient(nodes)
    if order == 2:
        return at_nodes, at_nodes
    steps = np.diff(nodes)
    return at_nodes, np.concatenate([steps[:1], steps, steps[-1:]])


def _row_weights(order: int, along: FloatArray, across: FloatArray) -> FloatArray:
    """Weights of the rows of D_k for cells of side ``along`` the difference and ``across`` it."""
    longer = np.maximum(along, across)
    return np.asarray(along * across / longer**2 * (longer / along) ** (2 * order))


@cache
def regularisation_matrix(model: SourceModel) -> FloatArray:
    """H as a dense read-only array of shape (ny nx, ny nx), for source pixels in row-major order."""
    ny, nx = model.shape
    order = _ORDER[model.regularisation]
    if order == 0:
        h = np.eye(ny * nx)
    else:
        node_x, row_x = _sides(order, nx, model.softening)
        node_y, row_y = _sides(order, ny, model.softening)
        along_x = sparse.kron(sparse.identity(ny), _differences(order, nx))
        along_y = sparse.kron(_differences(order, ny), sparse.identity(nx))
        weights_x = _row_weights(order, row_x[None, :], node_y[:, None]).ravel()
        weights_y = _row_weights(order, row_y[:, None], node_x[None, :]).ravel()
        h = (along_x.T @ sparse.diags(weights_x) @ along_x + along_y.T @ sparse.diags(weights_y) @ along_y).toarray()
    h.setflags(write=False)
    return h


@cache
def _lower_entries(model: SourceModel) -> tuple[NDArray[np.intp], NDArray[np.intp], FloatArray]:
    """Row, column and value of the nonzero entries of H in its lower triangle."""
    h = regularisation_matrix(model)
    rows, columns = np.nonzero(np.tril(h))
    return rows, columns, h[rows, columns].copy()


def add_regularisation(matrix: FloatArray, model: SourceModel, strength: float) -> None:
    """Add ``strength`` H to the lower triangle of ``matrix`` in place."""
    rows, columns, values = _lower_entries(model)
    matrix[rows, columns] += strength * values


@cache
def ln_determinant(model: SourceModel) -> float:
    """ln|H|: from the one-dimensional spectra on an even grid, by one Cholesky factorisation on another."""
    ny, nx = model.shape
    order = _ORDER[model.regularisation]
    if order == 0:
        return 0.0
    if model.softening is None:
        return float(np.log(_spectrum(order, nx)[None, :] + _spectrum(order, ny)[:, None]).sum())
    return 2.0 * float(np.log(np.diag(np.linalg.cholesky(regularisation_matrix(model)))).sum())
