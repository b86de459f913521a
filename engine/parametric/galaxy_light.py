"""The light of a deflector that is no Sersic profile: concentric Gaussians (Emsellem, Monnet & Bacon 1994).

Real galaxies have cores, discs and twisted isophotes, and what one profile misses of them is brighter than an arc. Two
families of Gaussians, each of one ellipse and of widths from the pixel to the field, leave residuals of the noise.
Their amplitudes are linear and not negative. Their centre and their two ellipses are fitted here, with what is not the
galaxy's left out, and held in fits of the lens, which know them far less well.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, ndimage
from scipy.optimize import least_squares, nnls

from engine.conventions import FloatArray, axis_ratio_and_angle, pixel_centres
from engine.imaging.observation import Observation
from engine.imaging.optics.spline import spline_coefficients
from engine.imaging.optics.stamp_blur import StampBlur
from engine.light.sersic import SersicProfile

_FAMILIES, _WIDTHS = 2, 12
_NARROWEST, _WIDEST = 0.6, 0.8
"""Widths of the Gaussians: in pixels, and in radii of what is fitted."""
_HALF_LIGHT = math.sqrt(2.0 * math.log(2.0))
"""Half-light radius of a Gaussian in its standard deviations."""
_SUBRAYS, _OUTSIDE = 2, 8
_CENTRE_REACH, _ELLIPTICITY_REACH = 0.15, 0.6
_STEPS, _ROUNDS = 6, 3
_STANDS_OUT, _SMOOTH, _GROWN = 3.0, 1.5, 2
_OWN_RADIUS = 7.0
"""Pixels round the centre where whatever shines is the deflector's."""
_RIDGE = 1e-10


@dataclass(frozen=True)
class GalaxyLight:
    """Gaussians of unit flux: a common centre [arcsec], an ellipse (e1, e2) for each family, widths [arcsec]."""

    centre: tuple[float, float]
    ellipses: tuple[tuple[float, float], ...]
    widths: tuple[float, ...]

    @property
    def size(self) -> int:
        """Number of Gaussians."""
        return len(self.ellipses) * len(self.widths)

    @property
    def profiles(self) -> tuple[SersicProfile, ...]:
        """The Gaussians as Sersic profiles of unit flux with n = 1/2."""
        shapes = [(width, *axis_ratio_and_angle(*ellipse)) for ellipse in self.ellipses for width in self.widths]
        return tuple(SersicProfile(1.0, _HALF_LIGHT * width, 0.5, q, phi, *self.centre) for width, q, phi in shapes)

    def ellipticity(self, fluxes: FloatArray) -> tuple[float, float]:
        """The ellipticity (e1, e2) of the light as a whole, of those of the families by their flux."""
        shares = np.asarray(fluxes).reshape(len(self.ellipses), -1).sum(axis=1)
        mean = shares @ np.array(self.ellipses) / max(float(shares.sum()), 1e-300)
        return float(mean[0]), float(mean[1])


