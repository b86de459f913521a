"""The PSF of a drizzled image: a star taken through the same dithers and the same drizzle.

Drizzling is not a convolution: the shape of a star depends a little on where it falls between the pixels. The
PSF is therefore an average over such phases, and the spread between them is its model error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft

from engine.conventions import FloatArray
from engine.errors import ObservationError
from engine.imaging.convolution import point_source_image
from engine.imaging.drizzling import drizzle
from engine.imaging.exposures import expose
from engine.imaging.geometry import Geometry, resized

# Whole drizzled pixels between neighbouring stars, beside the phase step: the native phases then spread as
# well, for each of the cameras' scale ratios 0.615, 0.75 and 1.
_WHOLE_STEP = 2
_GUARD = 4


@dataclass(frozen=True, eq=False)
class DrizzledPsf:
    """PSF of a drizzled image.

    Attributes
    ----------
    psf
        Odd square, centred on its middle pixel, flux per drizzled pixel; its sum is the fraction of a star's
        flux inside the stamp.
    phase_error
        Standard deviation over the phases, same shape and unit: what a star differs by from the PSF moved to
        it by a Fourier shift. Drizzled pixels that undersample the star (ACS, scale ratio 1) are most of it.
    oversampled
        The same on a grid ``oversampling`` times finer, side 2 radius oversampling + 1, interlaced from the
        phases: the flux that a drizzled pixel has at that offset from a star, over oversampling^2, so that
        its sum is again the fraction of a star's flux. Every oversampling-th value times oversampling^2 is
        one star of the average.
    oversampling
        Phases along each axis.
    """

    psf: FloatArray
    phase_error: FloatArray
    oversampled: FloatArray
    oversampling: int


def drizzled_psf(
    psf: FloatArray, geometry: Geometry, detector_kernel: FloatArray, radius: int, *, phases: int = 4
) -> DrizzledPsf:
    """PSF of the drizzled image that ``geometry`` describes, averaged over phases x phases star positions.

    Each star is placed, exposed and drizzled by the functions that make the images, moved back by its known
    phase with a Fourier shift, and averaged.

    Parameters
    ----------
    psf
        Optical PSF at geometry.subpixel_scale.
    radius
        Half-width of the stamp in drizzled pixels: its side is 2 radius + 1. Where the optical stamp is
        smaller the outer part is zero.
    phases
        Star positions along each axis, 1 / phases of a drizzled pixel apart (modulo whole pixels).
    """
    if radius < 1 or phases < 1:
        raise ObservationError(f"drizzled psf: got radius {radius} and {phases} phases, allowed are 1 and more")
    reach = (phases - 1) * (_WHOLE_STEP + 1)
    border = radius + _GUARD + (reach + 1) // 2 + 1
    wide = resized(geometry, (2 * border + 1, 2 * border + 1))
    middle = np.array(wide.drizzled_shape) // 2
    origin = (np.array(wide.drizzled_shape) - 1) / 2
    stars = [(_WHOLE_STEP * i - reach // 2, i) for i in range(phases)]
    moved, oversampled = [], np.zeros((2 * radius * phases + 1,) * 2)
    for whole_y, i_y in stars:
        for whole_x, i_x in stars:
            row, column = middle[0] + whole_y, middle[1] + whole_x
            pixel = np.array([[column + i_x / phases - origin[1], row + i_y / phases - origin[0]]])
            star = point_source_image(pixel * wide.drizzled_scale, np.ones(1), psf, wide)
            image = drizzle(expose(star, wide, detector_kernel), wide)
            stamp = _cut(image, row, column, radius + _GUARD)
            # Pixel k of the inner part lies (k - radius) - i / phases pixels from the star.
            first_y, first_x = int(i_y > 0), int(i_x > 0)
            fine = oversampled[first_y * phases - i_y :: phases, first_x * phases - i_x :: phases]
            fine[...] = stamp[_GUARD:-_GUARD, _GUARD:-_GUARD][first_y:, first_x:]
            moved.append(_shifted(stamp, -i_x / phases, -i_y / phases)[_GUARD:-_GUARD, _GUARD:-_GUARD])
    cube = np.array(moved)
    return DrizzledPsf(cube.mean(axis=0), cube.std(axis=0), oversampled / phases**2, phases)


def _cut(image: FloatArray, row: int, column: int, half: int) -> FloatArray:
    return image[row - half : row + half + 1, column - half : column + half + 1]


def _shifted(stamp: FloatArray, shift_x: float, shift_y: float) -> FloatArray:
    """Move the stamp by a sub-pixel shift, in Fourier space."""
    ny, nx = stamp.shape
    phase = np.exp(-2j * np.pi * fft.fftfreq(ny) * shift_y)[:, None] * np.exp(-2j * np.pi * fft.rfftfreq(nx) * shift_x)
    return np.asarray(fft.irfft2(fft.rfft2(stamp) * phase, (ny, nx)))
