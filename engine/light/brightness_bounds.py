"""How bright and how faint a small square of the image can be, from where its rays meet the source plane.

A square maps to a parallelogram, bent a little. A Sersic profile falls outwards, so the distances between which that
parallelogram lies from the centre of the profile bound the brightness in it, wherever the cusp may hide between the
rays. All positions here are in the axes of :func:`engine.light.radial_table.to_profile_axes`.
"""

from __future__ import annotations

import math

from engine.compiled import inlined_kernel
from engine.conventions import FloatArray
from engine.light.radial_table import look_up

_BEND_MARGIN = 2.0
"""The bend is known from second differences: as much again for what they leave out."""

_VARIATION = math.e
"""A square whose brightest point may exceed its central ray by more is not smooth, whatever its rays say."""


@inlined_kernel
def length(x: float, y: float) -> float:
    """Length of a vector, without the care for overflow that makes ``hypot`` slow."""
    return math.sqrt(x * x + y * y)


@inlined_kernel
def _gap(u: float, v: float, ax: float, ay: float, bx: float, by: float, du: float, dv: float) -> float:
    """Distance from the origin to a parallelogram as seen along the direction (du, dv), of any length but zero."""
    norm = length(du, dv)
    if norm == 0.0:
        return -math.inf
    inside = abs(ax * du + ay * dv) + abs(bx * du + by * dv)
    return (abs(u * du + v * dv) - inside) / norm


@inlined_kernel
def brightness_range(
    u: float, v: float, ax: float, ay: float, bx: float, by: float, bend: float, clearance: float, table: FloatArray
) -> tuple[float, float, bool]:
    """Least and greatest brightness of a square of the image, and whether it is smooth.

    The square maps to (u, v) + s (ax, ay) + t (bx, by) with s, t in [-1, 1], give or take ``bend``. It is smooth if it
    keeps away from the cusp by ``clearance`` times its own size, and its brightness does not vary too much.
    """
    distance = length(u, v)
    slack = _BEND_MARGIN * bend
    # The direction of nearest approach is that of the centre (a corner) or the normal of a side.
    nearest = max(
        _gap(u, v, ax, ay, bx, by, u, v), _gap(u, v, ax, ay, bx, by, -ay, ax), _gap(u, v, ax, ay, bx, by, -by, bx)
    )
    nearest -= slack
    size = length(ax, ay) + length(bx, by) + slack
    farthest = distance + size
    most = look_up(max(nearest, 0.0) ** 2, table)
    least = look_up(farthest * farthest, table)
    central = look_up(distance * distance, table)
    return least, most, nearest > clearance * size and most < _VARIATION * central