class GalaxyImages:
    """What Gaussians put on the pixels of a window of an observation, and how that changes with their ellipses."""

    def __init__(self, observation: Observation, window: tuple[slice, slice]) -> None:
        ny, nx = observation.shape
        scale = observation.pixel_scale
        x, y = pixel_centres(nx, scale)[window[1]], pixel_centres(ny, scale)[window[0]]
        outside = min(_OUTSIDE, observation.psf.shape[0] // 2)
        self._blur = StampBlur(spline_coefficients(observation.psf), x, y, scale, _SUBRAYS, outside)

    def __call__(self, light: GalaxyLight) -> FloatArray:
        """Images (Gaussians, ny, nx) of unit flux."""
        fine = []
        for ellipse in light.ellipses:
            radius2 = self._radius2(light.centre, ellipse)[0]
            fine += [np.exp(-0.5 * radius2 / width**2) / (2.0 * math.pi * width**2) for width in light.widths]
        return self._blur(np.stack(fine) * self._blur.side**2, integrated=False)

    def derivatives(self, light: GalaxyLight, fluxes: FloatArray) -> FloatArray:
        """Derivatives (2 + 2 families, ny, nx) of the whole light by the centre and the ellipses."""
        out = np.zeros((2 + 2 * len(light.ellipses), self._blur.y.size, self._blur.x.size))
        for k, ellipse in enumerate(light.ellipses):
            radius2, slopes = self._radius2(light.centre, ellipse)
            falling = np.zeros(radius2.shape)
            for width, flux in zip(light.widths, fluxes.reshape(len(light.ellipses), -1)[k], strict=True):
                if flux > 0:
                    falling -= flux * np.exp(-0.5 * radius2 / width**2) / (4.0 * math.pi * width**4)
            out[:2] += falling * slopes[:2]
            out[2 + 2 * k : 4 + 2 * k] = falling * slopes[2:]
        return self._blur(out * self._blur.side**2, integrated=False)

    def _radius2(self, centre: tuple[float, float], ellipse: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
        """Squared radius on the intermediate axis, and its derivatives (4, ...) by x, y, e1 and e2."""
        dx, dy = self._blur.x[None, :] - centre[0], self._blur.y[:, None] - centre[1]
        (e1, e2), e = ellipse, ellipse[0] ** 2 + ellipse[1] ** 2
        rho2, along, across = dx**2 + dy**2, dx**2 - dy**2, 2.0 * dx * dy
        squeeze = 1.0 / (1.0 - e)
        radius2 = squeeze * ((1.0 + e) * rho2 - 2.0 * (e1 * along + e2 * across))
        slopes = np.stack(
            [
                -2.0 * squeeze * ((1.0 + e) * dx - 2.0 * (e1 * dx + e2 * dy)),
                -2.0 * squeeze * ((1.0 + e) * dy - 2.0 * (e2 * dx - e1 * dy)),
                2.0 * squeeze * (e1 * (rho2 + radius2) - along),
                2.0 * squeeze * (e2 * (rho2 + radius2) - across),
            ]
        )
        return radius2, slopes


def non_negative(columns: FloatArray, data: FloatArray, free: NDArray[np.bool_]) -> FloatArray:
    """Amplitudes (k,) of columns (pixels, k) that come closest to data (pixels,); not negative but for the ``free``.

    A free amplitude is the difference of two that are not negative.
    """
    size = np.sqrt((columns**2).sum(axis=0))
    size[size == 0.0] = 1.0
    scaled = columns / size
    signed = np.concatenate([scaled, -scaled[:, free]], axis=1)
    normal = signed.T @ signed
    normal[np.diag_indices_from(normal)] += _RIDGE
    root = linalg.cholesky(normal, lower=True)
    right = linalg.solve_triangular(root, signed.T @ data, lower=True)
    found, _ = nnls(root.T, right, maxiter=50 * normal.shape[0])
    out = found[: size.size].copy()
    out[free] -= found[size.size :]
    return np.asarray(out / size)


@dataclass(frozen=True, eq=False)
class GalaxyFit:
    """Gaussians with their fluxes, their image (ny, nx), and the pixels that were taken for something else's."""

    light: GalaxyLight
    fluxes: FloatArray
    image: FloatArray
    others: NDArray[np.bool_]


def fit_galaxy(
    observation: Observation,
    image: FloatArray,
    sigma: FloatArray,
    start: GalaxyLight,
    *,
    rounds: int = _ROUNDS,
) -> GalaxyFit:
    """The Gaussians that come closest to ``image`` (ny, nx) [e-/s], without what stands out of them.

    ``sigma`` is infinite where a pixel does not count. In each round pixels that stand out of the last fit, smoothed,
    are left out of the next: arcs and neighbours are not the deflector's. One round takes every pixel.
    """
    counted = np.isfinite(sigma)
    window = _window(counted)
    images = GalaxyImages(observation, window)
    used, light = counted[window].copy(), start
    inside, noise = image[window], sigma[window]
    own = _near(observation, start.centre)[window]
    fluxes, model = np.zeros(start.size), np.zeros(inside.shape)
    for k in range(rounds):
        weight = np.where(used, 1.0 / noise, 0.0)
        light, fluxes, model = _fit_round(images, inside, weight, light)
        if k < rounds - 1:
            rest = np.where(counted[window], (inside - model) / noise, 0.0)
            smooth = ndimage.gaussian_filter(rest, _SMOOTH)
            level = 1.4826 * float(np.median(np.abs(smooth[counted[window]])))
            used = counted[window] & (own | ~ndimage.binary_dilation(smooth > _STANDS_OUT * level, iterations=_GROWN))
    whole, others = np.zeros(image.shape), np.zeros(image.shape, dtype=bool)
    whole[window], others[window] = model, counted[window] & ~used
    return GalaxyFit(light, fluxes, whole, others)


def first_light(
    centre: tuple[float, float], radius: float, pixel_scale: float, ellipse: tuple[float, float] = (0.0, 0.0)
) -> GalaxyLight:
    """Gaussians for a deflector within a radius [arcsec]; two families that are the same would stay so."""
    widths = np.geomspace(_NARROWEST * pixel_scale, _WIDEST * radius, _WIDTHS)
    e1, e2 = ellipse
    return GalaxyLight(centre, ((e1 + 0.08, e2 + 0.01), (e1 - 0.08, e2 - 0.01)), tuple(widths.tolist()))


def _fit_round(
    images: GalaxyImages, image: FloatArray, weight: FloatArray, start: GalaxyLight
) -> tuple[GalaxyLight, FloatArray, FloatArray]:
    """One nonlinear fit of centre and ellipses, amplitudes by variable projection."""
    data = (image * weight).ravel()
    free = np.append(np.zeros(start.size, dtype=bool), True)
    known: dict[bytes, tuple[FloatArray, FloatArray, FloatArray]] = {}

    def light_of(values: FloatArray) -> GalaxyLight:
        pairs = values[2:].reshape(-1, 2).tolist()
        return GalaxyLight((float(values[0]), float(values[1])), tuple((a, b) for a, b in pairs), start.widths)

    def solved(values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        key = values.tobytes()
        if key not in known:
            known.clear()
            unit = images(light_of(values)).reshape(start.size, -1)
            columns = np.concatenate([unit * weight.ravel(), weight.reshape(1, -1)]).T
            known[key] = unit, columns, non_negative(columns, data, free)
        return known[key]

    def residuals(values: FloatArray) -> FloatArray:
        _, columns, amplitudes = solved(values)
        return np.asarray(data - columns @ amplitudes)

    def jacobian(values: FloatArray) -> FloatArray:
        _, columns, amplitudes = solved(values)
        moved = images.derivatives(light_of(values), amplitudes[:-1]).reshape(values.size, -1).T
        moved = moved * weight.reshape(-1, 1)
        basis, _ = np.linalg.qr(columns[:, (amplitudes > 0) | free])
        return np.asarray(basis @ (basis.T @ moved) - moved)

    first = np.array([*start.centre, *np.array(start.ellipses).ravel()])
    reach = np.array([_CENTRE_REACH] * 2 + [0.0] * (first.size - 2))
    low = np.where(reach > 0, first - reach, -_ELLIPTICITY_REACH)
    high = np.where(reach > 0, first + reach, _ELLIPTICITY_REACH)
    found = least_squares(
        residuals, np.clip(first, low + 1e-6, high - 1e-6), jacobian, (low, high), x_scale="jac", xtol=1e-4, ftol=1e-4,
        max_nfev=_STEPS,
    )  # fmt: skip
    unit, _, amplitudes = solved(found.x)
    model = (amplitudes[:-1] @ unit + amplitudes[-1]).reshape(image.shape)
    return light_of(found.x), amplitudes[:-1], model


def _near(observation: Observation, centre: tuple[float, float]) -> NDArray[np.bool_]:
    """Pixels (ny, nx) near a centre [arcsec]."""
    ny, nx = observation.shape
    scale = observation.pixel_scale
    x, y = pixel_centres(nx, scale) - centre[0], pixel_centres(ny, scale) - centre[1]
    return np.asarray(np.hypot(y[:, None], x[None, :]) < _OWN_RADIUS * scale)


def _window(counted: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Rows and columns with pixels that count."""
    rows, columns = (np.flatnonzero(counted.any(axis=axis)) for axis in (1, 0))
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
