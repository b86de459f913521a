"""Where every pixel lies: high-resolution grid, dithered native exposures and the drizzled image.

All three are centred on the target. The origin of the image frame (:mod:`engine.conventions`) is the centre
of the drizzled image, ``(n - 1) / 2``, and the centre of the high-resolution grid. An exposure with dither
shift (sx, sy) has its native grid displaced by (sx, sy) / subpixels native pixels from a common reference,
which lies half a pattern width below the centre so that the exposures together are centred too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from engine.conventions import FloatArray, pixel_centres
from engine.errors import SpecError
from engine.spec.instrument import Camera, Dither

# Native pixels beyond the drizzled image, one on each side: every output pixel must lie under a droplet of
# each exposure, and a droplet is smaller than the pixel it comes from.
_OVERLAP = 2


@dataclass(frozen=True)
class Geometry:
    """The sampling of one set of exposures. Hashable: it is the key under which drizzle weights are kept.

    Attributes
    ----------
    pixel_scale, drizzled_scale
        Side of a native and of a drizzled pixel [arcsec].
    native_shape, drizzled_shape
        (ny, nx) of one exposure and of the drizzled image.
    oversampling
        High-resolution sub-pixels along a native pixel; a multiple of ``subpixels``.
    subpixels, shifts
        Dither pattern: (x, y) shifts in units of 1 / subpixels native pixel, none negative.
    pixfrac, kernel
        Droplet size in native pixels and drizzle kernel.
    margin
        Sub-pixels by which the high-resolution grid extends beyond the exposures on each side, so that light
        from there is scattered in. At least one native pixel, which the detector kernel needs.
    """

    pixel_scale: float
    native_shape: tuple[int, int]
    oversampling: int
    subpixels: int
    shifts: tuple[tuple[int, int], ...]
    drizzled_shape: tuple[int, int]
    drizzled_scale: float
    pixfrac: float = 0.7
    kernel: str = "square"
    margin: int = 12

    def __post_init__(self) -> None:
        """Check what the arithmetic of the other modules relies upon."""
        if self.oversampling < 1 or self.oversampling % self.subpixels:
            raise SpecError(
                "oversampling", self.oversampling, f"a multiple of the dither's {self.subpixels} sub-pixels"
            )
        if not self.shifts or min(min(shift) for shift in self.shifts) < 0:
            raise SpecError("shifts", self.shifts, "at least one, none negative")
        if min(*self.native_shape, *self.drizzled_shape) < 1:
            raise SpecError("shape", (self.native_shape, self.drizzled_shape), "positive numbers of pixels")
        if not (self.pixel_scale > 0 and self.drizzled_scale > 0 and 0 < self.pixfrac <= 1):
            raise SpecError(
                "sampling",
                (self.pixel_scale, self.drizzled_scale, self.pixfrac),
                "positive scales, pixfrac in (0, 1]",
            )
        if self.margin < self.oversampling:
            raise SpecError("margin", self.margin, f"at least one native pixel, {self.oversampling} sub-pixels")

    @property
    def subpixel_scale(self) -> float:
        """Side of a high-resolution sub-pixel [arcsec]."""
        return self.pixel_scale / self.oversampling

    @property
    def n_dither(self) -> int:
        """Number of dither positions."""
        return len(self.shifts)

    @property
    def drizzle_ratio(self) -> float:
        """Side of a drizzled pixel in native pixels."""
        return self.drizzled_scale / self.pixel_scale

    @property
    def subpixel_shifts(self) -> tuple[tuple[int, int], ...]:
        """Dither shifts (x, y) in high-resolution sub-pixels."""
        step = self.oversampling // self.subpixels
        return tuple((x * step, y * step) for x, y in self.shifts)

    @property
    def high_resolution_shape(self) -> tuple[int, int]:
        """(ny, nx) of the high-resolution grid: the exposures at all their shifts, and the margin."""
        ny, nx = self.native_shape
        reach_x = max(x for x, _ in self.subpixel_shifts)
        reach_y = max(y for _, y in self.subpixel_shifts)
        return (
            ny * self.oversampling + reach_y + 2 * self.margin,
            nx * self.oversampling + reach_x + 2 * self.margin,
        )

    def high_resolution_axes(self) -> tuple[FloatArray, FloatArray]:
        """Image-frame coordinates [arcsec] of the sub-pixel centres: (x of each column, y of each row)."""
        ny, nx = self.high_resolution_shape
        return pixel_centres(nx, self.subpixel_scale), pixel_centres(ny, self.subpixel_scale)

    def native_axes(self, index: int) -> tuple[FloatArray, FloatArray]:
        """Image-frame coordinates [arcsec] of the native pixel centres of exposure ``index``: (x, y)."""
        shift_x, shift_y = self.subpixel_shifts[index]
        return self._native_axis(shift_x, 1), self._native_axis(shift_y, 0)

    def _native_axis(self, shift: int, axis: int) -> FloatArray:
        total = self.high_resolution_shape[axis]
        first = self.margin + shift + (self.oversampling - 1) / 2 - (total - 1) / 2
        native = np.arange(self.native_shape[axis], dtype=np.float64)
        return np.asarray((first + self.oversampling * native) * self.subpixel_scale)

    def drizzled_axes(self) -> tuple[FloatArray, FloatArray]:
        """Image-frame coordinates [arcsec] of the drizzled pixel centres: (x, y)."""
        ny, nx = self.drizzled_shape
        return pixel_centres(nx, self.drizzled_scale), pixel_centres(ny, self.drizzled_scale)


def exposure_geometry(
    camera: Camera,
    dither: Dither,
    drizzled_shape: tuple[int, int],
    *,
    oversampling: int | None = None,
    margin: float = 1.0,
) -> Geometry:
    """Geometry of a camera and dither pattern for a drizzled image of the given shape.

    The native shape is the smallest that covers every drizzled pixel in every exposure (with the droplets
    smaller than the pixels), so each drizzled pixel has its full weight.

    Parameters
    ----------
    camera, dither
        Scales, pixfrac, kernel; shifts.
    drizzled_shape
        (ny, nx) of the drizzled image.
    oversampling
        Sub-pixels along a native pixel. Where None, the camera's, or the next multiple of the dither's
        sub-pixels above it (6 for the sixth-pixel pattern).
    margin
        Width [arcsec] of the sky beyond the exposures whose light the PSF may carry in.
    """
    factor = oversampling
    if factor is None:
        factor = dither.subpixels * math.ceil(camera.oversampling / dither.subpixels)
    lowest = [min(shift[axis] for shift in dither.shifts) for axis in (0, 1)]
    shifts = tuple((x - lowest[0], y - lowest[1]) for x, y in dither.shifts)
    ratio = camera.drizzled_scale / camera.pixel_scale
    return Geometry(
        pixel_scale=camera.pixel_scale,
        native_shape=_native_shape(drizzled_shape, ratio, shifts, dither.subpixels),
        oversampling=factor,
        subpixels=dither.subpixels,
        shifts=shifts,
        drizzled_shape=drizzled_shape,
        drizzled_scale=camera.drizzled_scale,
        pixfrac=camera.pixfrac,
        kernel=camera.drizzle_kernel,
        margin=max(factor, math.ceil(margin / camera.pixel_scale * factor)),
    )


def resized(geometry: Geometry, drizzled_shape: tuple[int, int]) -> Geometry:
    """Keep the sampling for a drizzled image of at least another shape.

    The shape is rounded up to the parity of the geometry's own, and so is the native shape: only then do
    native and drizzled pixels lie with respect to each other, and to the origin, as they did.
    """
    ny, nx = (n + (n - old) % 2 for n, old in zip(drizzled_shape, geometry.drizzled_shape, strict=True))
    native_y, native_x = (
        n + (n - old) % 2
        for n, old in zip(
            _native_shape((ny, nx), geometry.drizzle_ratio, geometry.shifts, geometry.subpixels),
            geometry.native_shape,
            strict=True,
        )
    )
    return replace(geometry, drizzled_shape=(ny, nx), native_shape=(native_y, native_x))


def _native_shape(
    drizzled_shape: tuple[int, int], ratio: float, shifts: tuple[tuple[int, int], ...], subpixels: int
) -> tuple[int, int]:
    ny, nx = (
        math.ceil(n * ratio + max(shift[axis] for shift in shifts) / subpixels) + _OVERLAP
        for n, axis in zip(drizzled_shape, (1, 0), strict=True)
    )
    return ny, nx
