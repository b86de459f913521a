"""The parametric model of an image: AGN images, deflector, ray-traced Sersic host and a background.

The amplitudes are linear and are solved for at every step (variable projection, Golub & Pereyra 1973; its Jacobian in
the form of Kaufman 1975). Extended light is laid on the pixels by the weights of a cubic B-spline, so that the PSF is
interpolated at every ray by the same spline as at every AGN image.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType

import numpy as np

from engine.conventions import FloatArray, pixel_centres
from engine.errors import PosteriorError
from engine.imaging.observation import Observation
from engine.imaging.optics.stamp_blur import StampBlur
from engine.imaging.optics.spline import place_spline, spline_coefficients
from engine.lensing.power_law import PowerLawLens, source_position
from engine.light.rendering import render_sersic, sample_sersic
from engine.light.sersic import SersicProfile
from engine.spec.priors import LensParameterName, ParameterPrior

RENDER_TOLERANCE = 1e-3
POSITION_ERROR = 0.01
"""Image-plane accuracy [arcsec] asked of the AGN images as images of one source."""
SLOPE_PRIOR = (2.0, 0.3)
"""Mean and standard deviation; elliptical lenses have 2.08 +- 0.16 (Auger et al. 2010)."""
SHEAR_PRIOR = 0.15
ELLIPTICITY_PRIOR = 0.25
CENTRE_PRIOR = 0.1
"""Offset [arcsec] of the lens from the deflector's light, or from the frame where it has none."""
OWN_PARAMETER: dict[LensParameterName, int] = {"theta_E": 0, "slope": 3, "x": 4, "y": 5, "gamma1": 6, "gamma2": 7}
"""Lens parameters that are parameters of the fit as well, with their places; q and phi are there as ellipticities."""
_BOUND_ERROR = 1e-3
"""How far q or phi may stray beyond a bound that is asked for, which is no bound of an ellipticity."""
_LIGHT_STEPS = (1e-3, 1e-3, 1e-4, 1e-4, 1e-4, 1e-4)
_LENS_STEP, _EXACT_LENS_STEP = 1e-5, 1e-4
"""Integrated light is known to a part in a thousand of its peak: its differences need the longer step."""
_ANCHOR = 5e-4
"""Shift [arcsec] over which the difference of an AGN image from its stamp is taken for the same."""
_OUTSIDE = 24
"""Pixels round the image from which the PSF brings deflector light in."""


@dataclass(frozen=True)
class Layout:
    """Which components the model has, and where their parameters stand.

    The parameters are [AGN x, y ...][deflector: ln r_eff, n, e1, e2, x, y][lens: theta_E, e1, e2, slope, x, y and
    gamma1, gamma2 with shear][host: ln r_eff, n, e1, e2, x, y] with ellipticities e = (1 - q)/(1 + q); the amplitudes
    [AGN ...][deflector][host][background].
    """

    n_agn: int
    deflector: bool
    shear: bool

    @property
    def deflector_slice(self) -> slice:
        """Parameters of the deflector's light; empty where it has none."""
        return slice(2 * self.n_agn, 2 * self.n_agn + (6 if self.deflector else 0))

    @property
    def lens_slice(self) -> slice:
        """Parameters of the lens."""
        first = self.deflector_slice.stop
        return slice(first, first + (8 if self.shear else 6))

    @property
    def host_slice(self) -> slice:
        """Parameters of the host."""
        first = self.lens_slice.stop
        return slice(first, first + 6)

    @property
    def size(self) -> int:
        """Number of nonlinear parameters."""
        return int(self.host_slice.stop)

    @property
    def amplitudes(self) -> int:
        """Number of linear ones."""
        return self.n_agn + int(self.deflector) + 2

    @property
    def lens_names(self) -> tuple[str, ...]:
        """Names of the lens parameters as physicists have them."""
        return ("theta_E", "q", "phi", "slope", "x", "y", *(("gamma1", "gamma2") if self.shear else ()))


def ellipse(e1: float, e2: float) -> tuple[float, float]:
    """(q, phi) of ellipticity components e = (1 - q)/(1 + q)."""
    e = min(math.hypot(e1, e2), 0.9)
    return (1.0 - e) / (1.0 + e), 0.5 * math.atan2(e2, e1)


def components(q: float, phi: float) -> tuple[float, float]:
    """Ellipticity components of (q, phi)."""
    e = (1.0 - q) / (1.0 + q)
    return e * math.cos(2.0 * phi), e * math.sin(2.0 * phi)


def sersic_of(values: Sequence[float] | FloatArray, flux: float = 1.0) -> SersicProfile:
    """The profile of the parameters ln r_eff, n, e1, e2, x, y."""
    ln_r, n, e1, e2, x, y = map(float, values)
    return SersicProfile(flux, math.exp(ln_r), n, *ellipse(e1, e2), x, y)


