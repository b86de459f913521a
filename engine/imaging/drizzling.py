"""Combining dithered exposures with the maintained ``drizzle`` package, and its weights as a matrix.

Drizzling is linear in the exposures (Fruchter & Hook 2002, eqs. 4 and 5): image = W exposures, with every row
of W a weighted mean. W is taken from the package itself by drizzling impulses; with it the noise map is (W o
W) v and the covariance W diag(v) W^T.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from drizzle.resample import Drizzle
from scipy import sparse

from engine.conventions import FloatArray
from engine.errors import ObservationError
from engine.imaging.geometry import Geometry


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


def drizzle(exposures: FloatArray, geometry: Geometry, weights: FloatArray | None = None) -> FloatArray:
    """Drizzle exposures onto the output grid, by the package in its single precision.

    Parameters
    ----------
    exposures
        (n_dither, ny, nx) flux per native pixel.
    weights
        Weight maps of the same shape; equal weights where None.

    Returns
    -------
    geometry.drizzled_shape, flux per drizzled pixel; NaN where no droplet falls.
    """
    _check_exposures(exposures, geometry)
    if weights is not None and weights.shape != exposures.shape:
        raise ObservationError(f"drizzle weights: got shape {weights.shape}, allowed is {exposures.shape}")
    total = Drizzle(kernel=geometry.kernel, out_shape=geometry.drizzled_shape, disable_ctx=True)
    for index, exposure in enumerate(exposures):
        _add(total, exposure, geometry, index, None if weights is None else weights[index])
    return np.asarray(total.out_img, dtype=np.float64)


def _check_exposures(exposures: FloatArray, geometry: Geometry) -> None:
    allowed = (geometry.n_dither, *geometry.native_shape)
    if exposures.shape != allowed:
        raise ObservationError(f"exposures: got shape {exposures.shape}, allowed is {allowed}")


@lru_cache(maxsize=16)
def drizzle_weights(geometry: Geometry) -> sparse.csr_matrix:
    """Return the matrix W of the drizzle with equal exposure weights: image = W @ exposures.ravel().

    Shape (n_drizzled, n_dither * n_native), rows and columns in row-major order. Found by drizzling combs of
    impulses so far apart that their footprints cannot touch; for each exposure apart, then put together as
    the package does, by the weights it reports. Exact to the package's single precision. Kept in memory; not
    to be changed.
    """
    step = _comb_step(geometry)
    weight_sum = np.zeros(geometry.drizzled_shape)
    rows, columns, values = [], [], []
    n_native = math.prod(geometry.native_shape)
    for index in range(geometry.n_dither):
        nearest = [_nearest(axis, geometry, index, step) for axis in (0, 1)]
        for j, i in np.ndindex(step, step):
            comb = np.zeros(geometry.native_shape)
            comb[j::step, i::step] = 1.0
            one = Drizzle(kernel=geometry.kernel, out_shape=geometry.drizzled_shape, disable_ctx=True, fillval=0.0)
            _add(one, comb, geometry, index, None)
            weight = np.asarray(one.out_wht, dtype=np.float64)
            product = np.asarray(one.out_img, dtype=np.float64) * weight
            row, column = np.nonzero(product)
            rows.append(np.ravel_multi_index((row, column), geometry.drizzled_shape))
            source = nearest[0][i][column] + geometry.native_shape[1] * nearest[1][j][row]
            columns.append(index * n_native + source)
            values.append(product[row, column])
        weight_sum += weight  # every comb of an exposure reports the same weights
    matrix = sparse.coo_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))),
        shape=(math.prod(geometry.drizzled_shape), geometry.n_dither * n_native),
    ).tocsr()
    if not (weight_sum > 0).all():
        raise ObservationError("geometry: some drizzled pixels lie under no droplet of any exposure")
    matrix.data /= np.repeat(weight_sum.ravel(), np.diff(matrix.indptr))
    matrix.data.setflags(write=False)
    return matrix


def _comb_step(geometry: Geometry) -> int:
    """Distance in native pixels at which the footprints of two impulses share no drizzled pixel.

    A droplet is pixfrac wide (the Gaussian kernel is cut at 2.5 sigma, 2.2 pixfrac) and reaches every
    drizzled pixel that it touches, or at least the nearest one.
    """
    return math.ceil(2.2 * geometry.pixfrac + geometry.drizzle_ratio) + 1


def _nearest(axis: int, geometry: Geometry, index: int, step: int) -> list[np.ndarray[tuple[int], np.dtype[np.intp]]]:
    """Find, for each phase of the comb, the native index of the tooth nearest to every drizzled pixel.

    Axis 0 is x.
    """
    native, drizzled = geometry.native_axes(index)[axis], geometry.drizzled_axes()[axis]
    n = len(native)
    position = (drizzled - native[0]) / geometry.pixel_scale
    result = []
    for phase in range(step):
        teeth = (n - 1 - phase) // step
        tooth = np.clip(np.rint((position - phase) / step), 0, max(teeth, 0))
        result.append((phase + step * tooth).astype(np.intp))
    return result


def drizzled_variance(variance: FloatArray, geometry: Geometry) -> FloatArray:
    """Variance of every drizzled pixel, of geometry.drizzled_shape, from that of the exposures: (W o W) v."""
    _check_exposures(variance, geometry)
    weights = drizzle_weights(geometry)
    squared = sparse.csr_matrix((weights.data**2, weights.indices, weights.indptr), shape=weights.shape)
    return np.asarray(squared @ variance.ravel()).reshape(geometry.drizzled_shape)


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
