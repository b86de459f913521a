"""The parametric model of an image: AGN images, deflector, ray-traced Sersic host and a background.

The amplitudes are linear and are solved for at every step (variable projection, Golub & Pereyra 1973; its Jacobian in
the form of Kaufman 1975). Extended light is laid on the pixels by the weights of a cubic B-spline, so that the PSF is
interpolated at every ray by the same spline as at every AGN image.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from copy import copy
from functools import cached_property, lru_cache
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from engine.conventions import FloatArray, pixel_centres
from engine.errors import PosteriorError
from engine.imaging.observation import Observation
from engine.imaging.optics.spline import place_spline, spline_coefficients
from engine.imaging.optics.stamp_blur import StampBlur
from engine.lensing.power_law import PowerLawLens
from engine.light.derivatives import LightDerivatives
from engine.light.refinement import Leaves
from engine.light.rendering import rendered, sample_sersic
from engine.light.sersic import SHAPE, SersicProfile, profile_of
from engine.parametric.constraints import constraints
from engine.parametric.galaxy_light import non_negative
from engine.parametric.parameters import HOST_FLUX, ParameterSpace, lens_of
from engine.parametric.shared_error import SharedError
from engine.spec.priors import LensParameterName, ParameterPrior
from engine.work import count

RENDER_TOLERANCE = 1e-3
_ANCHOR = 5e-4
"""Shift [arcsec] over which the difference of an AGN image from its stamp is taken for the same."""
_OUTSIDE = 24
"""Pixels round the image from which the PSF brings deflector light in."""


class ImageModel:
    """Whitened columns of the amplitudes on a window of the image, and their derivatives.

    Parameters
    ----------
    observation : Observation
    space : ParameterSpace
    sigma : array (ny, nx)
        Standard deviation of each pixel, errors of the PSF included; infinite where a pixel does not count.
    window : pair of slices
        Rows and columns that are modelled.
    subrays : int
        Rays along each side of a pixel.
    exact : bool
        Sersic light integrated over the sub-pixels to :data:`RENDER_TOLERANCE`, and AGN through the exposures where
        these are known; without it the rays are samples and the AGN are shifted stamps: for quick first fits.
    priors : mapping, optional
        What is known of lens parameters, by name; each replaces the prior that holds otherwise.
    galaxy : array (gaussians, ny, nx), optional
        Images of unit flux of the Gaussians that the deflector's light is made of, where the space has any.
    shared : SharedError, optional
        Errors [e-/s] that pixels of the window share, as that of the PSF: their amplitudes are marginalised.
    """

    def __init__(
        self,
        observation: Observation,
        space: ParameterSpace,
        sigma: FloatArray,
        window: tuple[slice, slice],
        *,
        subrays: int,
        exact: bool,
        priors: Mapping[LensParameterName, ParameterPrior] = MappingProxyType({}),
        galaxy: FloatArray | None = None,
        shared: SharedError | None = None,
    ) -> None:
        self.galaxy = galaxy
        self.observation, self.space, self.window = observation, space, window
        self.subrays, self.exact, self.priors = subrays, exact, priors
        ny, nx = observation.shape
        scale = observation.pixel_scale
        x, y = pixel_centres(nx, scale)[window[1]], pixel_centres(ny, scale)[window[0]]
        self.shape = (y.size, x.size)
        self._spline = spline_coefficients(observation.psf)
        self._inner = StampBlur(self._spline, x, y, scale, subrays, 0)
        # The deflector shines beyond the image, and the PSF brings that light in.
        self._outer = StampBlur(self._spline, x, y, scale, subrays, min(_OUTSIDE, observation.psf.shape[0] // 2))
        self.sigma = sigma
        inside = sigma[window]
        self.weight = np.where(np.isfinite(inside), 1.0 / inside, 0.0).ravel()
        image = np.where(observation.valid, observation.image, 0.0)[window]
        observed = image.ravel() * self.weight
        self.shared = shared
        self._shared = None if shared is None else shared.whitened(self.weight)
        self._observed = observed if self._shared is None else observed + self._shared.offset
        self._target = self._observed
        self.data = self.decorrelated(self._target)
        self.pixels = int(np.count_nonzero(self.weight))
        inner = np.zeros((0, 1)) if galaxy is None else galaxy[:, window[0], window[1]].reshape(len(galaxy), -1)
        self._galaxy = inner * self.weight
        # Of the host, what :meth:`corrected` has taken off the data.
        self.host_defect: FloatArray = np.zeros_like(self.data)
        self._anchors: dict[int, tuple[float, float, FloatArray]] = {}
        self._deflector = lru_cache(maxsize=4)(self._render_deflector)
        self._host = lru_cache(maxsize=4)(self._render_host)
        # A search ends with the derivatives where the next one, or the covariance, begins.
        self._deflector_slopes = lru_cache(maxsize=2)(self._deflector_derivatives)
        self._host_slopes = lru_cache(maxsize=2)(self._host_derivatives)

    def _point(self, index: int, x: float, y: float) -> FloatArray:
        """Column of an AGN image. What the exposures make of it is remembered as long as it moves next to nothing."""
        stamp = self._stamp(x, y)
        if not self.exact:
            return stamp
        anchor = self._anchors.get(index)
        if anchor is None or math.hypot(x - anchor[0], y - anchor[1]) > _ANCHOR:
            exact = self.observation.point_source(x, y)[self.window].ravel() * self.weight
            anchor = self._anchors[index] = (x, y, exact - stamp)
        return stamp + anchor[2]

    def _stamp(self, x: float, y: float, along: str | None = None) -> FloatArray:
        """The PSF moved to (x, y), or its derivative by a coordinate [1/arcsec]."""
        scale, (ny, nx) = self.observation.pixel_scale, self.observation.shape
        column = x / scale + (nx - 1) / 2.0 - self.window[1].start
        row = y / scale + (ny - 1) / 2.0 - self.window[0].start
        image = place_spline(self._spline, self.shape, column, row, along=along)
        return np.asarray(image.ravel() * self.weight) / (1.0 if along is None else scale)

    def _light(self, profile: SersicProfile, lens: PowerLawLens | None) -> tuple[FloatArray, Leaves | None]:
        """Column of light, and the cells it was integrated over, None where it was sampled."""
        blur = self._outer if lens is None else self._inner
        if not self.exact:
            fine = sample_sersic(profile, lens, blur.x, blur.y, blur.side)
            return blur(fine, integrated=False).ravel() * self.weight, None
        found = rendered(profile, blur.x, blur.y, blur.side, lens, RENDER_TOLERANCE)
        return blur(found.image, integrated=True).ravel() * self.weight, found.leaves

    def _light_derivatives(
        self, profile: SersicProfile, lens: PowerLawLens | None, leaves: Leaves | None
    ) -> FloatArray:
        """Derivatives (parameters, pixels) of a column of light, by the lens if there is one and the shape."""
        blur = self._outer if lens is None else self._inner
        moving = LightDerivatives(profile, lens, shear=self.space.shear)
        if leaves is None:
            fine = moving.sampled(blur.x, blur.y, blur.side)
        else:
            fine = moving.integrated(blur.x, blur.y, blur.side, leaves)
        return blur(fine, integrated=self.exact).reshape(moving.size, -1) * self.weight

    def _render_deflector(self, *values: float) -> tuple[FloatArray, Leaves | None]:
        return self._light(profile_of(values), None)

    def _deflector_derivatives(self, *values: float) -> FloatArray:
        return self._light_derivatives(profile_of(values), None, self._deflector(*values)[1])

    def _render_host(self, *values: float) -> tuple[FloatArray, Leaves | None]:
        split = len(values) - len(SHAPE)
        return self._light(profile_of(values[split:]), lens_of(values[:split]))

    def _host_derivatives(self, *values: float) -> FloatArray:
        split = len(values) - len(SHAPE)
        return self._light_derivatives(profile_of(values[split:]), lens_of(values[:split]), self._host(*values)[1])

    def corrected(self, values: FloatArray) -> ImageModel:
        """The model of data less what its columns of deflector and host lack of their exact images.

        A fit of the columns to these data is one with exact columns, as far as their error does not change with the
        parameters (defect correction): ``values`` should lie near the solution. AGN images begin exactly there.
        """
        space = self.space
        amplitudes, _, _ = self.amplitudes(values)
        lens, host = values[space.lens_slice], values[space.host_slice]
        lit: list[tuple[SersicProfile, PowerLawLens | None, float, FloatArray]] = [
            (
                profile_of(host),
                lens_of(lens),
                float(amplitudes[HOST_FLUX]),
                self._host(*values[space.lens_slice.start :].tolist())[0],
            )
        ]
        if space.deflector:
            shape = values[space.deflector_slice]
            lit.append((profile_of(shape), None, float(amplitudes[space.n_agn]), self._deflector(*shape.tolist())[0]))
        defects = []
        for profile, behind, brightness, column in lit:
            exact = self.observation.optics.sersic_image(profile, behind)[self.window]
            defects.append(brightness * (exact.ravel() * self.weight - column))
        out = copy(self)
        out._target = self._observed - sum(defects)
        out.data = self.decorrelated(out._target)
        out.host_defect = defects[0]
        out._anchors = {}
        return out

    def exact_only(self) -> ImageModel:
        """The same model without shared errors: it takes the optics at their word."""
        if self._shared is None:
            return self
        out = copy(self)
        out.shared, out._shared = None, None
        out._observed, out._target = (seen - self._shared.offset for seen in (self._observed, self._target))
        out.data = out._target
        return out

    def missed(self, values: FloatArray) -> FloatArray:
        """Whitened residuals (pixels,) without what shared errors explain of them."""
        return self.exact_only().amplitudes(values)[1]

    def columns(self, values: FloatArray) -> FloatArray:
        """Whitened columns (pixels, amplitudes)."""
        space = self.space
        out = [self._point(k, float(x), float(y)) for k, (x, y) in enumerate(space.agn(values))]
        if space.deflector:
            out.append(self._deflector(*values[space.deflector_slice].tolist())[0])
        out.extend(self._galaxy)
        out.append(self._host(*values[space.lens_slice.start :].tolist())[0])
        out.append(self.weight)
        return np.stack(out, axis=1)

    def amplitudes(self, values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Best amplitudes, whitened residuals without what shared errors explain, and the columns with it."""
        columns = self.columns(values)
        seen = self.decorrelated(columns)
        size = np.sqrt((seen**2).sum(axis=0))
        if not (size > 0).all():
            raise PosteriorError("parametric model: a component puts no light on the image")
        count("columns_solved", size.size)
        if self.space.gaussians:
            best = non_negative(seen, self.data, ~self._gaussian)
            return best, self.data - seen @ best, columns
        scaled = seen / size
        best = np.linalg.lstsq(scaled.T @ scaled, scaled.T @ self.data, rcond=1e-12)[0]
        return best / size, self.data - scaled @ best, columns

    @cached_property
    def _gaussian(self) -> NDArray[np.bool_]:
        """Which amplitudes are those of Gaussians."""
        place = np.arange(self.space.amplitudes) - self.space.n_agn
        return (place >= 0) & (place < self.space.gaussians)

    def decorrelated(self, values: FloatArray) -> FloatArray:
        """Whitened values (pixels, ...) with the errors that pixels share taken into account."""
        return values if self._shared is None else self._shared.decorrelated(values)

    @property
    def host_blur(self) -> StampBlur:
        """What carries rays of the host to the window."""
        return self._inner

    @property
    def shared_parameters(self) -> float:
        """How many amplitudes of shared errors the pixels determine."""
        return 0.0 if self._shared is None else self._shared.effective_parameters

    def image(self, values: FloatArray, amplitudes: FloatArray) -> FloatArray:
        """The model's window [e-/s], shape (rows, columns), without shared errors; zero where pixels do not count."""
        rendered = self.columns(values) @ amplitudes
        flat = np.divide(rendered, self.weight, out=np.zeros_like(rendered), where=self.weight > 0)
        return flat.reshape(self.shape)

    def explained(self, values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """What shared errors add to the model [e-/s], and what neither explains.

        The first two have the window's shape, what the host's errors add and what all of them do; the last are whitened
        residuals (pixels,).
        """
        amplitudes, rest, columns = self.amplitudes(values)
        if self.shared is None or self._shared is None:
            return np.zeros(self.shape), np.zeros(self.shape), rest
        without = self._target - columns @ amplitudes
        found = self._shared.amplitudes(without)
        # What the mean amplitudes do is in the stamp of the observation already.
        added, of_host = found - self.shared.mean, self.shared.of_host
        host = self.shared.columns[:, :of_host] @ added[:of_host]
        rest = without - self._shared.columns @ found
        return host.reshape(self.shape), (self.shared.columns @ added).reshape(self.shape), rest

    def unwhitened(self, columns: FloatArray, amplitudes: FloatArray) -> FloatArray:
        """Image (ny, nx) [e-/s] of some of the whitened columns; zero where pixels do not count and off the window."""
        image = np.zeros(self.observation.shape)
        safe = np.where(self.weight > 0, self.weight, np.inf)
        image[self.window] = (columns @ amplitudes / safe).reshape(self.shape)
        return image

    def residuals(self, values: FloatArray) -> FloatArray:
        """Whitened residuals of the image, followed by :func:`~engine.parametric.constraints.constraints`."""
        return np.concatenate([self.amplitudes(values)[1], constraints(self.space, values, self.priors)])

    def jacobian(self, values: FloatArray) -> FloatArray:
        """Derivatives of :meth:`residuals`: of integrals of the light where the model is ``exact``, else of samples.

        At values whose light has been rendered nothing is rendered again.
        """
        best, _, columns = self.amplitudes(values)
        moved = self.decorrelated(self._column_derivatives(values, best))
        # Gaussians that do not shine stay dark in a small step.
        basis, _ = np.linalg.qr(self.decorrelated(columns[:, ~self._gaussian | (best > 0)]))
        moved -= basis @ (basis.T @ moved)
        return np.concatenate([-moved, _differences(lambda v: constraints(self.space, v, self.priors), values, 1e-6)])

    def full_jacobian(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Derivatives (rows, parameters + amplitudes) of data and constraints by all parameters; the amplitudes."""
        best, _, columns = self.amplitudes(values)
        rows = _differences(lambda v: constraints(self.space, v, self.priors), values, 1e-6)
        shining = columns * (~self._gaussian | (best > 0))
        top = self.decorrelated(np.concatenate([self._column_derivatives(values, best), shining], axis=1))
        below = np.concatenate([-rows, np.zeros((rows.shape[0], best.size))], axis=1)
        return np.concatenate([top, below]), best

    def _column_derivatives(self, values: FloatArray, best: FloatArray) -> FloatArray:
        """Change (pixels, parameters) of the whitened model with each nonlinear parameter."""
        space = self.space
        out = np.empty((self.data.size, space.size))
        for k in range(space.n_agn):
            x, y = map(float, values[2 * k : 2 * k + 2])
            out[:, 2 * k] = best[k] * self._stamp(x, y, "column")
            out[:, 2 * k + 1] = best[k] * self._stamp(x, y, "row")
        if space.deflector:
            where = space.deflector_slice
            out[:, where] = best[space.n_agn] * self._deflector_slopes(*values[where].tolist()).T
        where = slice(space.lens_slice.start, space.size)
        out[:, where] = best[HOST_FLUX] * self._host_slopes(*values[where].tolist()).T
        return out


def _differences(function: Callable[[FloatArray], FloatArray], values: FloatArray, step: float) -> FloatArray:
    here = function(values)
    out = np.empty((here.size, values.size))
    for k in range(values.size):
        shifted = values.copy()
        shifted[k] += step
        out[:, k] = (function(shifted) - here) / step
    return out


def window_round(
    shape: tuple[int, int], pixel_scale: float, centre: tuple[float, float], radius: float
) -> tuple[slice, slice]:
    """Rows and columns of the image within ``radius`` [arcsec] of a centre along each axis."""
    out = []
    for n, middle in zip(shape, (centre[1], centre[0]), strict=True):
        at = middle / pixel_scale + (n - 1) / 2.0
        reach = radius / pixel_scale
        out.append(slice(max(0, math.floor(at - reach)), min(n, math.ceil(at + reach) + 1)))
    return out[0], out[1]


def weights_sigma(observation: Observation, extra: FloatArray | None = None) -> FloatArray:
    """Noise map with another variance (ny, nx) added; infinite where a pixel is not valid."""
    variance = np.where(observation.valid, observation.noise, 1.0) ** 2
    if extra is not None:
        variance = variance + extra
    return np.where(observation.valid, np.sqrt(variance), np.inf)
