"""Where a parametric fit may start: from the positions of AGN images, or from the ring of an arc."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy import ndimage

from engine.conventions import FloatArray, axis_ratio_and_angle, pixel_centres
from engine.imaging.observation import Observation
from engine.lensing.power_law import PowerLawLens
from engine.parametric.lens_start import lens_from_positions
from engine.parametric.parameters import ParameterSpace
from engine.parametric.point_sources import Detection

CENTRE_REACH = 0.5
"""Farthest [arcsec] that the deflector is looked for from the middle of the image."""
_CENTRE_SIGMA, _CENTRE_RADIUS, _CENTRE_PEAKS = 3.0, 2.0, 12
_MOST_CANDIDATES = 6
_CONSISTENT = 0.15
"""Misfit [arcsec] from which on positions are not the images of one source behind a power law without shear."""
_SLOPE = 2.0
_ARC_RADII = (0.85, 1.0, 1.15)
_ARC_ELLIPTICITY = 0.12
_ARC_ANGLES = 4
_ARC_OFFSETS = 5
_ARC_REACH = 0.25
_DOUBLE_AXIS_RATIO = 0.75
_ELLIPSES, _ELLIPSE_ANGLES = (0.85, 0.7, 0.55), 6
"""Axis ratios of a deflector that is taken off an image, and along how many directions they are tried."""
_SECOND_RING = 0.2
"""Excess, of that of the first, from which on a second radius counts."""


@dataclass(frozen=True)
class Start:
    """Where one fit begins: AGN images, lens, source position [arcsec], and the host's size in Einstein radii."""

    agn: tuple[Detection, ...]
    lens: PowerLawLens
    source: tuple[float, float]
    host_radius: float = 0.3

    def vector(self, space: ParameterSpace) -> FloatArray:
        """The parameters of a fit that begins here."""
        return space.vector([(found.x, found.y) for found in self.agn], self.lens, self.host_radius, self.source)


def filled_image(observation: Observation) -> FloatArray:
    """The image with pixels that are not valid replaced by the median of their neighbourhood."""
    image = np.where(observation.valid, observation.image, np.nan)
    if observation.valid.all():
        return observation.image.copy()
    smooth = ndimage.generic_filter(image, np.nanmedian, size=9, mode="nearest")
    level = float(np.median(observation.image[observation.valid]))
    return np.where(observation.valid, observation.image, np.where(np.isfinite(smooth), smooth, level))


def deflector_centre(
    image: FloatArray, pixel_scale: float, origin: tuple[float, float] = (0.0, 0.0)
) -> tuple[float, float] | None:
    """The peak [arcsec] that is reached by climbing from ``origin``, the image smoothed by a pixel.

    None where the climb leaves half an arcsec round it, as without a deflector's light, or the image.
    """
    smooth = ndimage.gaussian_filter(image, 1.0)
    ny, nx = image.shape
    row, column = _pixel_at(image, pixel_scale, origin)
    reach = max(1, round(CENTRE_REACH / pixel_scale))
    start_row, start_column = row, column
    while True:
        rows, columns = slice(row - 1, row + 2), slice(column - 1, column + 2)
        if not (0 < row < ny - 1 and 0 < column < nx - 1):
            return None
        step = np.unravel_index(int(np.argmax(smooth[rows, columns])), (3, 3))
        if int(step[0]) == 1 and int(step[1]) == 1:
            break
        row, column = row + int(step[0]) - 1, column + int(step[1]) - 1
        if math.hypot(row - start_row, column - start_column) > reach:
            return None
    out = []
    for values in (smooth[row, column - 1 : column + 2], smooth[row - 1 : row + 2, column]):
        bend = float(values[0] - 2.0 * values[1] + values[2])
        out.append(0.5 * float(values[0] - values[2]) / bend if bend < 0 else 0.0)
    return (
        (column + out[0] - (nx - 1) / 2.0) * pixel_scale,
        (row + out[1] - (ny - 1) / 2.0) * pixel_scale,
    )


def _pixel_at(image: FloatArray, pixel_scale: float, place: tuple[float, float]) -> tuple[int, int]:
    """Row and column of a place [arcsec]."""
    ny, nx = image.shape
    return math.floor(place[1] / pixel_scale + (ny - 1) / 2), math.floor(place[0] / pixel_scale + (nx - 1) / 2)


def off_centre(image: FloatArray, noise: FloatArray, pixel_scale: float) -> tuple[float, float] | None:
    """A rough place [arcsec] of the deflector of a lens that is not in the middle; None where the light is about it.

    Of the brightest peaks it is the one about which the light is most symmetric: AGN images and arcs are round their
    deflector. The square root of the light counts, or the brightest image of an AGN would be the centre.
    """
    smooth = ndimage.gaussian_filter(image - float(np.median(image)), 1.0)
    root = np.sqrt(np.where(smooth > _CENTRE_SIGMA * noise, np.maximum(smooth, 0.0), 0.0))
    y, x = np.meshgrid(*(pixel_centres(n, pixel_scale) for n in image.shape), indexing="ij")
    total = float(root.sum())
    if not total > 0 or math.hypot(float((root * x).sum()), float((root * y).sum())) < CENTRE_REACH * total:
        return None
    reach = round(_CENTRE_RADIUS / pixel_scale)
    padded = np.pad(root, reach)
    peaks = np.argwhere((smooth == ndimage.maximum_filter(smooth, 3)) & (root > 0))
    best, most = None, 0.0
    for row, column in sorted(peaks.tolist(), key=lambda at: -smooth[at[0], at[1]])[:_CENTRE_PEAKS]:
        around = padded[row : row + 2 * reach + 1, column : column + 2 * reach + 1]
        symmetric = float((around * around[::-1, ::-1]).sum())
        if symmetric > most:
            best, most = (float(x[row, column]), float(y[row, column])), symmetric
    return best


