"""Combining dithered exposures with the maintained ``drizzle`` package, and its weights as a matrix.

Drizzling is linear in the exposures (Fruchter & Hook 2002, eqs. 4 and 5): image = W exposures, with every row
of W a weighted mean. W is taken from the package itself by drizzling impulses; with it the noise map is (W o
W) v and the covariance W diag(v) W^T.

With equal weights the droplets of F160W's dithers fall unevenly on the drizzled pixels (their ratio is 0.615), and a
star gains or loses up to 0.3 % of its flux, depending on where it stands. The exposures therefore carry weight maps
under which every native pixel hands on the same share of its light; they stay within 12 % of equal and cost 0.15 %
in variance.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from drizzle.resample import Drizzle
from numpy.typing import NDArray
from scipy import sparse

from engine.conventions import FloatArray
from engine.errors import ObservationError
from engine.imaging.geometry import Geometry

_BALANCING_STEPS = 200
_EVENNESS = 1e-4


def pixel_map(geometry: Geometry, index: int) -> FloatArray:
    """(ny, nx, 2) drizzled pixel coordinates (x, y) of the native pixel centres of exposure ``index``."""
    x, y = geometry.native_axes(index)
    ny, nx = geometry.drizzled_shape
    columns = x / geometry.drizzled_scale + (nx - 1) / 2
    rows = y / geometry.drizzled_scale + (ny - 1) / 2
    return np.stack(np.broadcast_arrays(columns[np.newaxis, :], rows[:, np.newaxis]), axis=-1).astype(np.float64)


def _add(sum_: Drizzle, exposure: FloatArray, geometry: Geometry, index: int, weight: FloatArray | None) -> None:
    sum_.add_image(
        exposure,
        exptime=1.0,
        pixmap=pixel_map(geometry, index),
        # The package averages surface brightness; the ratio of areas turns flux per native pixel into flux
        # per drizzled pixel.
        iscale=geometry.drizzle_ratio**2,
        pixel_scale_ratio=geometry.drizzle_ratio,
        weight_map=weight,
        pixfrac=geometry.pixfrac,
        in_units="cps",
    )


def drizzle(exposures: FloatArray, geometry: Geometry, *, balanced: bool = True) -> FloatArray:
    """Drizzle exposures onto the output grid, by the package in its single precision.

    Parameters
    ----------
    exposures
        (n_dither, ny, nx) flux per native pixel.
    balanced
        With :func:`even_weights`, or with equal ones.

    Returns
    -------
    geometry.drizzled_shape, flux per drizzled pixel; NaN where no droplet falls.
    """
    _check_exposures(exposures, geometry)
    maps = even_weights(geometry) if balanced else [None] * geometry.n_dither
    total = Drizzle(kernel=geometry.kernel, out_shape=geometry.drizzled_shape, disable_ctx=True)
    for index, exposure in enumerate(exposures):
        _add(total, exposure, geometry, index, maps[index])
    return np.asarray(total.out_img, dtype=np.float64)


def _check_exposures(exposures: FloatArray, geometry: Geometry) -> None:
    allowed = (geometry.n_dither, *geometry.native_shape)
    if exposures.shape != allowed:
        raise ObservationError(f"exposures: got shape {exposures.shape}, allowed is {allowed}")


@lru_cache(maxsize=16)
def even_weights(geometry: Geometry) -> FloatArray:
    """Weight maps (n_dither, ny, nx) under which each native pixel well inside the image keeps its flux.

    Found by balancing W in the manner of Sinkhorn: its rows are weighted means whatever the weights, and the weights
    are divided by what their pixels gain until none gains more than 1e-4. Read-only; kept in memory.
    """
    equal = _equal_weight_matrix(geometry)
    inside = np.stack([_well_inside(geometry, index) for index in range(geometry.n_dither)])
    weights = np.ones(inside.shape)
    flat, chosen = weights.reshape(-1), inside.ravel()
    rows = np.asarray(equal.sum(axis=1)).ravel()
    transposed = equal.T.tocsr()
    for _ in range(_BALANCING_STEPS):
        gain = geometry.n_dither * flat * (transposed @ (rows / (equal @ flat)))
        if not chosen.any() or np.abs(gain[chosen] - 1.0).max() < _EVENNESS:
            break
        flat[chosen] /= gain[chosen]
    weights.setflags(write=False)
    return weights


def _well_inside(geometry: Geometry, index: int) -> NDArray[np.bool_]:
    """Native pixels of an exposure whose droplets fall on the drizzled image entirely."""
    x, y = geometry.native_axes(index)
    half_y, half_x = (0.5 * (n - 1) * geometry.drizzled_scale - geometry.pixel_scale for n in geometry.drizzled_shape)
    return np.asarray((np.abs(y) < half_y)[:, None] & (np.abs(x) < half_x)[None, :])


@lru_cache(maxsize=16)
def drizzle_weights(geometry: Geometry) -> sparse.csr_matrix:
    """Return the matrix W of the drizzle with even weights: image = W @ exposures.ravel().

    Shape (n_drizzled, n_dither * n_native), rows and columns in row-major order. Exact to the package's single
    precision. Kept in memory; not to be changed.
    """
    equal = _equal_weight_matrix(geometry)
    weighted = equal @ sparse.diags(even_weights(geometry).ravel(), format="csr")
    scale = np.asarray(equal.sum(axis=1)).ravel() / np.asarray(weighted.sum(axis=1)).ravel()
    matrix = (sparse.diags(scale, format="csr") @ weighted).tocsr()
    matrix.data.setflags(write=False)
    return matrix


@lru_cache(maxsize=16)
def _equal_weight_matrix(geometry: Geometry) -> sparse.csr_matrix:
    """W with equal weights.

    Found by drizzling images of single bright pixels, so far apart that no two reach the same drizzled pixel; each
    exposure by itself, then put together as the package does, by the weights it reports.
    """
    step = _impulse_spacing(geometry)
    weight_sum = np.zeros(geometry.drizzled_shape)
    rows, columns, values = [], [], []
    n_native = math.prod(geometry.native_shape)
    for index in range(geometry.n_dither):
        nearest = [_nearest(axis, geometry, index, step) for axis in (0, 1)]
        for j, i in np.ndindex(step, step):
            impulses = np.zeros(geometry.native_shape)
            impulses[j::step, i::step] = 1.0
            one = Drizzle(kernel=geometry.kernel, out_shape=geometry.drizzled_shape, disable_ctx=True, fillval=0.0)
            _add(one, impulses, geometry, index, None)
            weight = np.asarray(one.out_wht, dtype=np.float64)
            product = np.asarray(one.out_img, dtype=np.float64) * weight
            row, column = np.nonzero(product)
            rows.append(np.ravel_multi_index((row, column), geometry.drizzled_shape))
            source = nearest[0][i][column] + geometry.native_shape[1] * nearest[1][j][row]
            columns.append(index * n_native + source)
            values.append(product[row, column])
        weight_sum += weight  # every image of an exposure reports the same weights
    matrix = sparse.coo_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))),
        shape=(math.prod(geometry.drizzled_shape), geometry.n_dither * n_native),
    ).tocsr()
    if not (weight_sum > 0).all():
        raise ObservationError("geometry: some drizzled pixels lie under no droplet of any exposure")
    matrix.data /= np.repeat(weight_sum.ravel(), np.diff(matrix.indptr))
    matrix.data.setflags(write=False)
    return matrix


def _impulse_spacing(geometry: Geometry) -> int:
    """Distance in native pixels at which the footprints of two impulses share no drizzled pixel.

    A droplet is pixfrac wide and reaches every drizzled pixel that it touches, or at least the nearest one.
    """
    return math.ceil(2.2 * geometry.pixfrac + geometry.drizzle_ratio) + 1


def _nearest(axis: int, geometry: Geometry, index: int, step: int) -> list[np.ndarray[tuple[int], np.dtype[np.intp]]]:
    """Native index of the impulse nearest to every drizzled pixel, for each place of the first; axis 0 is x."""
    native, drizzled = geometry.native_axes(index)[axis], geometry.drizzled_axes()[axis]
    n = len(native)
    position = (drizzled - native[0]) / geometry.pixel_scale
    result = []
    for phase in range(step):
        last = (n - 1 - phase) // step
        impulse = np.clip(np.rint((position - phase) / step), 0, max(last, 0))
        result.append((phase + step * impulse).astype(np.intp))
    return result


def drizzled_covariance(variance: FloatArray, geometry: Geometry) -> sparse.csr_matrix:
    """Covariance W diag(v) W^T of the drizzled pixels in row-major order, sparse and exactly symmetric."""
    _check_exposures(variance, geometry)
    weights = drizzle_weights(geometry)
    # With the square root on either side, W diag(v) W^T is a product with its own transpose: symmetric to the
    # bit.
    root = weights @ sparse.diags(np.sqrt(variance.ravel()), format="csr")
    covariance = (root @ root.T).tocsr()
    covariance.sort_indices()
    return covariance
