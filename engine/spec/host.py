"""The host that is put behind a lens: a Sersic profile, an image of a galaxy, or a galaxy that is made up."""

from __future__ import annotations

import base64
import binascii
import hashlib
from dataclasses import fields
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from engine.conventions import FloatArray
from engine.errors import SpecError
from engine.spec.quantities import (
    STRICT,
    UNSIGNED,
    Angle,
    AxisRatio,
    Count,
    Magnitude,
    Number,
    Radius,
    Seed,
    SersicIndex,
)
from engine.spec.validation import IDENTIFIER

LEAST_SIDE, MOST_SIDE = 16, 128
"""Pixels along a side of an image."""
_MOST_TEXT = 4 * -(-(4 * MOST_SIDE**2) // 3)
_PEDESTAL = 0.1
"""Share of the light that a pedestal under the whole image may have."""

_LEAST_RADIUS, _MOST_RADIUS = 1.5, 0.4
"""Half-light radius of a galaxy: so many pixels at least, so much of the shorter side at most."""

Label = Annotated[str, Field(min_length=1, max_length=32, pattern=IDENTIFIER)]
HostKind = Literal["sersic", "image", "bulge_disc", "clumpy", "companion", "spiral", "irregular", "merger"]
MadeKind = Literal["bulge_disc", "clumpy", "companion", "spiral", "irregular", "merger"]
Side = Annotated[Count, Field(ge=LEAST_SIDE, le=MOST_SIDE)]
Pixel = Annotated[Number, Field(ge=0.0, le=float(MOST_SIDE)), UNSIGNED]

_USUAL: dict[str, dict[str, float]] = {
    "bulge_disc": {"share": 0.3, "size": 0.2},
    "clumpy": {"share": 0.3, "size": 0.12},
    "companion": {"share": 0.2, "size": 0.5, "distance": 2.5},
    "spiral": {"share": 0.15, "size": 0.2},
    "irregular": {},
    "merger": {"share": 0.4, "size": 0.8, "distance": 1.5},
}
"""What a kind has, and what it is where nothing else is said."""


@dataclass(frozen=True, config=STRICT)
class HostImage:
    """A galaxy's light on square pixels, in units of its own: :attr:`Host.magnitude` and ``r_eff`` scale it.

    ``pixels`` are ``shape`` = (rows, columns) little-endian 32-bit floats in base64, row by row from the South, West on
    the right; ``nucleus`` is where the AGN stands in it, (column, row) counted from the centre of the first pixel.
    """

    pixels: Annotated[str, Field(min_length=1, max_length=_MOST_TEXT)]
    shape: tuple[Side, Side]
    nucleus: tuple[Pixel, Pixel]

    @model_validator(mode="after")
    def _is_a_galaxy(self) -> HostImage:
        values = self.array()
        if not np.isfinite(values).all():
            raise SpecError("pixels", f"{np.count_nonzero(~np.isfinite(values))} not finite", "finite values")
        total, border = float(values.sum()), float(np.median(border_of(values)))
        if not total > 0.0:
            raise SpecError("pixels", f"a sum of {total:g}", "a positive sum")
        if abs(border) * values.size > _PEDESTAL * total:
            raise SpecError(
                "pixels", f"a border at {border:g}, over the image {border * values.size / total:.0%} of its sum",
                f"a galaxy whose background was subtracted, to {_PEDESTAL:.0%} of its light",
            )  # fmt: skip
        (rows, columns), (column, row) = self.shape, self.nucleus
        if column > columns - 1 or row > rows - 1:
            raise SpecError("nucleus", self.nucleus, f"a place within {columns} columns and {rows} rows")
        radius, most = _half_light_radius(values, column, row), _MOST_RADIUS * min(self.shape)
        if not _LEAST_RADIUS <= radius <= most:
            raise SpecError(
                "pixels", f"half of the light within {radius:.1f} pixels of the nucleus",
                f"{_LEAST_RADIUS:g} to {most:g} pixels, or the galaxy is not resolved, or not all there",
            )  # fmt: skip
        return self

    def array(self) -> FloatArray:
        """The pixels (rows, columns); a SpecError where the text does not hold as many."""
        rows, columns = self.shape
        try:
            data = base64.b64decode(self.pixels, validate=True)
        except (binascii.Error, ValueError) as error:
            raise SpecError("pixels", f"{self.pixels[:20]}...", "base64") from error
        if len(data) != 4 * rows * columns:
            raise SpecError("pixels", f"{len(data)} bytes", f"4 for each of {rows} x {columns} pixels")
        return np.frombuffer(data, dtype="<f4").reshape(rows, columns).astype(np.float64)

    @property
    def digest(self) -> str:
        """SHA-256 (hex) of the pixels, their number along each side and the place of the nucleus."""
        named = f"{self.shape[0]} {self.shape[1]} {self.nucleus[0]!r} {self.nucleus[1]!r} {self.pixels}"
        return hashlib.sha256(named.encode()).hexdigest()


def _half_light_radius(values: FloatArray, column: float, row: float) -> float:
    """Radius of the circle [pixels] that holds half of the sum, to half a pixel."""
    j, i = np.indices(values.shape)
    radius = np.hypot(i - column, j - row).ravel()
    order = np.argsort(radius, kind="stable")
    light = np.cumsum(values.ravel()[order])
    return float(radius[order][np.argmax(light >= 0.5 * light[-1])])


def border_of(values: FloatArray) -> FloatArray:
    """The outermost pixels of an image."""
    return np.concatenate([values[0], values[-1], values[1:-1, 0], values[1:-1, -1]])


@dataclass(frozen=True, config=STRICT)
class MadeGalaxy:
    """A galaxy that is made up: ``seed`` draws all that is random in it.

    ``share`` is the part of the light in the bulge (``bulge_disc``, ``spiral``), in the clumps (``clumpy``) or in the
    second galaxy (``companion``, ``merger``); ``size`` is its half-light radius, or that of a clump, over that of the
    rest; ``distance`` of the second galaxy in half-light radii of the first. Those of the kind where None.
    """

    kind: MadeKind
    seed: Seed = 0
    share: Annotated[Number, Field(ge=0.01, le=0.95)] | None = None
    size: Annotated[Number, Field(ge=0.02, le=3.0)] | None = None
    distance: Annotated[Number, Field(ge=0.1, le=6.0)] | None = None

    @model_validator(mode="after")
    def _fits_the_kind(self) -> MadeGalaxy:
        for name in ("share", "size", "distance"):
            if getattr(self, name) is not None and name not in _USUAL[self.kind]:
                raise SpecError(name, getattr(self, name), f"nothing: the kind {self.kind} has none")
        if self.kind == "bulge_disc" and self.seed:
            raise SpecError("seed", self.seed, "0: nothing is random in the kind bulge_disc")
        return self

    def value(self, name: str) -> float:
        """Share, size or distance: what is asked for, or what is usual."""
        given = getattr(self, name)
        return _USUAL[self.kind][name] if given is None else float(given)


@dataclass(frozen=True, config=STRICT, kw_only=True)
class HostShape:
    """What a host looks like, whatever its size and brightness: ``n`` of a Sersic profile, an ``image``, or ``made``.

    ``q`` and ``position_angle`` [deg] are the system's where None; an image has the axis ratio that it has, and is
    turned by the position angle (not at all where None). ``name`` is what results are told apart by; of its own where
    None.
    """

    n: SersicIndex | None = None
    image: HostImage | None = None
    made: MadeGalaxy | None = None
    q: AxisRatio | None = None
    position_angle: Angle | None = None
    name: Label | None = None

    @model_validator(mode="after")
    def _is_one_thing(self) -> HostShape:
        given = [name for name in ("n", "image", "made") if getattr(self, name) is not None]
        if len(given) != 1:
            raise SpecError("n", " and ".join(given) or "nothing", "one of n, image and made")
        if self.image is not None and self.q is not None:
            raise SpecError("q", self.q, "nothing: an image has its own axis ratio")
        return self

    @property
    def kind(self) -> HostKind:
        """What sort of galaxy it is."""
        return "image" if self.image is not None else "sersic" if self.made is None else self.made.kind

    @property
    def label(self) -> str:
        """What results are told apart by: its name, else the kind with what makes one of it."""
        if self.name is not None:
            return self.name
        if self.image is not None:
            return f"image-{self.image.digest[:8]}"
        return self.kind if self.made is None or self.kind == "bulge_disc" else f"{self.kind}-{self.made.seed}"


@dataclass(frozen=True, config=STRICT, kw_only=True)
class Host(HostShape):
    """The host galaxy to be recovered: its shape, its half-light radius and the AB magnitude of all its light.

    ``r_eff`` [arcsec, intermediate axis] is that of a Sersic profile; of any other host it is the radius of the
    ellipse about its nucleus that holds half of the light (:mod:`engine.light.galaxy`).
    """

    r_eff: Radius
    magnitude: Magnitude

    @classmethod
    def of(cls, shape: HostShape, r_eff: float, magnitude: float) -> Host:
        """A shape with a size and a brightness."""
        named: dict[str, Any] = {one.name: getattr(shape, one.name) for one in fields(HostShape)}
        return cls(**named, r_eff=r_eff, magnitude=magnitude)
