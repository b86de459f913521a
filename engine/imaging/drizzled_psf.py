"""The PSF of a drizzled image: a star taken through the same dithers and the same drizzle.

Drizzling is not a convolution: the shape of a star depends a little on where it falls between the pixels. The
PSF is therefore an average over such phases.
"""

from __future__ import annotations

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


def drizzled_psf(
    psf: FloatArray, geometry: Geometry, detector_kernel: FloatArray, radius: int, *, phases: int = 4
) -> FloatArray:
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

    Returns
    -------
    Odd square, centred on its middle pixel, flux per drizzled pixel; its sum is the fraction of a star's flux inside.
    """
    if radius < 1 or phases < 1:
        raise ObservationError(f"drizzled psf: got radius {radius} and {phases} phases, allowed are 1 and more")
    reach = (phases - 1) * (_WHOLE_STEP + 1)
    border = radius + _GUARD + (reach + 1) // 2 + 1
    wide = resized(geometry, (2 * border + 1, 2 * border + 1))
    middle = np.array(wide.drizzled_shape) // 2
    origin = (np.array(wide.drizzled_shape) - 1) / 2
    stars = [(_WHOLE_STEP * i - reach // 2, i) for i in range(phases)]
    moved = []
    for whole_y, i_y in stars:
        for whole_x, i_x in stars:
            row, column = middle[0] + whole_y, middle[1] + whole_x
            pixel = np.array([[column + i_x / phases - origin[1], row + i_y / phases - origin[0]]])
            star = point_source_image(pixel * wide.drizzled_scale, np.ones(1), psf, wide)
            image = drizzle(expose(star, wide, detector_kernel), wide)
            stamp = _cut(image, row, column, radius + _GUARD)
            moved.append(_shifted(stamp, -i_x / phases, -i_y / phases)[_GUARD:-_GUARD, _GUARD:-_GUARD])
    return np.asarray(np.array(moved).mean(axis=0))


def _cut(image: FloatArray, row: int, column: int, half: int) -> FloatArray:
    return image[row - half : row + half + 1, column - half : column + half + 1]


def _shifted(stamp: FloatArray, shift_x: float, shift_y: float) -> FloatArray:
    """Move the stamp by a sub-pixel shift, in Fourier space."""
    ny, nx = stamp.shape
    phase = np.exp(-2j * np.pi * fft.fftfreq(ny) * shift_y)[:, None] * np.exp(-2j * np.pi * fft.rfftfreq(nx) * shift_x)
    return np.asarray(fft.irfft2(fft.rfft2(stamp) * phase, (ny, nx)))
