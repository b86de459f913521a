"""A parametric model of the whole image: AGN images, deflector, ray-traced Sersic host and a background.

It supplies what the inversion keeps fixed (AGN positions, the deflector's shape) and where its posterior starts. The
fluxes are linear and are solved for at every step (variable projection), the rest is a bounded least-squares problem.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.optimize import least_squares

from engine.conventions import FloatArray, pixel_centres
from engine.errors import PosteriorError
from engine.imaging.blurring import convolve
from engine.imaging.extended import lensed_sersic_image
from engine.imaging.observation import Observation
from engine.inversion.blurring import central_stamp, pixel_kernel
from engine.lensing.power_law import PowerLawLens, source_position
from engine.light.rendering import render_sersic, sample_lensed_sersic
from engine.light.sersic import SersicProfile
from engine.modelling.lens_start import lens_from_positions
from engine.modelling.point_sources import Detection, find_point_sources

_HOST_SUBRAYS = 3
_KERNEL_RADIUS = 20
_STAMP_ERROR = 0.03
"""Error of a shifted PSF stamp as a fraction of the AGN's light: keeps the cores from driving the fit."""
_RESPONSE_ERROR = 0.002
"""The same where the exposures are known: what errors of position leave."""
_POSITION_ERROR = 0.01
"""Image-plane accuracy [arcsec] asked of the AGN images as images of one source."""
_CORRECTIONS = 2
"""Rounds in which the quick images of deflector and host are corrected by their exact ones."""
_MAX_ELLIPTICITY = 0.6


@dataclass(frozen=True)
class ParametricFit:
    """The best parametric model of an observation.

    ``host.flux`` and ``deflector.flux`` are the fitted fluxes [e-/s]; ``agn`` are the fitted positions and fluxes;
    ``lens_covariance`` (k, k) is that of the lens parameters in the order of ``lens_names``; ``chi2`` counts all
    valid pixels with the PSF error added to their noise.
    """

    lens: PowerLawLens
    host: SersicProfile
    deflector: SersicProfile | None
    agn: tuple[Detection, ...]
    background: float
    lens_names: tuple[str, ...]
    lens_covariance: FloatArray
    chi2: float
    degrees_of_freedom: int
    evaluations: int


def _ellipse(e1: float, e2: float) -> tuple[float, float]:
    """(q, phi) of ellipticity components e = (1 - q)/(1 + q)."""
    e = min(math.hypot(e1, e2), 0.9)
    return (1.0 - e) / (1.0 + e), 0.5 * math.atan2(e2, e1)


def _components(q: float, phi: float) -> tuple[float, float]:
    e = (1.0 - q) / (1.0 + q)
    return e * math.cos(2.0 * phi), e * math.sin(2.0 * phi)