def without_deflector(image: FloatArray, pixel_scale: float, centre: tuple[float, float]) -> FloatArray:
    """The image less the median over ellipses round ``centre``, of the shape that leaves the least light (L1 norm)."""
    y, x = np.meshgrid(*(pixel_centres(n, pixel_scale) for n in image.shape), indexing="ij")
    x, y = x - centre[0], y - centre[1]
    near = np.hypot(x, y) < 0.5 * min(image.shape) * pixel_scale
    shapes = [(1.0, 0.0), *((q, math.pi * k / _ELLIPSE_ANGLES) for q in _ELLIPSES for k in range(_ELLIPSE_ANGLES))]
    best, least = image, math.inf
    for q, phi in shapes:
        along, across = math.cos(phi) * x + math.sin(phi) * y, math.cos(phi) * y - math.sin(phi) * x
        ring = np.rint(np.sqrt(q * along**2 + across**2 / q) / pixel_scale).astype(int)
        medians = np.asarray(ndimage.median(image, labels=ring, index=np.arange(ring.max() + 1)))
        rest = image - medians[ring]
        left = float(np.abs(rest[near]).sum())
        if left < least:
            best, least = rest, left
    return best


def ring_radii(image: FloatArray, pixel_scale: float, centre: tuple[float, float]) -> tuple[float, ...]:
    """Radii [arcsec] at which light that is not the deflector's stands out: rough Einstein radii, the likeliest first.

    On each circle round the deflector the excess over the lower quartile is summed. A bright flat deflector exceeds it
    more than a faint arc does, so that it is taken off first, by ellipses. The images of a source that is not behind
    the deflector's middle stand out at two radii, with the Einstein radius half way between. Circles within three
    pixels are the deflector's own.
    """
    y, x = np.meshgrid(*(pixel_centres(n, pixel_scale) for n in image.shape), indexing="ij")
    ring = np.rint(np.hypot(x - centre[0], y - centre[1]) / pixel_scale).astype(int)
    last = int(min(image.shape) // 2)
    excess = np.zeros(last)
    smooth = ndimage.gaussian_filter(without_deflector(image, pixel_scale, centre), 1.0)
    for radius in range(3, last):
        on = smooth[ring == radius]
        excess[radius] = float(np.mean(on - np.percentile(on, 25))) * math.sqrt(radius)
    excess = ndimage.gaussian_filter1d(excess, 1.5)
    # The innermost circles hold what is left of the deflector: true maxima, not the edge.
    peaks = [k for k in range(4, last - 1) if excess[k - 1] < excess[k] >= excess[k + 1]]
    if not peaks:
        return (int(np.argmax(excess)) * pixel_scale,)
    first, *others = sorted(peaks, key=lambda k: -excess[k])
    radii = [first * pixel_scale]
    if others and excess[others[0]] > _SECOND_RING * excess[first]:
        second = others[0] * pixel_scale
        radii += [0.5 * (radii[0] + second), second]
    return tuple(radii)


def agn_hypotheses(
    candidates: Sequence[Detection], numbers: Sequence[int], centre: tuple[float, float]
) -> list[tuple[Detection, ...]]:
    """For each number of images the candidates that are taken for images of one source.

    They are the brightest ones; three or more must also map within :data:`_CONSISTENT` of each other, and where no such
    set is found, those that come closest are taken.
    """
    out: list[tuple[Detection, ...]] = []
    for number in numbers:
        if number <= min(2, len(candidates)):
            out.append(tuple(candidates[:number]))
        elif number <= len(candidates):
            sets = sorted(
                combinations(candidates[: max(number, _MOST_CANDIDATES)], number),
                key=lambda chosen: -sum(math.log(detection.flux) for detection in chosen),
            )
            misfits: list[float] = []
            for chosen in sets:
                misfits.append(lens_from_positions([(d.x, d.y) for d in chosen], centre=centre)[2])
                if misfits[-1] < _CONSISTENT:
                    break
            out.append(sets[int(np.argmin(misfits))])
    return out


def starts_from_agn(agn: tuple[Detection, ...], centre: tuple[float, float]) -> list[Start]:
    """Starts from the positions of two AGN images or more.

    Two images leave the shape of the lens free: it is tried round and flattened along four directions.
    """
    lens, source, _ = lens_from_positions([(d.x, d.y) for d in agn], _SLOPE, centre)
    starts = [Start(agn, lens, (float(source[0]), float(source[1])))]
    if len(agn) <= 2:
        for k in range(4):
            flat = lens.with_values(q=_DOUBLE_AXIS_RATIO, phi=math.pi * k / 4)
            starts.append(Start(agn, flat, (float(source[0]), float(source[1]))))
    return starts


def starts_from_arc(theta_E: float, centre: tuple[float, float], agn: tuple[Detection, ...] = ()) -> list[Start]:
    """Starts on a lattice of Einstein radius, flattening, direction and source position, for a light arc alone."""
    axis = np.linspace(-_ARC_REACH, _ARC_REACH, _ARC_OFFSETS)
    shapes = [(1.0, 0.0)]
    q, _ = axis_ratio_and_angle(_ARC_ELLIPTICITY, 0.0)
    shapes += [(q, math.pi * k / _ARC_ANGLES) for k in range(_ARC_ANGLES)]
    out = []
    for factor in _ARC_RADII:
        radius = factor * theta_E
        for axis_ratio, angle in shapes:
            lens = PowerLawLens(radius, axis_ratio, angle, _SLOPE, *centre)
            for dx in axis:
                for dy in axis:
                    source = (float(centre[0] + dx * radius), float(centre[1] + dy * radius))
                    out.append(Start(agn, lens, source))
    return out
