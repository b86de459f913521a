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

which is one on an even grid.

The fourth regularisation is a Gaussian process with the Matern covariance of order one,
``k(r) ~ (sqrt(2) r / l) K_1(sqrt(2) r / l)``, l in cells. In the plane its precision is the square of the differential
operator kappa^2 - Laplacian with kappa^2 = 2 / l^2 (Whittle 1954; Lindgren, Rue & Lindstroem 2011, eq. 2), so that on
an even grid

    H = K^T K,    K = kappa^2 + 1 x D_1^T D_1 + D_1^T D_1 x 1,

sparse, and positive definite because K is diagonally dominant. It tends to gradient terms squared (a bending energy)
for l much above the grid and to the identity for l much below a cell. Its zeros beyond the ends are those of the other
three. On uneven nodes each second derivative is taken in units of h and each row of K weighted by h_x h_y / h^2: l is
then measured in cells of the place, and the source may change faster where the nodes are closer.

The sides are those of the nominal grid, centred and with cells of one on average: H does
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
from engine.errors import SpecError
from engine.inversion.nodes import spaced_nodes
from engine.spec import RegularisationName

_ORDER: dict[RegularisationName, int] = {"gradient": 1, "curvature": 2}


@dataclass(frozen=True)
class SourceModel:
    """How the source is described.

    ``shape`` (ny, nx) nodes, the ``regularisation``, the crowding ``softening`` of the nodes (None: even), and the
    correlation ``length`` [cells] of the Matern covariance, which the other regularisations do not have.
    """

    shape: tuple[int, int] = (30, 30)
    regularisation: RegularisationName = "curvature"
    softening: float | None = None
    length: float = 3.0

    def __post_init__(self) -> None:
        """Refuse a length without meaning."""
        if not (self.length > 0 and math.isfinite(self.length)):
            raise SpecError("length", self.length, "a positive number of cells")


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


def _matern_root(model: SourceModel) -> sparse.csr_matrix:
    """sqrt(weights) K of the Matern precision H = K^T weights K."""
    ny, nx = model.shape
    x, y = _sides(2, nx, model.softening)[0][None, :], _sides(2, ny, model.softening)[0][:, None]
    longer = np.maximum(x, y)
    second_x = sparse.kron(sparse.identity(ny), _differences(2, nx))
    second_y = sparse.kron(_differences(2, ny), sparse.identity(nx))
    k = 2.0 / model.length**2 * sparse.identity(ny * nx)
    k = k - sparse.diags(((longer / x) ** 2).ravel()) @ second_x - sparse.diags(((longer / y) ** 2).ravel()) @ second_y
    return (sparse.diags(np.sqrt(x * y / longer**2).ravel()) @ k).tocsr()


def _difference_root(model: SourceModel, order: int) -> sparse.csr_matrix:
    """The weighted differences along x and along y, stacked."""
    ny, nx = model.shape
    node_x, row_x = _sides(order, nx, model.softening)
    node_y, row_y = _sides(order, ny, model.softening)
    along_x = sparse.kron(sparse.identity(ny), _differences(order, nx))
    along_y = sparse.kron(_differences(order, ny), sparse.identity(nx))
    weights_x = _row_weights(order, row_x[None, :], node_y[:, None]).ravel()
    weights_y = _row_weights(order, row_y[:, None], node_x[None, :]).ravel()
    return sparse.vstack(
        [sparse.diags(np.sqrt(weights_x)) @ along_x, sparse.diags(np.sqrt(weights_y)) @ along_y], format="csr"
    )


@cache
def sparse_regularisation(model: SourceModel) -> sparse.csr_matrix:
    """H as a sparse matrix (ny nx, ny nx), for source pixels in row-major order; not to be changed."""
    if model.regularisation == "matern":
        root = _matern_root(model)
    elif model.regularisation == "zeroth":
        root = sparse.identity(model.shape[0] * model.shape[1], format="csr")
    else:
        root = _difference_root(model, _ORDER[model.regularisation])
    h = (root.T @ root).tocsr()
    h.data.setflags(write=False)
    return h


@cache
def regularisation_matrix(model: SourceModel) -> FloatArray:
    """H as a dense read-only array of shape (ny nx, ny nx), for source pixels in row-major order."""
    h = np.asarray(sparse_regularisation(model).toarray())
    h.setflags(write=False)
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
    """ln|H|: from the one-dimensional spectra on an even grid, by one Cholesky factorisation on another."""
    if model.regularisation == "zeroth":
        return 0.0
    ny, nx = model.shape
    if model.softening is None and model.regularisation == "matern":
        sums = _spectrum(1, nx)[None, :] + _spectrum(1, ny)[:, None]
        return 2.0 * float(np.log(2.0 / model.length**2 + sums).sum())
    if model.softening is None:
        order = _ORDER[model.regularisation]
        return float(np.log(_spectrum(order, nx)[None, :] + _spectrum(order, ny)[:, None]).sum())
    return 2.0 * float(np.log(np.diag(np.linalg.cholesky(regularisation_matrix(model)))).sum())