def lens_of(values: Sequence[float] | FloatArray) -> PowerLawLens:
    """The lens of the parameters theta_E, e1, e2, slope, x, y (and gamma1, gamma2)."""
    theta_E, e1, e2, slope, x, y, *shear = map(float, values)
    return PowerLawLens(theta_E, *ellipse(e1, e2), slope, x, y, *shear)


class ImageModel:
    """Whitened columns of the amplitudes on a window of the image, and their derivatives.

    Parameters
    ----------
    observation : Observation
    layout : Layout
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
    """

    def __init__(
        self,
        observation: Observation,
        layout: Layout,
        sigma: FloatArray,
        window: tuple[slice, slice],
        *,
        subrays: int,
        exact: bool,
        priors: Mapping[LensParameterName, ParameterPrior] = MappingProxyType({}),
    ) -> None:
        self.observation, self.layout, self.window = observation, layout, window
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
        self._observed = image.ravel() * self.weight
        self.data = self._observed
        self.pixels = int(np.count_nonzero(self.weight))
        self._anchors: dict[int, tuple[float, float, FloatArray]] = {}
        self._deflector = lru_cache(maxsize=4)(self._render_deflector)
        self._host = lru_cache(maxsize=4)(self._render_host)

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

    def _light(self, profile: SersicProfile, lens: PowerLawLens | None, *, exact: bool) -> FloatArray:
        blur = self._outer if lens is None else self._inner
        if exact:
            fine = render_sersic(profile, blur.x, blur.y, blur.side, lens, RENDER_TOLERANCE)
        else:
            fine = sample_sersic(profile, lens, blur.x, blur.y, blur.side)
        return blur(fine, integrated=exact).ravel() * self.weight

    def _render_deflector(self, *values: float) -> FloatArray:
        return self._light(sersic_of(values), None, exact=self.exact)

    def _render_host(self, *values: float) -> FloatArray:
        split = len(values) - 6
        return self._light(sersic_of(values[split:]), lens_of(values[:split]), exact=self.exact)

    def correct(self, values: FloatArray) -> None:
        """Take off the data what the columns of deflector and host lack of their images through the exposures.

        A fit of the columns to these data is one with exact columns, as far as their error does not change with the
        parameters (defect correction): ``values`` should lie near the solution.
        """
        layout = self.layout
        amplitudes, _, _ = self.amplitudes(values)
        lens = lens_of(values[layout.lens_slice])
        flux = float(amplitudes[-2])
        host = self._host(*values[layout.lens_slice].tolist(), *values[layout.host_slice].tolist())
        lit: list[tuple[SersicProfile, PowerLawLens | None, float, FloatArray]] = [
            (sersic_of(values[layout.host_slice]), lens, flux, host)
        ]
        if layout.deflector:
            shape = values[layout.deflector_slice]
            lit.append((sersic_of(shape), None, float(amplitudes[layout.n_agn]), self._deflector(*shape.tolist())))
        defect = np.zeros(self.data.size)
        for profile, behind, brightness, column in lit:
            exact = self.observation.optics.sersic_image(profile, behind)[self.window]
            defect += brightness * (exact.ravel() * self.weight - column)
        self.data = self._observed - defect

    def columns(self, values: FloatArray) -> FloatArray:
        """Whitened columns (pixels, amplitudes)."""
        layout = self.layout
        positions = values[: 2 * layout.n_agn].reshape(-1, 2)
        out = [self._point(k, float(x), float(y)) for k, (x, y) in enumerate(positions)]
        if layout.deflector:
            out.append(self._deflector(*values[layout.deflector_slice].tolist()))
        out.append(self._host(*values[layout.lens_slice].tolist(), *values[layout.host_slice].tolist()))
        out.append(self.weight)
        return np.stack(out, axis=1)

    def amplitudes(self, values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Best amplitudes, whitened residuals, and the columns."""
        columns = self.columns(values)
        size = np.sqrt((columns**2).sum(axis=0))
        if not (size > 0).all():
            raise PosteriorError("parametric model: a component puts no light on the image")
        scaled = columns / size
        best = np.linalg.lstsq(scaled.T @ scaled, scaled.T @ self.data, rcond=1e-12)[0]
        return best / size, self.data - scaled @ best, columns

    def unwhitened(self, columns: FloatArray, amplitudes: FloatArray) -> FloatArray:
        """Image (ny, nx) [e-/s] of some of the whitened columns; zero where pixels do not count and off the window."""
        image = np.zeros(self.observation.shape)
        safe = np.where(self.weight > 0, self.weight, np.inf)
        image[self.window] = (columns @ amplitudes / safe).reshape(self.shape)
        return image

    def constraints(self, values: FloatArray) -> FloatArray:
        """Scatter of the AGN images in the source plane about the host, and the priors, each in its own error."""
        layout = self.layout
        lens, host = values[layout.lens_slice], values[layout.host_slice]
        out: list[FloatArray] = [
            np.array(_misfits(lens_of(lens), layout.lens_names, self.priors)),
            (lens[1:3]) / ELLIPTICITY_PRIOR,
            (lens[3:4] - SLOPE_PRIOR[0]) / (SLOPE_PRIOR[1] if _free("slope", self.priors) else math.inf),
            (lens[4:6] - (values[layout.deflector_slice][4:6] if layout.deflector else 0.0)) / CENTRE_PRIOR,
            lens[6:8] / SHEAR_PRIOR,
        ]
        if layout.n_agn:
            agn = values[: 2 * layout.n_agn].reshape(-1, 2)
            bx, by = source_position(lens_of(lens), agn[:, 0], agn[:, 1])
            out += [(bx - host[4]) / POSITION_ERROR, (by - host[5]) / POSITION_ERROR]
        return np.concatenate(out)

    def residuals(self, values: FloatArray) -> FloatArray:
        """Whitened residuals of the image, followed by :meth:`constraints`."""
        return np.concatenate([self.amplitudes(values)[1], self.constraints(values)])

    def jacobian(self, values: FloatArray, *, integrated: bool = False) -> FloatArray:
        """Derivatives of :meth:`residuals`, by differences of samples of the light or of its integrals.

        Samples cost a fifth. They are wrong by a tenth where a cusp is magnified, and always in the same sense: a fit
        may end where their gradient vanishes and that of chi^2 does not.
        """
        best, _, columns = self.amplitudes(values)
        moved = self._column_derivatives(values, best, integrated=integrated)
        basis, _ = np.linalg.qr(columns)
        moved -= basis @ (basis.T @ moved)
        return np.concatenate([-moved, _differences(self.constraints, values, 1e-6)])

    def full_jacobian(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Derivatives (rows, parameters + amplitudes) of data and constraints by all parameters; the amplitudes."""
        best, _, columns = self.amplitudes(values)
        rows = _differences(self.constraints, values, 1e-6)
        top = np.concatenate([self._column_derivatives(values, best, integrated=self.exact), columns], axis=1)
        below = np.concatenate([-rows, np.zeros((rows.shape[0], best.size))], axis=1)
        return np.concatenate([top, below]), best

    def _column_derivatives(self, values: FloatArray, best: FloatArray, *, integrated: bool) -> FloatArray:
        """Change (pixels, parameters) of the whitened model with each nonlinear parameter."""
        layout = self.layout
        out = np.empty((self.data.size, layout.size))
        for k in range(layout.n_agn):
            x, y = map(float, values[2 * k : 2 * k + 2])
            out[:, 2 * k] = best[k] * self._stamp(x, y, "column")
            out[:, 2 * k + 1] = best[k] * self._stamp(x, y, "row")
        if layout.deflector:
            where = layout.deflector_slice
            out[:, where] = best[layout.n_agn] * self._slopes(
                lambda v: self._light(sersic_of(v), None, exact=integrated), values[where], _LIGHT_STEPS
            )
        lens_values, host_values = values[layout.lens_slice], values[layout.host_slice]
        lens, host = lens_of(lens_values), sersic_of(host_values)
        flux = best[-2]
        out[:, layout.lens_slice] = flux * self._slopes(
            lambda v: self._light(host, lens_of(v), exact=integrated),
            lens_values,
            (_EXACT_LENS_STEP if integrated else _LENS_STEP,) * lens_values.size,
        )
        out[:, layout.host_slice] = flux * self._slopes(
            lambda v: self._light(sersic_of(v), lens, exact=integrated), host_values, _LIGHT_STEPS
        )
        return out

    @staticmethod
    def _slopes(render: Callable[[FloatArray], FloatArray], values: FloatArray, steps: Sequence[float]) -> FloatArray:
        here = render(values)
        out = np.empty((here.size, values.size))
        for k, step in enumerate(steps):
            shifted = values.copy()
            shifted[k] += step
            out[:, k] = (render(shifted) - here) / step
        return out


def _free(name: LensParameterName, priors: Mapping[LensParameterName, ParameterPrior]) -> bool:
    """Whether nothing but bounds is known of a parameter."""
    return name not in priors or priors[name].mean is None


def _misfits(
    lens: PowerLawLens, names: Sequence[str], priors: Mapping[LensParameterName, ParameterPrior]
) -> list[float]:
    """Departures of a lens from its priors in their deviations, of q and phi from bounds in :data:`_BOUND_ERROR`."""
    out: list[float] = []
    for name, prior in priors.items():
        if name not in names:
            continue
        value = float(getattr(lens, name))
        for bound, side in ((prior.low, -1.0), (prior.high, 1.0)):
            if bound is not None and name not in OWN_PARAMETER:
                beyond = math.remainder(value - bound, math.pi) if name == "phi" else value - bound
                out.append(max(side * beyond, 0.0) / _BOUND_ERROR)
        if prior.mean is not None and prior.sd is not None:
            away = value - prior.mean
            out.append((math.remainder(away, math.pi) if name == "phi" else away) / prior.sd)
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
