"""Where a lens may be whose arcs stand beside a bright galaxy: all Einstein radii are tried, with linear fits alone.

For each lens and source of a lattice the chi^2 is known that a small round host takes off the image beside the
deflector's Gaussians, amplitudes free. Rings of one radius alone would follow the brightest blob, and what a galaxy's
model leaves.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from engine.conventions import FloatArray, axis_ratio_and_angle, pixel_centres
from engine.imaging.observation import Observation
from engine.imaging.optics.spline import spline_coefficients
from engine.imaging.optics.stamp_blur import StampBlur
from engine.lensing.power_law import PowerLawLens
from engine.light.rendering import sample_sersic
from engine.light.sersic import SersicProfile
from engine.parametric.starts import Start

_SMALLEST, _LARGEST = 0.35, 0.6
"""Einstein radii that are tried: from this many arcsec to this part of the radius of what is searched."""
_STEP = 0.1
_FLAT = 0.12
"""Ellipticity of lenses that are not round, besides that of the light."""
_RINGS = ((0.0, 1), (0.12, 6), (0.3, 8))
"""Offsets of the source in Einstein radii, and along how many directions."""
_HOST_RADIUS, _HOST_INDEX = 0.2, 1.0
_APART = 0.12
"""Logarithm of the ratio of Einstein radii from which on two starts are not the same."""
_MOST_PIXELS = 70
"""Along a side of the search: pixels are binned to come near."""


@dataclass(frozen=True)
class RatedStart:
    """A start, and the chi^2 that its host takes off the image."""

    start: Start
    gain: float


def binned(values: FloatArray, factor: int) -> FloatArray:
    """Sums (..., ny // factor, nx // factor) over squares of pixels."""
    ny, nx = (side // factor * factor for side in values.shape[-2:])
    cut = values[..., :ny, :nx]
    return np.asarray(cut.reshape(*cut.shape[:-2], ny // factor, factor, nx // factor, factor).sum(axis=(-3, -1)))


class ArcSearch:
    """The image round a deflector less its Gaussians, on binned pixels.

    Parameters
    ----------
    observation : Observation
    sigma : array (ny, nx)
        Standard deviations; infinite where a pixel does not count.
    galaxy : array (gaussians, ny, nx)
        Images of the Gaussians that shine.
    window : pair of slices
    centre : (float, float)
        Of the deflector [arcsec].
    """

    def __init__(
        self,
        observation: Observation,
        sigma: FloatArray,
        galaxy: FloatArray,
        window: tuple[slice, slice],
        centre: tuple[float, float],
    ) -> None:
        scale, (ny, nx) = observation.pixel_scale, observation.shape
        side = max(window[0].stop - window[0].start, window[1].stop - window[1].start)
        factor = max(1, math.ceil(side / _MOST_PIXELS))
        counted = np.isfinite(sigma[window])
        variance = np.where(counted, sigma[window], 0.0) ** 2
        image = np.where(counted, observation.image[window], 0.0)
        whole = binned(counted.astype(float), factor) == factor**2
        self._weight = np.where(whole, 1.0 / np.sqrt(np.where(whole, binned(variance, factor), 1.0)), 0.0).ravel()
        data = binned(image, factor).ravel() * self._weight
        columns = binned(np.where(counted, galaxy[:, window[0], window[1]], 0.0), factor)
        columns = columns.reshape(len(galaxy), -1) * self._weight
        self._basis, _ = np.linalg.qr(np.concatenate([columns, self._weight[None]]).T)
        self._data = data - self._basis @ (self._basis.T @ data)
        # Rays in the middle of binned pixels; the PSF is binned about its own middle.
        x, y = pixel_centres(nx, scale)[window[1]], pixel_centres(ny, scale)[window[0]]
        x, y = (axis[: axis.size // factor * factor].reshape(-1, factor).mean(axis=1) for axis in (x, y))
        self._blur = StampBlur(spline_coefficients(_binned_psf(observation.psf, factor)), x, y, factor * scale, 1, 0)
        self._reach = _LARGEST * 0.5 * min(x[-1] - x[0], y[-1] - y[0])
        self._centre, self._scale = centre, factor * scale

    def best(self, ellipticity: tuple[float, float], most: int, theta_E: float | None = None) -> list[RatedStart]:
        """The best starts, best first, no two of the same Einstein radius and shape.

        ``ellipticity`` (e1, e2) is that of the deflector's light; about ``theta_E`` [arcsec] alone where it is given.
        """
        smallest = max(_SMALLEST, 3.0 * self._scale)
        radii = np.exp(np.arange(math.log(smallest), math.log(max(self._reach, 1.05 * smallest)), _STEP))
        if theta_E is not None:
            radii = theta_E * np.array([0.85, 0.92, 1.0, 1.08, 1.16])
        angle = math.atan2(ellipticity[1], ellipticity[0])
        shapes = [ellipticity, (0.0, 0.0)]
        shapes += [(_FLAT * math.cos(angle + turn), _FLAT * math.sin(angle + turn)) for turn in (2.1, -2.1)]
        rated = [
            self._rated(PowerLawLens(float(radius), *axis_ratio_and_angle(*shape), 2.0, *self._centre))
            for radius in radii
            for shape in shapes
        ]
        chosen: list[RatedStart] = []
        for one in sorted((one for one in rated if one.gain > 0), key=lambda one: -one.gain):
            near = [o for o in chosen if abs(math.log(o.start.lens.theta_E / one.start.lens.theta_E)) < _APART]
            if len(near) < 2:
                chosen.append(one)
            if len(chosen) == most:
                break
        return chosen

    def _rated(self, lens: PowerLawLens) -> RatedStart:
        """The best source of a lens."""
        best = RatedStart(Start((), lens, self._centre, _HOST_RADIUS), 0.0)
        for offset, directions in _RINGS:
            for k in range(directions):
                at = 2.0 * math.pi * k / directions
                x = self._centre[0] + offset * lens.theta_E * math.cos(at)
                y = self._centre[1] + offset * lens.theta_E * math.sin(at)
                host = SersicProfile(1.0, _HOST_RADIUS * lens.theta_E, _HOST_INDEX, 1.0, 0.0, x, y)
                gain = self._gain(host, lens)
                if gain > best.gain:
                    best = RatedStart(Start((), lens, (x, y), _HOST_RADIUS), gain)
        return best

    def _gain(self, host: SersicProfile, lens: PowerLawLens) -> float:
        fine = sample_sersic(host, lens, self._blur.x, self._blur.y, self._blur.side)
        column = self._blur(fine, integrated=False).ravel() * self._weight
        column -= self._basis @ (self._basis.T @ column)
        along, size = float(column @ self._data), float(column @ column)
        return along**2 / size if along > 0 and size > 0 else 0.0


def _binned_psf(psf: FloatArray, factor: int) -> FloatArray:
    """An odd PSF on pixels ``factor`` times as large, its middle the middle of a pixel; light between is shared."""
    if factor == 1:
        return psf
    middle = psf.shape[0] // 2
    half = math.ceil(middle / factor + 0.5)
    position = (np.arange(psf.shape[0]) - middle) / factor
    low = np.floor(position).astype(int)
    share = position - low
    matrix = np.zeros((2 * half + 1, psf.shape[0]))
    np.add.at(matrix, (low + half, np.arange(psf.shape[0])), 1.0 - share)
    np.add.at(matrix, (low + 1 + half, np.arange(psf.shape[0])), share)
    return matrix @ psf @ matrix.T
