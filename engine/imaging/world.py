"""Where an image lies on the sky and how it stands there: its world coordinates, whatever is wrong with them."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np
from astropy import units
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.nddata import NoOverlapError, overlap_slices
from astropy.wcs import WCS

from engine.conventions import FloatArray, Orientation
from engine.errors import ObservationError, SpecError
from engine.imaging.fits_planes import LIBRARY_ERRORS, Headers, Slices, in_one_line, said

_DISTORTION = re.compile(r"(A|B|AP|BP)_(ORDER|DMAX|\d+_\d+)|(CP|CQ)(DIS|ERR)\d|D2IM.*|(DP|DQ|D2IM)\d(\..*)?")
_SQUARE, _HARDLY_SQUARE = 1e-3, 0.2
"""Departures of a pixel from a square that are worth a note, and that cannot be left out of account: ACS has 0.09."""
_LARGEST_PIXEL = 60.0
"""[arcsec]; beyond it there is no scale in the header: CDELT is 1 deg where it is missing."""


@dataclass(frozen=True)
class Placement:
    """How the pixels about the middle of an image lie on the sky."""

    pixel_scale: float
    """[arcsec]."""
    orientation: Orientation
    centre: tuple[float, float]
    """(RA, Dec) [deg, ICRS] of the middle."""
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class World:
    """World coordinates of a plane, with notes about distortions."""

    wcs: WCS
    origin: str
    notes: tuple[str, ...]


def read_world(hdus: fits.HDUList, headers: Headers) -> World | None:
    """The celestial coordinates of a plane; None without any.

    Tables of distortion are used where they are whole, and left out with a note where they are not.
    """
    header, origin = headers.own, headers.origin
    tables = sorted({name.partition(".")[0] for name in header if name and _DISTORTION.fullmatch(name)})
    plain = _without(header, tables)
    with in_one_line(f"{origin}: its world coordinates cannot be used"):
        world = WCS(plain)
        if not world.has_celestial:
            return None
        world = world.celestial
    if not tables:
        return World(world, origin, ())
    named = ", ".join(tables[:4]) + (" ..." if len(tables) > 4 else "")
    try:
        with in_one_line("distortion"):
            full = WCS(header, hdus)
            full = full if full.naxis == 2 else full.celestial
            full.pixel_to_world(0.0, 0.0)
    except ObservationError as error:
        return World(world, origin, (f"distortion: {named} of {origin} cannot be used and is left out ({error})",))
    return World(full, origin, (f"distortion: {named} of {origin}; scale and directions are those of the middle",))


def _without(header: fits.Header, tables: list[str]) -> fits.Header:
    """A header without its distortions."""
    plain = header.copy()
    for name in [key for key in plain if key and key.partition(".")[0] in tables]:
        plain.remove(name, ignore_missing=True, remove_all=True)
    for name in ("CTYPE1", "CTYPE2"):
        kind = plain.get(name)
        if isinstance(kind, str):
            plain[name] = kind.removesuffix("-SIP")
    return plain


def place(world: World, row: float, column: float) -> Placement:
    """Scale, orientation and centre about a place among the pixels, whatever projection and frame there is.

    Raises
    ------
    ObservationError
        There is no scale, or the pixels are far from square.
    """
    with in_one_line(f"{world.origin}: its world coordinates cannot be used"):
        middle = world.wcs.pixel_to_world(column, row).icrs
        columns, rows = column + 0.5 * np.array([1, -1, 0, 0]), row + 0.5 * np.array([0, 0, 1, -1])
        east, north = middle.spherical_offsets_to(world.wcs.pixel_to_world(columns, rows).icrs)
        offsets = np.array([east.to_value(units.arcsec), north.to_value(units.arcsec)])
    matrix = np.stack([offsets[:, 0] - offsets[:, 1], offsets[:, 2] - offsets[:, 3]], axis=1)
    scale = math.sqrt(abs(float(np.linalg.det(matrix)))) if np.isfinite(matrix).all() else math.nan
    if not 0 < scale < _LARGEST_PIXEL:
        raise ObservationError(
            f"{world.origin}: its world coordinates have {scale:.4g} arcsec a pixel: is CDELT or CD missing?"
        )
    unsquare = _unsquare(matrix)
    if unsquare > _HARDLY_SQUARE:
        along, across = np.hypot(*matrix)
        raise ObservationError(f"{world.origin}: got pixels of {along:g} x {across:g} arcsec, allowed are square ones")
    notes = () if unsquare < _SQUARE else (f"pixels: {world.origin} has pixels that are {unsquare:.2%} from square",)
    up = np.linalg.solve(matrix, [0.0, 1.0])
    orientation = Orientation(math.atan2(up[1], up[0]), mirrored=bool(np.linalg.det(matrix) > 0))
    return Placement(scale, orientation, (float(middle.ra.deg) % 360.0, float(middle.dec.deg)), notes)


def _unsquare(matrix: FloatArray) -> float:
    """How far the sides differ from each other, and their angle from a right one."""
    along, across = np.hypot(*matrix)
    cosine = float(matrix[:, 0] @ matrix[:, 1]) / float(along * across)
    return max(abs(float(along / across) - 1.0), abs(cosine))


def cutout(
    world: World | None, shape: tuple[int, int], center: tuple[str, str] | None, size: float, pixel_scale: float
) -> Slices:
    """Rows and columns of a square of ``size`` [arcsec] about a place on the sky, or about the middle.

    Raises
    ------
    SpecError
        ``center`` is no place on the sky, or not on the image; or ``size`` is no size.
    """
    if not (math.isfinite(size) and size > 0):
        raise SpecError("size", size, "a positive number of arcsec")
    side = max(1, 2 * math.floor(size / pixel_scale / 2.0) + 1)
    if center is None:
        column, row = (shape[1] - 1) / 2.0, (shape[0] - 1) / 2.0
    elif world is None:
        raise SpecError("center", " ".join(center), "none: the image has no world coordinates")
    else:
        with in_one_line(f"{world.origin}: its world coordinates cannot be used"):
            column, row = (float(value) for value in world.wcs.world_to_pixel(_sky(center)))
    if not (math.isfinite(row) and math.isfinite(column)):
        raise SpecError("center", " ".join(center or ()), "a place on the image")
    try:
        (rows, columns), _ = overlap_slices(shape, (side, side), (round(row), round(column)), mode="trim")
    except NoOverlapError as error:
        raise SpecError("center", " ".join(center or ()), f"a place on the image ({said(error)})") from error
    return rows, columns


def _sky(center: tuple[str, str]) -> SkyCoord:
    """(RA, Dec) in degrees, or RA in hours where it is sexagesimal."""
    sexagesimal = any(mark in center[0].strip() for mark in ": h")
    try:
        return SkyCoord(center[0], center[1], unit=(units.hourangle if sexagesimal else units.deg, units.deg))
    except LIBRARY_ERRORS as error:
        allowed = "RA and Dec, as 172.9645 -12.5329 or 11:31:51.5 -12:31:58.6"
        raise SpecError("center", " ".join(center), allowed) from error
