"""Whether an observation can be what it says: looked at before a fit, which would take minutes and hide the cause."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from engine.conventions import rate_to_magnitude
from engine.errors import ObservationError, SpecError
from engine.imaging.calibration import LIKELY_ZERO_POINTS, require_zero_point
from engine.imaging.external_files import MOST_PIXELS
from engine.imaging.observation import Observation
from engine.imaging.psf_stamp import mended, same_picture, width
from engine.imaging.readings import Findings
from engine.imaging.sharpness import sharpness_of_peaks, sharpness_of_stamp
from engine.parametric.detectability import why_no_lens

_SMALLEST = 16
"""Pixels along a side."""
_LIKELY_SCALES, _POSSIBLE_SCALES = (0.005, 1.0), (0.001, 5.0)
_LIKELY_WIDTHS, _POSSIBLE_WIDTHS = (0.03, 0.6), (0.005, 5.0)
"""Of a pixel and of the PSF [arcsec]: from Keck's adaptive optics to the ground."""
_LIKELY_MAGNITUDES = (13.5, 27.0)
_LIKELY_SCATTER, _POSSIBLE_SCATTER = (0.3, 2.5), (0.05, 8.0)
"""Of the empty sky over the noise map; drizzled images have 0.5 to 0.7."""
_SECOND_DIFFERENCES = np.outer([1.0, -2.0, 1.0], [1.0, -2.0, 1.0])
_SKY_WINDOW, _FAINTEST_PERCENT, _FEWEST_PIXELS = 11, 25.0, 400
_SHARP = 1.3
"""Sharpness of an image's sharpest peak over the PSF's from which on the PSF is too broad."""


def require_hints(
    observation: Observation,
    theta_E: float | None,
    positions: Sequence[tuple[float, float]] | None,
    centre: tuple[float, float] | None = None,
) -> None:
    """A SpecError where what is said of the lens is no number, or not on the image."""
    half = [0.5 * n * observation.pixel_scale for n in reversed(observation.shape)]
    if theta_E is not None and not (math.isfinite(theta_E) and 0 < theta_E < min(half)):
        raise SpecError("theta_E", theta_E, f"a radius on the image, above 0 and below {min(half):g} arcsec")
    places = [("positions", position) for position in positions or ()]
    for name, position in (*places, *(() if centre is None else (("centre", centre),))):
        if not all(math.isfinite(value) and abs(value) <= reach for value, reach in zip(position, half, strict=True)):
            raise SpecError(name, tuple(position), f"a place on the image, within {half[0]:g} and {half[1]:g} arcsec")


def require_lens(observation: Observation, *, trusting: bool = False) -> tuple[str, ...]:
    """An ObservationError where the image shows noise alone, one star, or one galaxy without an arc.

    ``trusting``: that is told instead.
    """
    reason = why_no_lens(observation)
    if reason is None:
        return ()
    if not trusting:
        raise ObservationError(f"image: {reason}, so there is no lens to measure")
    return (f"image: {reason}",)


def unlikely(observation: Observation, *, trusting: bool = False) -> tuple[str, ...]:
    """What is odd about an observation.

    ``trusting``: what cannot be is told as well, instead of refused.

    Raises
    ------
    ObservationError
        Size, zero point, pixel scale, noise map or PSF cannot be those of this image.
    """
    found = Findings(trusting)
    shape = observation.shape
    if max(shape) > MOST_PIXELS:
        raise ObservationError(f"image: got {shape[1]} x {shape[0]} pixels, allowed are {MOST_PIXELS} along a side")
    if min(shape) < _SMALLEST:
        raise ObservationError(f"image: got {shape[1]} x {shape[0]} pixels, a lens needs {_SMALLEST} along a side")
    require_zero_point(observation.zero_point, "zero_point")
    if not any(note.startswith("zero_point") for note in observation.notes):
        _between(observation.zero_point, LIKELY_ZERO_POINTS, "zero_point", "mag for 1 e-/s", found)
    _between(observation.pixel_scale, _LIKELY_SCALES, "pixel_scale", "arcsec a pixel", found, _POSSIBLE_SCALES)
    _look_at_light(observation, found)
    _look_at_noise(observation, found)
    _look_at_psf(observation, found)
    return tuple(found.notes)


