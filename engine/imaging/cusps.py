"""Light that varies within a sub-pixel, put where it is.

The flux of a sub-pixel, convolved with the PSF, stands at the sub-pixel's centre. Round the cusp of a Sersic profile
that is wrong: exposures of an F160W host of n = 4 and R_eff = 0.3 (0.05) arcsec differ by 6e-3 (1.6e-2) of their peak
from what finer sub-pixels give, and with this by 2e-4 (4e-4). There the light is rendered on cells a few times finer,
and each is given to its neighbouring sub-pixels by the weights that interpolate the PSF to its place. The PSF being
band-limited, its convolution with what results is that with the light itself.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from engine.conventions import FloatArray
from engine.imaging.geometry import Geometry
from engine.lensing.lens_equation import makes_ring, solve_lens_equation
from engine.lensing.power_law import PowerLawLens
from engine.light.rendering import render_sersic
from engine.light.sersic import SersicProfile

_FINE = 5
"""Cells along a sub-pixel."""
_HALF = 12
"""Radius round a cusp within which light is moved [sub-pixels]: beyond it the light is smooth on their scale."""
_ON_RING = 10
"""Distance of points on a ring [sub-pixels]: between two of them more than eight tenths of its light are moved."""
_NODES = 8
"""Sub-pixels along each axis among which a cell's light is divided: Lagrange interpolation of order 7."""


def cusp_positions(profile: SersicProfile, lens: PowerLawLens | None, geometry: Geometry) -> list[tuple[float, float]]:
    """Where the cusp of a profile is seen [arcsec]; of a ring, points that lie within each other's reach."""
    if lens is None:
        return [(profile.x, profile.y)]
    if not makes_ring(lens, profile.x, profile.y):
        return [(image.x, image.y) for image in solve_lens_equation(lens, profile.x, profile.y)]
    number = math.ceil(2.0 * math.pi * lens.theta_E / (_ON_RING * geometry.subpixel_scale))
    angles = 2.0 * math.pi / number * np.arange(number)
    return [(lens.x + lens.theta_E * math.cos(t), lens.y + lens.theta_E * math.sin(t)) for t in angles]


def place_cusps(
    image: FloatArray,
    profile: SersicProfile,
    positions: list[tuple[float, float]],
    geometry: Geometry,
    lens: PowerLawLens | None = None,
) -> FloatArray:
    """Replace the light round the cusps of a rendered profile by light that convolves as if nothing were pixelised.

    Parameters
    ----------
    image
        geometry.high_resolution_shape, flux per sub-pixel of ``profile`` behind ``lens``.
    positions
        Where the cusps are in the image [arcsec].

    Returns
    -------
    Array of the same shape and total flux, for convolution with a PSF that is band-limited well below the sub-pixels;
    single values round the cusps may be negative.
    """
    x, y = geometry.high_resolution_axes()
    scale, reach = geometry.subpixel_scale, _NODES // 2
    placed = np.pad(image, reach)
    offsets = ((np.arange(_FINE) + 0.5) / _FINE - 0.5) * scale
    for index, (cusp_x, cusp_y) in enumerate(positions):
        column, row = round((cusp_x - x[0]) / scale), round((cusp_y - y[0]) / scale)
        rows = slice(max(row - _HALF, 0), min(row + _HALF + 1, y.size))
        columns = slice(max(column - _HALF, 0), min(column + _HALF + 1, x.size))
        if rows.start >= rows.stop or columns.start >= columns.stop:
            continue
        cells_x, cells_y = np.add.outer(x[columns], offsets).ravel(), np.add.outer(y[rows], offsets).ravel()
        light = render_sersic(profile, cells_x, cells_y, scale / _FINE, lens)
        # What the blocks before this one have moved already stays moved.
        light *= _taper(np.hypot(cells_x - cusp_x, cells_y[:, None] - cusp_y) / (_HALF * scale))
        for other_x, other_y in positions[:index]:
            light *= 1.0 - _taper(np.hypot(cells_x - other_x, cells_y[:, None] - other_y) / (_HALF * scale))
        ny, nx = rows.stop - rows.start, columns.stop - columns.start
        placed[reach:-reach, reach:-reach][rows, columns] -= light.reshape(ny, _FINE, nx, _FINE).sum(axis=(1, 3))
        placed[rows.start : rows.stop + 2 * reach, columns.start : columns.stop + 2 * reach] += (
            _shares(ny) @ light @ _shares(nx).T
        )
    return placed[reach:-reach, reach:-reach]


def _taper(radius: FloatArray) -> FloatArray:
    """Part of the light that is moved: all at the cusp, none at radius 1, smooth in between.

    A sharp edge would need its own sub-pixels just as the cusp does.
    """
    t = np.clip(radius, 0.0, 1.0)
    return 1.0 - t**3 * (10.0 - 15.0 * t + 6.0 * t**2)


@cache
def _shares(subpixels: int) -> FloatArray:
    """Share of each of ``subpixels`` + 2 reach sub-pixels in the light of each of their cells, along one axis.

    The Lagrange polynomials on the nearest nodes, averaged over a sub-pixel, because all light is integrated over
    sub-pixels; over a little less, because a cell's light fills the cell (the variances of the two add up).
    """
    width = np.sqrt(1.0 - _FINE**-2.0)
    reach = _NODES // 2
    points, weights = np.polynomial.legendre.leggauss(_NODES // 2)
    nodes = np.arange(_NODES)
    shares = np.zeros((subpixels + 2 * reach, subpixels * _FINE))
    for cell in range(subpixels * _FINE):
        low = (cell + 0.5) / _FINE - 0.5 - 0.5 * width
        # The polynomials change where the nearest nodes do: the two parts are integrated apart, each exactly.
        change = min(np.floor(low) + 1.0, low + width)
        for start, end in ((low, change), (change, low + width)):
            first = int(np.floor(0.5 * (start + end))) - reach + 1
            for point, weight in zip(points, weights, strict=True):
                distance = 0.5 * (start + end) + 0.5 * (end - start) * point - first - nodes
                for k in nodes:
                    others = nodes != k
                    lagrange = np.prod(distance[others] / (k - nodes[others]))
                    shares[first + k + reach, cell] += 0.5 * (end - start) / width * weight * lagrange
    shares.setflags(write=False)
    return shares