class _ImageModel:
    """Whitened columns of the linear amplitudes as functions of the nonlinear parameters of each component.

    The parameters are laid out as [AGN x, y ...][deflector 6][lens 6 or 8][host 6]; a component that the scene lacks
    has none. Columns are remembered for the last few parameter values, because a numerical Jacobian changes one
    component at a time.
    """

    def __init__(
        self, observation: Observation, detections: Sequence[Detection], *, deflector: bool, shear: bool
    ) -> None:
        self.observation = observation
        self.has_deflector = deflector
        self.shear = shear
        ny, nx = observation.image.shape
        scale = observation.pixel_scale
        self.x, self.y = pixel_centres(nx, scale), pixel_centres(ny, scale)
        stamp = central_stamp(observation.psf, _KERNEL_RADIUS)
        self.sampled_kernel = pixel_kernel(stamp, _HOST_SUBRAYS)
        self.integrated_kernel = pixel_kernel(stamp, None)
        psf_error = _STAMP_ERROR if observation.response is None else _RESPONSE_ERROR
        agn_light = np.zeros((ny, nx))
        for found in detections:
            agn_light += found.flux * observation.point_source(found.x, found.y)
        sigma = np.where(observation.valid, np.hypot(observation.noise, psf_error * agn_light), 1.0)
        self.weight = np.where(observation.valid, 1.0 / sigma, 0.0).ravel()
        self.observed = np.where(observation.valid, observation.image, 0.0).ravel() * self.weight
        self.data = self.observed
        self.n_agn = len(detections)
        self.agn_size = 2 * self.n_agn
        self.deflector_size = 6 if deflector else 0
        self.lens_size = 8 if shear else 6
        self._agn_column = lru_cache(maxsize=4 * max(self.n_agn, 1))(self._render_agn)
        self._deflector_column = lru_cache(maxsize=4)(self._render_deflector)
        self._host_column = lru_cache(maxsize=4)(self._render_host)

    def _render_agn(self, x: float, y: float) -> FloatArray:
        return self.observation.point_source(x, y).ravel() * self.weight

    def _render_deflector(self, *values: float) -> FloatArray:
        image = render_sersic(self.deflector_of(values), self.x, self.y, self.observation.pixel_scale, tolerance=1e-3)
        return convolve(image, self.integrated_kernel).ravel() * self.weight

    def _render_host(self, *values: float) -> FloatArray:
        lens, host = self.lens_of(values[: self.lens_size]), self.host_of(values[self.lens_size :])
        image = sample_lensed_sersic(host, lens, self.x, self.y, self.observation.pixel_scale, _HOST_SUBRAYS)
        return convolve(image, self.sampled_kernel).ravel() * self.weight

    def deflector_of(self, values: Sequence[float] | FloatArray, flux: float = 1.0) -> SersicProfile:
        """The deflector's profile of its parameters ln r_eff, n, e1, e2, x, y."""
        ln_r, n, e1, e2, x, y = map(float, values)
        return SersicProfile(flux, math.exp(ln_r), n, *_ellipse(e1, e2), x, y)

    def host_of(self, values: Sequence[float] | FloatArray, flux: float = 1.0) -> SersicProfile:
        """The host's profile of its parameters ln r_eff, n, e1, e2, x, y."""
        return self.deflector_of(values, flux)

    def lens_of(self, values: Sequence[float] | FloatArray) -> PowerLawLens:
        """The lens of its parameters theta_E, e1, e2, slope, x, y (and gamma1, gamma2)."""
        theta_E, e1, e2, slope, x, y, *shear = map(float, values)
        q, phi = _ellipse(e1, e2)
        return PowerLawLens(theta_E, q, phi, slope, x, y, *shear)

    def correct(self, values: FloatArray) -> None:
        """Take off the data what the quick columns of deflector and host lack of their exact images at ``values``.

        A fit to the corrected data with the quick columns is one with exact columns, as far as their error does not
        change with the parameters (defect correction).
        """
        amplitudes, _ = self.amplitudes(values)
        _, deflector, lens, host = self.split(values)
        lensed = self.host_of(host, float(amplitudes[-2]))
        defect = lensed_sersic_image(self.observation, lensed, self.lens_of(lens)).ravel() * self.weight
        defect -= amplitudes[-2] * self._host_column(*lens.tolist(), *host.tolist())
        if self.has_deflector:
            light = self.deflector_of(deflector, float(amplitudes[-3]))
            defect += lensed_sersic_image(self.observation, light).ravel() * self.weight
            defect -= amplitudes[-3] * self._deflector_column(*deflector.tolist())
        self.data = self.observed - defect

    def split(self, values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """The parameter vector as AGN positions (k, 2), deflector, lens and host parameters."""
        a, b = self.agn_size, self.agn_size + self.deflector_size
        c = b + self.lens_size
        return values[:a].reshape(-1, 2), values[a:b], values[b:c], values[c:]

    def columns(self, values: FloatArray) -> FloatArray:
        """Whitened columns (pixels, amplitudes): AGN images, deflector, host, background."""
        agn, deflector, lens, host = self.split(values)
        out = [self._agn_column(float(x), float(y)) for x, y in agn]
        if self.has_deflector:
            out.append(self._deflector_column(*deflector.tolist()))
        out.append(self._host_column(*lens.tolist(), *host.tolist()))
        out.append(self.weight)
        return np.stack(out, axis=1)

    def amplitudes(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Best amplitudes and whitened residuals."""
        columns = self.columns(values)
        size = np.sqrt((columns**2).sum(axis=0))
        if not (size > 0).all():
            raise PosteriorError("parametric model: a component puts no light on the image")
        scaled = columns / size
        best = np.linalg.solve(scaled.T @ scaled, scaled.T @ self.data)
        return best / size, self.data - scaled @ best

    def residuals(self, values: FloatArray) -> FloatArray:
        """Whitened residuals, followed by the scatter of the AGN images mapped to the source plane."""
        _, rest = self.amplitudes(values)
        agn, _, lens_values, host = self.split(values)
        if not self.n_agn:
            return rest
        bx, by = source_position(self.lens_of(lens_values), agn[:, 0], agn[:, 1])
        scatter = np.concatenate([bx - host[4], by - host[5]]) / _POSITION_ERROR
        return np.concatenate([rest, scatter])


def _start_vector(
    model: _ImageModel, detections: Sequence[Detection], lens: PowerLawLens, source: FloatArray
) -> FloatArray:
    values: list[float] = [coordinate for found in detections for coordinate in (found.x, found.y)]
    if model.has_deflector:
        values += [math.log(lens.theta_E), 4.0, 0.0, 0.01, 0.0, 0.0]
    values += [lens.theta_E, *_components(lens.q, lens.phi), lens.slope, 0.0, 0.0]
    values += [0.0, 0.0] if model.shear else []
    values += [math.log(0.3 * lens.theta_E), 2.0, 0.0, 0.01, float(source[0]), float(source[1])]
    return np.array(values)


def _bounds(model: _ImageModel, start: FloatArray, theta_E: float) -> tuple[FloatArray, FloatArray]:
    scale = model.observation.pixel_scale
    e = _MAX_ELLIPTICITY
    half = [(value - 1.5 * scale, value + 1.5 * scale) for value in start[: model.agn_size].tolist()]
    if model.has_deflector:
        half += [(math.log(0.03), math.log(20.0)), (0.5, 9.0), (-e, e), (-e, e), (-0.3, 0.3), (-0.3, 0.3)]
    half += [(0.5 * theta_E, 1.6 * theta_E), (-e, e), (-e, e), (1.3, 2.7), (-0.3, 0.3), (-0.3, 0.3)]
    half += [(-0.4, 0.4), (-0.4, 0.4)] if model.shear else []
    half += [(math.log(0.02), math.log(5.0)), (0.5, 8.0), (-e, e), (-e, e)]
    half += [(start[-2] - theta_E, start[-2] + theta_E), (start[-1] - theta_E, start[-1] + theta_E)]
    low, high = np.array(half).T
    return low, high


def _lens_covariance(model: _ImageModel, jacobian: FloatArray, values: FloatArray) -> FloatArray:
    """Covariance of (theta_E, q, phi, slope, x, y, shear) from the inverse of J^T J, by the chain rule."""
    scale = np.sqrt((jacobian**2).sum(axis=0))
    scale[scale == 0.0] = 1.0
    scaled = jacobian / scale
    inverse = np.linalg.pinv(scaled.T @ scaled, rcond=1e-12) / np.outer(scale, scale)
    first = model.agn_size + model.deflector_size
    block = slice(first, first + model.lens_size)
    covariance = inverse[block, block]
    _, e1, e2, *_ = values[block]
    e = max(math.hypot(e1, e2), 1e-4)
    chain = np.eye(model.lens_size)
    slope_q = -2.0 / (1.0 + e) ** 2
    chain[1, 1:3] = slope_q * e1 / e, slope_q * e2 / e
    chain[2, 1:3] = -0.5 * e2 / e**2, 0.5 * e1 / e**2
    return np.asarray(chain @ covariance @ chain.T)


def fit_parametric(
    observation: Observation, *, agn_images: int, deflector: bool = True, shear: bool = False
) -> ParametricFit:
    """Find the AGN images and fit the parametric model, from nothing but the observation.

    Parameters
    ----------
    observation : Observation
    agn_images : int
        Number of AGN images to look for.
    deflector, shear : bool
        Whether the deflector shines and whether the lens has external shear: a component that is absent is not built.

    Raises
    ------
    ObservationError
        The AGN images are not found.
    PosteriorError
        The fit has no acceptable solution.
    """
    noise = np.where(observation.valid, observation.noise, np.median(observation.noise[observation.valid]))
    detections = find_point_sources(
        np.where(observation.valid, observation.image, 0.0), noise, observation.psf, observation.pixel_scale, agn_images
    )
    lens, source = lens_from_positions([(found.x, found.y) for found in detections])
    model = _ImageModel(observation, detections, deflector=deflector, shear=shear)
    start = _start_vector(model, detections, lens, source)
    low, high = _bounds(model, start, lens.theta_E)
    start = np.clip(start, low + 1e-6, high - 1e-6)
    fit = least_squares(
        model.residuals, start, bounds=(low, high), x_scale="jac", loss="linear", xtol=1e-6, ftol=1e-6, max_nfev=60
    )
    for _ in range(_CORRECTIONS):
        model.correct(fit.x)
        fit = least_squares(
            model.residuals, fit.x, bounds=(low, high), x_scale="jac", xtol=1e-6, ftol=1e-6, max_nfev=20
        )
    amplitudes, rest = model.amplitudes(fit.x)
    agn, deflector_values, lens_values, host_values = model.split(fit.x)
    host_flux, background = float(amplitudes[-2]), float(amplitudes[-1])
    if not host_flux > 0:
        raise PosteriorError(f"parametric model: the host's flux is {host_flux:.3g} e-/s, a positive one is needed")
    names = ("theta_E", "q", "phi", "slope", "x", "y", *(("gamma1", "gamma2") if shear else ()))
    return ParametricFit(
        lens=model.lens_of(lens_values.tolist()),
        host=model.host_of(host_values.tolist(), host_flux),
        deflector=(model.deflector_of(deflector_values.tolist(), float(amplitudes[agn_images])) if deflector else None),
        agn=tuple(
            Detection(float(x), float(y), float(flux), found.significance)
            for (x, y), flux, found in zip(agn, amplitudes[:agn_images], detections, strict=True)
        ),
        background=background,
        lens_names=names,
        lens_covariance=_lens_covariance(model, fit.jac, fit.x),
        chi2=float(rest @ rest),
        degrees_of_freedom=int(observation.valid.sum()) - fit.x.size - amplitudes.size,
        evaluations=int(fit.nfev),
    )