def _between(
    value: float,
    likely: tuple[float, float],
    name: str,
    unit: str,
    found: Findings,
    possible: tuple[float, float] = (-math.inf, math.inf),
) -> None:
    if not possible[0] <= value <= possible[1]:
        found.contradict(f"{name}: got {value:.3g} {unit}, possible are {possible[0]:g} to {possible[1]:g}")
    elif not likely[0] <= value <= likely[1]:
        found.note(f"{name}: {value:.3g} {unit} are unlikely, most lie from {likely[0]:g} to {likely[1]:g}")


def _look_at_light(observation: Observation, found: Findings) -> None:
    """The magnitude of all light above the level of the image's border."""
    image, valid = observation.image, observation.valid
    border = valid.copy()
    border[2:-2, 2:-2] = False
    level = float(np.median(image[border])) if border.any() else float(np.percentile(image[valid], 10.0))
    rate = float(np.sum(image[valid] - level))
    if rate > 0:
        magnitude = rate_to_magnitude(rate, observation.zero_point)
        _between(magnitude, _LIKELY_MAGNITUDES, "image", "mag of all its light (unit, zero point)", found)


def _look_at_noise(observation: Observation, found: Findings) -> None:
    scatter = sky_scatter(observation)
    if scatter is None:
        return
    least, most = scatter
    low, high = _POSSIBLE_SCATTER
    if most < low or least > high:
        found.contradict(
            f"noise: the sky scatters by {most if most < low else least:.3g} of its map, possible are {low:g} to "
            f"{high:g}: is it 1 sigma, and no variance or weight?"
        )
    elif most < _LIKELY_SCATTER[0] or least > _LIKELY_SCATTER[1]:
        found.note(f"noise: the sky scatters by {most if most < _LIKELY_SCATTER[0] else least:.2f} of its map")


def sky_scatter(observation: Observation) -> tuple[float, float] | None:
    """Scatter of the faintest quarter of an image over its noise map, at least and at most; None with too little of it.

    At most: about the median of 11 x 11 pixels, which arcs leave something of where the field is small. At least: by
    the differences of second differences of neighbours (Immerkaer 1996), which leave nothing of what is smooth, and
    less of the noise that neighbours share.
    """
    image, valid = observation.image, observation.valid
    # What is masked has no bounds, and many mask by a noise beyond all measure.
    usable = valid & (observation.noise < 100.0 * float(np.median(observation.noise[valid])))
    if np.count_nonzero(usable) < _FEWEST_PIXELS:
        return None
    filled = np.where(valid, image, float(np.median(image[valid])))
    smooth = ndimage.median_filter(filled, _SKY_WINDOW)
    faint = usable & (smooth <= np.percentile(smooth[usable], _FAINTEST_PERCENT))
    whole = faint & ndimage.binary_erosion(valid, np.ones((3, 3), dtype=bool))
    rough = ndimage.convolve(filled, _SECOND_DIFFERENCES) / math.sqrt(float((_SECOND_DIFFERENCES**2).sum()))
    found = [
        1.4826 * float(np.median(np.abs(values[chosen] / observation.noise[chosen])))
        for values, chosen in ((rough, whole if whole.any() else faint), (filled - smooth, faint))
    ]
    return min(found), max(found)


def _look_at_psf(observation: Observation, found: Findings) -> None:
    psf = observation.psf
    if same_picture(observation.image, psf):
        found.contradict("psf: is the image itself")
    try:
        found.notes.extend(flaw.partition(";")[0] for flaw in mended(psf)[1])
    except ObservationError as error:
        found.contradict(str(error))
    pixels = width(np.maximum(psf, 0.0))
    if pixels < 1.0:
        found.note(f"psf: is {pixels:.2f} pixels wide, narrower than one")
    _between(pixels * observation.pixel_scale, _LIKELY_WIDTHS, "psf", "arcsec wide", found, _POSSIBLE_WIDTHS)
    peaks = sharpness_of_peaks(observation)
    times = float(peaks[0]) / sharpness_of_stamp(psf) if peaks.size else 0.0
    if times > _SHARP:
        found.note(f"psf: the image has a peak {times:.1f} times as sharp: is it oversampled, or another filter's?")
