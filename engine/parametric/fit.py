"""A parametric fit of the whole image: AGN images, deflector, ray-traced Sersic host and a background.

It supplies what the inversion keeps fixed (AGN positions, the deflector's shape) and where its posterior starts. Quick
fits from several deterministic starts on a window of the image come first; the best are fitted to the whole of it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import least_squares

from engine.conventions import FloatArray, pixel_centres
from engine.errors import ObservationError, PosteriorError, SpecError
from engine.imaging.observation import Observation
from engine.lensing.power_law import PowerLawLens
from engine.light.sersic import SersicProfile
from engine.parametric.host_posterior import HostPosterior
from engine.parametric.model import (
    OWN_PARAMETER,
    POSITION_ERROR,
    ImageModel,
    Layout,
    components,
    lens_of,
    sersic_of,
    weights_sigma,
    window_round,
)
from engine.parametric.point_sources import Detection, candidate_point_sources
from engine.parametric.psf_error import extended_variance, measured_stamp_error, noise_scale, stamp_variance
from engine.parametric.starts import (
    Start,
    agn_hypotheses,
    deflector_centre,
    filled_image,
    ring_radii,
    starts_from_agn,
    starts_from_arc,
)
from engine.result import INDEX_RANGES, IndexPrior
from engine.spec.priors import LensParameterName, ParameterPrior

_QUICK_SUBRAYS, _SUBRAYS = 1, 2
_QUICK_WINDOW = 1.6
"""Half-width of the window of the quick fits in Einstein radii, to which a margin comes."""
_QUICK_MARGIN = 0.5
_QUICK_STEPS, _STEPS, _INTEGRATED_STEPS = 15, 40, 15
_SAMPLED_TOLERANCE, _TOLERANCE = 1e-4, 1e-6
"""Relative change of cost or parameters at which a fit with derivatives of samples, or of integrals, ends."""
_HOPELESS = 2.0
"""Times what is acceptable from which on a fit is not worth the derivatives of integrated light."""
_SHEAR_SHOWS = 4.0
"""Square of the shear in its errors below which a lens is taken to have none: two a component, as of the AIC.

Dropping a shear that there is biases all of the lens, keeping one that there is not costs a little precision.
"""
_RIVAL = 2.0
"""BIC of a quick fit, of that of the best, up to which another number of AGN images is still a rival."""
_STAMP_CORRELATION = 2.0
"""Pixels over which the error of a stamp stays the same, as the standard deviation of a Gaussian."""
_MAX_ELLIPTICITY = 0.6
_CORRECTIONS = 2
"""Rounds in which the images of deflector and host are corrected by those through the exposures, if these are known."""
_MOST_CANDIDATES = 6
_AGN_NUMBERS = (4, 3, 2, 0)
_ARC_STARTS = 4
_BORDER = 3
_LEAST_ROOM = 1e-5
"""Between two bounds: least squares want some."""
_RADII, _LEAST_RADIUS = 3.0, 2.5
"""The image is fitted within so many Einstein radii, at least so many arcsec, and not in so many border pixels."""
_FEWEST_RADII = 2.2
"""Einstein radii that are fitted even where stamps of AGN images end in them."""
HOST_NAMES = ("flux", "r_eff", "n", "q", "phi", "x", "y")


@dataclass(frozen=True)
class Acceptance:
    """How bad a fit may be: chi^2 per degree of freedom; farthest that an AGN image maps from the host [arcsec]."""

    chi2_per_dof: float = 4.0
    miss: float = 0.05


GOOD_START = Acceptance()


@dataclass(frozen=True)
class ParametricFit:
    """The best parametric model of an observation.

    ``host.flux`` and ``deflector.flux`` are the fitted fluxes [e-/s]; ``agn`` are the fitted positions and fluxes;
    ``lens_covariance`` (k, k) is that of the lens parameters in the order of ``lens_names``, ``host_covariance`` (7, 7)
    that of the host's in the order of :data:`HOST_NAMES`, both with all other parameters free and multiplied by
    chi^2 per degree of freedom where that is above one. ``chi2`` counts the fitted pixels with ``sigma`` (ny, nx),
    their noise and the error of the PSF, infinite where a pixel was not fitted; ``stamp_error`` is how many times
    what is allowed for moved stamps the residuals at AGN images show. ``hosts`` are the posteriors of the host with
    each prior of n, without those that could not be fitted. ``model`` and ``arc`` are images (ny, nx) of everything and
    of the lensed host [e-/s].
    """

    lens: PowerLawLens
    host: SersicProfile
    deflector: SersicProfile | None
    agn: tuple[Detection, ...]
    background: float
    lens_names: tuple[str, ...]
    lens_covariance: FloatArray
    host_covariance: FloatArray
    hosts: Mapping[IndexPrior, HostPosterior]
    chi2: float
    degrees_of_freedom: int
    evaluations: int
    stamp_error: float
    at_bound: tuple[str, ...]
    model: FloatArray
    arc: FloatArray
    sigma: FloatArray

    @property
    def misfit(self) -> float:
        """chi^2 per degree of freedom where it is above one: by this the variances are larger than ``sigma`` says."""
        return max(1.0, self.chi2 / self.degrees_of_freedom)


@dataclass(frozen=True)
class _Solution:
    """A minimum between bounds: the model it belongs to, its parameters and its cost (chi^2 and priors).

    ``stamp_error`` is the error of the AGN's stamps that its noise map holds, in units of what is allowed for.
    """

    model: ImageModel
    values: FloatArray
    low: FloatArray
    high: FloatArray
    cost: float
    evaluations: int
    start: Start
    stamp_error: float = 1.0


def _start_vector(layout: Layout, start: Start, centre: tuple[float, float]) -> FloatArray:
    lens = start.lens
    values: list[float] = [coordinate for found in start.agn for coordinate in (found.x, found.y)]
    if layout.deflector:
        values += [math.log(lens.theta_E), 4.0, 0.0, 0.01, *centre]
    values += [lens.theta_E, *components(lens.q, lens.phi), lens.slope, lens.x, lens.y]
    values += [lens.gamma1, lens.gamma2] if layout.shear else []
    values += [math.log(start.host_radius * lens.theta_E), 2.0, 0.0, 0.01, *start.source]
    return np.array(values)


def _bounds(model: ImageModel, start: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest parameters of a fit from ``start``, those of the priors included that have a parameter."""
    layout, pixel_scale, e = model.layout, model.observation.pixel_scale, _MAX_ELLIPTICITY
    x, y = start[layout.lens_slice][4:6].tolist()
    theta_E = float(start[layout.lens_slice][0])
    near = [(x - 0.4, x + 0.4), (y - 0.4, y + 0.4)]
    half = [(value - 2.0 * pixel_scale, value + 2.0 * pixel_scale) for value in start[: 2 * layout.n_agn].tolist()]
    if layout.deflector:
        half += [(math.log(0.03), math.log(20.0)), (0.5, 9.0), (-e, e), (-e, e), *near]
    half += [(0.4 * theta_E, 1.8 * theta_E), (-e, e), (-e, e), (1.3, 2.7), *near]
    half += [(-0.4, 0.4), (-0.4, 0.4)] if layout.shear else []
    half += [(math.log(0.02), math.log(5.0)), INDEX_RANGES["wide"], (-e, e), (-e, e)]
    half += [(x - theta_E, x + theta_E), (y - theta_E, y + theta_E)]
    low, high = np.array(half).T
    first = layout.lens_slice.start
    for name, prior in model.priors.items():
        if name in OWN_PARAMETER and first + OWN_PARAMETER[name] < layout.lens_slice.stop:
            k = first + OWN_PARAMETER[name]
            low[k] = low[k] if prior.low is None else min(max(low[k], prior.low), high[k] - _LEAST_ROOM)
            high[k] = high[k] if prior.high is None else max(min(high[k], prior.high), low[k] + _LEAST_ROOM)
    return low, high


def _minimise(
    model: ImageModel,
    start: Start,
    values: FloatArray,
    steps: int,
    tolerance: float,
    *,
    integrated: bool = False,
) -> _Solution:
    """Least squares; with ``integrated`` the derivatives are those of the integrated light, not of samples."""
    low, high = _bounds(model, values)
    inside = np.clip(values, low + 1e-6, high - 1e-6)
    fit = least_squares(
        model.residuals, inside, partial(model.jacobian, integrated=integrated), (low, high), x_scale="jac",
        xtol=tolerance, ftol=tolerance, max_nfev=steps,
    )  # fmt: skip
    return _Solution(model, fit.x, low, high, 2.0 * float(fit.cost), int(fit.nfev), start)


def _minimise_held(solution: _Solution, values: FloatArray, at: int, held: float) -> _Solution:
    """The minimum with parameter ``at`` held, from other values of the rest."""
    model = solution.model
    low, high = (np.delete(side, at) for side in (solution.low, solution.high))

    def whole(free: FloatArray) -> FloatArray:
        return np.insert(free, at, held)

    fit = least_squares(
        lambda free: model.residuals(whole(free)),
        np.clip(np.delete(values, at), low + 1e-6, high - 1e-6),
        lambda free: np.delete(model.jacobian(whole(free), integrated=True), at, axis=1),
        (low, high),
        x_scale="jac",
        xtol=_TOLERANCE,
        ftol=_TOLERANCE,
        max_nfev=_INTEGRATED_STEPS,
    )
    return replace(solution, values=whole(fit.x), cost=2.0 * float(fit.cost), evaluations=int(fit.nfev))


def _stamp_radius(psf: FloatArray) -> int:
    """Pixels from the middle of a stamp to the nearest side of what is not padding."""
    rows, columns = (np.flatnonzero(np.any(psf != 0, axis=axis)) for axis in (1, 0))
    middle = psf.shape[0] // 2
    return int(min(middle - rows[0], rows[-1] - middle, middle - columns[0], columns[-1] - middle))


def _refuse(options: dict[str, tuple[object, bool, str]]) -> None:
    for name, (value, good, allowed) in options.items():
        if not good:
            raise SpecError(name, value, allowed)


def fit_parametric(
    observation: Observation,
    *,
    agn_images: int | None = None,
    deflector: bool = True,
    shear: bool | None = False,
    theta_E: float | None = None,
    positions: Sequence[tuple[float, float]] | None = None,
    acceptance: Acceptance = GOOD_START,
    priors: Mapping[LensParameterName, ParameterPrior] = MappingProxyType({}),
    fixed_index: float | None = None,
) -> ParametricFit:
    """Find lens, AGN images and host, from nothing but the observation.

    Parameters
    ----------
    observation : Observation
    agn_images : int, optional
        Number of AGN images; where None, four, three, two and none are tried and the least BIC decides.
    deflector : bool
        Whether the deflector shines: a component that is absent is not built.
    shear : bool, optional
        Whether the lens has external shear; where None it has where the fit's differs from none.
    theta_E : float, optional
        Rough Einstein radius [arcsec].
    positions : sequence of (x, y), optional
        Rough positions of the AGN images [arcsec, image frame]; then ``agn_images`` is their number.
    acceptance : Acceptance
        How bad a fit may be that is handed on.
    priors : mapping, optional
        What is known of lens parameters, by name, instead of the wide priors that hold otherwise.
    fixed_index : float, optional
        An index at which the host's n is held for one more of its posteriors.

    Raises
    ------
    ObservationError
        The AGN images are not found.
    PosteriorError
        No start leads to an acceptable fit; the message says what is wrong with the best.
    """
    finder = _Finder(observation, deflector=deflector, shear=shear, acceptance=acceptance, priors=priors)
    radius = min(observation.shape) * observation.pixel_scale / 2
    _refuse(
        {
            "agn_images": (agn_images, agn_images is None or 0 <= agn_images <= 8, "a number from 0 to 8"),
            "theta_E": (theta_E, theta_E is None or 0 < theta_E < radius, f"a radius on the image, below {radius:g}"),
        }
    )
    groups = finder.starts(agn_images, theta_E, positions)
    refusals: list[str] = []
    for wave in (groups, [_varied(group) for group in groups]):
        for solution in finder.ranked([finder.quick(group) for group in wave]):
            try:
                return finder.result(finder.polish(solution), fixed_index)
            except PosteriorError as error:
                refusals.append(str(error))
    raise PosteriorError("; then ".join(dict.fromkeys(refusals)) or "parametric model: no start has a positive host")


def _information(solution: _Solution) -> float:
    """The BIC less what is common to all solutions on one image."""
    return solution.cost + 3 * solution.model.layout.n_agn * math.log(solution.model.pixels)


def _varied(group: list[Start]) -> list[Start]:
    """More starts for where the first ones led nowhere: other slopes, a smaller and a larger host, shear."""
    seeds = group if len(group) <= _ARC_STARTS else group[:: max(1, len(group) // _ARC_STARTS)]
    out = []
    for start in seeds:
        for slope, radius in ((1.8, 0.3), (2.2, 0.3), (2.0, 0.1), (2.0, 0.6)):
            lens = start.lens.with_values(slope=slope, gamma1=0.01)
            out.append(replace(start, lens=lens, host_radius=radius))
    return out


class _Finder:
    """The stages of the search for one observation."""

    def __init__(
        self,
        observation: Observation,
        *,
        deflector: bool,
        shear: bool | None,
        acceptance: Acceptance,
        priors: Mapping[LensParameterName, ParameterPrior],
    ) -> None:
        self.observation, self.has_deflector, self.acceptance = observation, deflector, acceptance
        self.shear, self.may_shear = shear, shear is not False
        self.priors = priors
        self.image = filled_image(observation)
        self.noise = np.where(
            observation.valid, observation.noise, float(np.median(observation.noise[observation.valid]))
        )
        shining = deflector_centre(self.image, observation.pixel_scale) if deflector else None
        # A lens whose light shows nowhere near the middle is looked for there all the same.
        self.centre = (0.0, 0.0) if shining is None else shining
        self.evaluations = 0

    def _candidates(self, most: int) -> tuple[Detection, ...]:
        observation = self.observation
        return candidate_point_sources(
            self.image, self.noise, observation.psf, observation.pixel_scale, most, self.centre
        )

    def starts(
        self, number: int | None, theta_E: float | None, positions: Sequence[tuple[float, float]] | None
    ) -> list[list[Start]]:
        """Starts of each hypothesis about the AGN images."""
        if positions is not None:
            agn = tuple(Detection(float(x), float(y), self._flux_at(x, y), math.inf) for x, y in positions)
            hypotheses = [agn]
        else:
            candidates = self._candidates(max(_MOST_CANDIDATES, number or 0))
            if number is not None and len(candidates) < number:
                raise ObservationError(f"agn: found {len(candidates)} point sources of {number}, at five sigma or more")
            hypotheses = agn_hypotheses(candidates, _AGN_NUMBERS if number is None else (number,), self.centre)
        groups = []
        for agn in hypotheses:
            if len(agn) >= 2:
                groups.append(starts_from_agn(agn, self.centre))
            else:
                rough = (theta_E,) if theta_E else ring_radii(self.image, self.observation.pixel_scale, self.centre)
                groups.append([start for radius in rough for start in starts_from_arc(radius, self.centre, agn)])
        return groups

    def _fitted(self, lens: PowerLawLens, agn: Sequence[Detection]) -> NDArray[np.bool_]:
        """Pixels (ny, nx) of the final fit: a circle.

        Nobody knows what shines into the image's border; and where the stamp of an AGN image ends, its light does not.
        """
        scale, (ny, nx) = self.observation.pixel_scale, self.observation.shape
        x, y = pixel_centres(nx, scale), pixel_centres(ny, scale)
        frame = 0.5 * min(ny, nx) * scale - _BORDER * scale
        reach = max((math.hypot(found.x - lens.x, found.y - lens.y) for found in agn), default=0.0)
        stamp = max(_stamp_radius(self.observation.psf) * scale - reach, _FEWEST_RADII * lens.theta_E)
        whole = not agn or self.observation.response is not None
        radius = min(frame, frame if whole else stamp, max(_LEAST_RADIUS, _RADII * lens.theta_E))
        return np.asarray(np.hypot(y[:, None] - lens.y, x[None, :] - lens.x) <= radius)

    def _flux_at(self, x: float, y: float) -> float:
        observation = self.observation
        star = observation.point_source(x, y)
        return max(float((star * self.image).sum() / (star * star).sum()), 0.0)

    def quick(self, group: list[Start]) -> list[_Solution]:
        """Quick fits from a group of starts, of which a long one is cut down by linear fits first."""
        observation = self.observation
        first = group[0]
        reach = max(start.lens.theta_E for start in group)
        reach = max([reach, *(math.hypot(d.x - self.centre[0], d.y - self.centre[1]) for d in first.agn)])
        window = window_round(
            observation.shape, observation.pixel_scale, self.centre, _QUICK_WINDOW * reach + _QUICK_MARGIN
        )
        # Without it an arc that was sheared ends in one of several false minima, far from the true lens.
        layout = Layout(len(first.agn), self.has_deflector, shear=self.may_shear or first.lens.gamma1 != 0.0)
        # One noise map for all hypotheses, or their chi^2 could not be compared.
        sigma = weights_sigma(observation, stamp_variance(observation, self._candidates(4)))
        model = ImageModel(observation, layout, sigma, window, subrays=_QUICK_SUBRAYS, exact=False)
        if len(group) > 2 * _ARC_STARTS:
            group = self._best_linear(model, group)
        out = []
        for start in group:
            try:
                found = _minimise(model, start, _start_vector(layout, start, self.centre), _QUICK_STEPS, 1e-4)
            except PosteriorError:
                continue
            self.evaluations += found.evaluations
            if model.amplitudes(found.values)[0][-2] > 0:
                out.append(found)
        return out

    def _best_linear(self, model: ImageModel, group: list[Start]) -> list[Start]:
        """The best starts by the linear fit alone, no two of them of the same lens."""
        rated: list[tuple[float, int, Start]] = []
        for start in group:
            amplitudes, rest, _ = model.amplitudes(_start_vector(model.layout, start, self.centre))
            if amplitudes[-2] > 0:
                rated.append((float(rest @ rest), len(rated), start))
        chosen: list[Start] = []
        for _, _, start in sorted(rated):
            if all(start.lens != other.lens for other in chosen):
                chosen.append(start)
            if len(chosen) == _ARC_STARTS:
                break
        return chosen

    def ranked(self, groups: list[list[_Solution]]) -> list[_Solution]:
        """The two solutions to go on with, the better one first.

        A quick fit takes the cusp of a host, or what shear does to an arc, for AGN images; so the best quick fits with
        each number of them that is not out of the question, and that without, are compared as fits of full accuracy
        on one noise map.
        """
        best = sorted((min(group, key=_information) for group in groups if group), key=_information)
        if len(best) == 1:
            return sorted((solution for group in groups for solution in group), key=_information)[:2]
        with_agn = [solution for solution in best if solution.model.layout.n_agn]
        chosen = [solution for solution in best if not solution.model.layout.n_agn]
        chosen += [s for s in with_agn if _information(s) < _RIVAL * _information(with_agn[0])]
        if len(chosen) < 2:
            return best[:2]
        sigma = self._sigma(with_agn[0] if with_agn else chosen[0])
        full = [self._full(solution, sigma, shear=self.may_shear) for solution in chosen]
        return sorted(full, key=_information)[:2]

    def _full(self, solution: _Solution, sigma: FloatArray, *, shear: bool) -> _Solution:
        """The fit of the whole image that begins where another ended."""
        layout = solution.model.layout
        values = _with_shear(solution.values, layout, shear=shear)
        model = self._model(replace(layout, shear=shear), sigma)
        found = _minimise(model, solution.start, values, _STEPS, _SAMPLED_TOLERANCE)
        self.evaluations += found.evaluations
        if found.cost <= _HOPELESS * self.acceptance.chi2_per_dof * model.pixels:
            found = _minimise(model, solution.start, found.values, _INTEGRATED_STEPS, _TOLERANCE, integrated=True)
            self.evaluations += found.evaluations
        return replace(found, stamp_error=solution.stamp_error)

    def _variances(self, solution: _Solution) -> tuple[FloatArray, FloatArray]:
        """Variance (ny, nx) allowed for the stamps of the AGN images as they were fitted, and for extended light."""
        values, layout = solution.values, solution.model.layout
        amplitudes, _, columns = solution.model.amplitudes(values)
        stamps = stamp_variance(self.observation, _fitted_agn(layout, values, amplitudes, solution.start.agn))
        extended = slice(layout.n_agn, -1)
        light = solution.model.unwhitened(columns[:, extended], amplitudes[extended])
        return stamps, extended_variance(self.observation, light)

    def _sigma(self, solution: _Solution) -> FloatArray:
        """Standard deviation of the pixels of the final fit, the PSF's errors included; infinite where not fitted."""
        values, layout = solution.values, solution.model.layout
        stamps, extended = self._variances(solution)
        sigma = weights_sigma(self.observation, solution.stamp_error**2 * stamps + extended)
        agn = _fitted_agn(layout, values, solution.model.amplitudes(values)[0], solution.start.agn)
        sigma[~self._fitted(lens_of(values[layout.lens_slice]), agn)] = np.inf
        return sigma

    def _measured_stamp_error(self, solution: _Solution) -> float | None:
        """Error of the AGN's stamps in units of what is allowed for, as the residuals of a full fit have it.

        None where there are no stamps, or their residuals do not tell.
        """
        model, values, layout = solution.model, solution.values, solution.model.layout
        if not layout.n_agn or self.observation.response is not None:
            return None
        _, rest, _ = model.amplitudes(values)
        counted = np.isfinite(model.sigma)
        residual = rest.reshape(self.observation.shape) * np.where(counted, model.sigma, 0.0)
        stamps, extended = self._variances(solution)
        noise = weights_sigma(self.observation)
        scale = noise_scale(self.observation, residual, model.sigma, lens_of(values[layout.lens_slice]))
        scaled = noise if scale is None else scale * noise
        others = np.where(counted, scaled**2 + extended, np.inf)
        return measured_stamp_error(residual, stamps, others)

    def _model(self, layout: Layout, sigma: FloatArray) -> ImageModel:
        ny, nx = self.observation.shape
        whole = slice(0, ny), slice(0, nx)
        return ImageModel(
            self.observation, layout, sigma, whole, subrays=_SUBRAYS, exact=True, priors=self.priors
        )  # fmt: skip

    def polish(self, solution: _Solution) -> _Solution:
        """The fit of the whole image from another one; with shear where it is wanted, or is worth its parameters."""
        best = self._full(solution, self._sigma(solution), shear=self.may_shear)
        error = self._measured_stamp_error(best)
        if error is not None:
            best = replace(best, stamp_error=error)
            best = self._full(best, self._sigma(best), shear=self.may_shear)
        if self.shear is None and not self._shear_shows(best):
            best = self._full(best, best.model.sigma, shear=False)
        for _ in range(_CORRECTIONS if self.observation.response is not None else 0):
            best.model.correct(best.values)
            best = self._again(best)
        return best

    def _again(self, solution: _Solution) -> _Solution:
        """The minimum of a model that has been changed since, from where it was."""
        model, start = solution.model, solution.start
        found = _minimise(model, start, solution.values, _INTEGRATED_STEPS, _TOLERANCE, integrated=True)
        self.evaluations += found.evaluations
        return replace(found, stamp_error=solution.stamp_error)

    def _shear_shows(self, solution: _Solution) -> bool:
        """Whether a fit's shear differs from none by more than its covariance lets expect."""
        jacobian, _ = solution.model.full_jacobian(solution.values)
        covariance = _covariance(jacobian, self._shared(solution.model, jacobian[: solution.model.data.size]))
        where = slice(solution.model.layout.lens_slice.stop - 2, solution.model.layout.lens_slice.stop)
        shear = solution.values[where]
        return bool(shear @ np.linalg.solve(covariance[where, where], shear) > _SHEAR_SHOWS)

    def _shared(self, model: ImageModel, jacobian: FloatArray) -> FloatArray:
        """J^T (C - diag C) J of the whitened Jacobian: what pixels share of their noise and of the stamps' error."""
        shape, size = self.observation.shape, jacobian.shape[1]
        noise = np.where(self.observation.valid, self.observation.noise, 0.0)
        inside = np.where(np.isfinite(model.sigma), model.sigma, 0.0)
        stamp = np.sqrt(np.maximum(inside**2 - noise**2, 0.0)) * (inside > 0)
        out = np.zeros((size, size))
        if self.observation.response is None and stamp.any():
            moved = (jacobian.reshape(*shape, size) * (stamp.ravel() * model.weight).reshape(*shape, 1)).copy()
            width = (_STAMP_CORRELATION, _STAMP_CORRELATION, 0.0)
            # A Gaussian filter has unit sum; the correlation of a pixel with itself is one.
            smooth = ndimage.gaussian_filter(moved, width, mode="constant") * (2.0 * math.pi * _STAMP_CORRELATION**2)
            flat = moved.reshape(-1, size)
            out += flat.T @ (smooth.reshape(-1, size) - flat)
        if self.observation.covariance is not None:
            shared = self.observation.covariance.copy()
            shared.setdiag(0.0)
            weighted = jacobian * model.weight[:, None]
            out += weighted.T @ (shared @ weighted)
        return 0.5 * (out + out.T)

    def _hosts(
        self, solution: _Solution, covariance: FloatArray, inflation: float, fixed_index: float | None
    ) -> dict[IndexPrior, HostPosterior]:
        """The host with each prior of n, from a solution with the widest and its covariance.

        A maximum inside a narrower range is that range's too. One outside ends at its bound: everything else is fitted
        again with n held there.
        """
        values, at_n = solution.values, solution.model.layout.host_slice.start + 1
        ranges = INDEX_RANGES if fixed_index is None else {**INDEX_RANGES, "fixed": (fixed_index, fixed_index)}
        wide = _host_posterior(solution, covariance, held=None)
        out: dict[IndexPrior, HostPosterior] = {"wide": wide}
        for prior, (low, high) in ranges.items():
            if prior == "wide":
                continue
            if low < values[at_n] < high:
                out[prior] = wide.inside(low, high)
                continue
            held = float(np.clip(values[at_n], low, high))
            shift = covariance[: values.size, at_n] / covariance[at_n, at_n] * (held - values[at_n])
            found = _minimise_held(solution, values + shift, at_n, held)
            self.evaluations += found.evaluations
            jacobian, amplitudes = found.model.full_jacobian(found.values)
            if not amplitudes[-2] > 0:
                continue
            free = np.delete(np.arange(jacobian.shape[1]), at_n)
            shared = self._shared(found.model, jacobian[: found.model.data.size])
            held_covariance = np.zeros((jacobian.shape[1],) * 2)
            held_covariance[np.ix_(free, free)] = inflation * _covariance(jacobian[:, free], shared[np.ix_(free, free)])
            posterior = _host_posterior(found, held_covariance, held=held)
            out[prior] = replace(posterior, n_at_bound=low < high)
        return out

    def result(self, solution: _Solution, fixed_index: float | None = None) -> ParametricFit:
        """The fit as it is handed on; a PosteriorError where it is no good."""
        model, values, layout = solution.model, solution.values, solution.model.layout
        jacobian, amplitudes = model.full_jacobian(values)
        _, rest, _ = model.amplitudes(values)
        chi2, freedom = float(rest @ rest), model.pixels - layout.size - layout.amplitudes
        host = sersic_of(values[layout.host_slice], 1.0)
        flux = float(amplitudes[-2])
        if not flux > 0:
            raise PosteriorError(f"parametric model: the host's flux is {flux:.3g} e-/s, a positive one is needed")
        if not freedom > 0 or chi2 > self.acceptance.chi2_per_dof * freedom:
            raise PosteriorError(
                f"parametric model: chi2 is {chi2:.0f} for {freedom} degrees of freedom, "
                f"{self.acceptance.chi2_per_dof:g} times as many are allowed"
            )
        if layout.n_agn:
            miss = POSITION_ERROR * float(np.abs(model.constraints(values)[-2 * layout.n_agn :]).max())
            if miss > self.acceptance.miss:
                raise PosteriorError(
                    f"parametric model: an AGN image maps {miss:.3f} arcsec from the host, "
                    f"{self.acceptance.miss:g} are allowed"
                )
        inflation = max(1.0, chi2 / freedom)
        covariance = inflation * _covariance(jacobian, self._shared(model, jacobian[: model.data.size]))
        shape = self.observation.shape
        shown = ImageModel(self.observation, layout, np.ones(shape), model.window, subrays=_SUBRAYS, exact=True)
        columns = shown.columns(values)
        return ParametricFit(
            lens=lens_of(values[layout.lens_slice]),
            host=replace(host, flux=flux),
            deflector=(
                sersic_of(values[layout.deflector_slice], float(amplitudes[layout.n_agn])) if layout.deflector else None
            ),
            agn=_fitted_agn(layout, values, amplitudes, solution.start.agn),
            background=float(amplitudes[-1]),
            lens_names=layout.lens_names,
            lens_covariance=_lens_block(layout, covariance, values),
            host_covariance=_host_block(layout, covariance, values),
            hosts=self._hosts(solution, covariance, inflation, fixed_index),
            chi2=chi2,
            degrees_of_freedom=freedom,
            evaluations=self.evaluations,
            stamp_error=solution.stamp_error,
            at_bound=_at_bound(solution),
            model=(columns @ amplitudes).reshape(shape),
            arc=(columns[:, -2] * flux).reshape(shape),
            sigma=model.sigma,
        )


def _with_shear(values: FloatArray, layout: Layout, *, shear: bool) -> FloatArray:
    """Parameters of a layout, with or without those of the shear, which start at zero."""
    stop = layout.lens_slice.stop
    if layout.shear == shear:
        return values
    return np.insert(values, stop, [0.0, 0.0]) if shear else np.delete(values, [stop - 2, stop - 1])


def _fitted_agn(
    layout: Layout, values: FloatArray, amplitudes: FloatArray, found: Sequence[Detection]
) -> tuple[Detection, ...]:
    positions = values[: 2 * layout.n_agn].reshape(-1, 2)
    return tuple(
        Detection(float(x), float(y), float(flux), detection.significance)
        for (x, y), flux, detection in zip(positions, amplitudes[: layout.n_agn], found, strict=True)
    )


def _covariance(jacobian: FloatArray, shared: FloatArray) -> FloatArray:
    """Covariance of a least-squares fit whose residuals share ``shared`` = J^T (C - 1) J: H^-1 (H + shared) H^-1."""
    scale = np.sqrt((jacobian**2).sum(axis=0))
    scale[scale == 0.0] = 1.0
    scaled = jacobian / scale
    inverse = np.linalg.pinv(scaled.T @ scaled, rcond=1e-12, hermitian=True)
    joint = inverse + inverse @ (shared / np.outer(scale, scale)) @ inverse
    return np.asarray(joint / np.outer(scale, scale))


def _shape_chain(e1: float, e2: float) -> FloatArray:
    """Derivatives of (q, phi) by the components of e = (1 - q)/(1 + q)."""
    e = max(math.hypot(e1, e2), 1e-4)
    slope = -2.0 / (1.0 + e) ** 2
    return np.array([[slope * e1 / e, slope * e2 / e], [-0.5 * e2 / e**2, 0.5 * e1 / e**2]])


def _lens_block(layout: Layout, covariance: FloatArray, values: FloatArray) -> FloatArray:
    """Covariance of (theta_E, q, phi, slope, x, y, shear), by the chain rule."""
    where = layout.lens_slice
    chain = np.eye(where.stop - where.start)
    chain[1:3, 1:3] = _shape_chain(*values[where][1:3].tolist())
    return np.asarray(chain @ covariance[where, where] @ chain.T)


def _host_block(layout: Layout, covariance: FloatArray, values: FloatArray) -> FloatArray:
    """Covariance of (flux, r_eff, n, q, phi, x, y), by the chain rule."""
    where = layout.host_slice
    chosen = [layout.size + layout.amplitudes - 2, *range(where.start, where.stop)]
    chain = np.eye(7)
    chain[1, 1] = math.exp(float(values[where][0]))
    chain[3:5, 3:5] = _shape_chain(*values[where][2:4].tolist())
    return np.asarray(chain @ covariance[np.ix_(chosen, chosen)] @ chain.T)


def _host_posterior(solution: _Solution, covariance: FloatArray, held: float | None) -> HostPosterior:
    """The host's block of a covariance of all parameters and amplitudes, its flux in the logarithm."""
    layout, values = solution.model.layout, solution.values
    where = layout.host_slice
    flux = float(solution.model.amplitudes(values)[0][-2])
    chosen = [layout.size + layout.amplitudes - 2, *range(where.start, where.stop)]
    scale = np.array([1.0 / flux, *np.ones(6)])
    low, high = solution.low[where].copy(), solution.high[where].copy()
    if held is not None:
        low[1] = high[1] = held
    ended = _at_bound(solution)
    return HostPosterior(
        mean=np.array([math.log(flux), *values[where]]),
        covariance=covariance[np.ix_(chosen, chosen)] * np.outer(scale, scale),
        low=np.array([-math.inf, *low]),
        high=np.array([math.inf, *high]),
        n_at_bound="host.n" in ended,
        r_eff_at_bound="host.ln r_eff" in ended,
    )


def _at_bound(solution: _Solution) -> tuple[str, ...]:
    """Names of the parameters of AGN images, lens, deflector and host that ended at a bound of their fit."""
    layout, values, low, high = solution.model.layout, solution.values, solution.low, solution.high
    names = [f"agn{k // 2 + 1}.{'xy'[k % 2]}" for k in range(2 * layout.n_agn)]
    light = ("ln r_eff", "n", "e1", "e2", "x", "y")
    names += [f"deflector.{name}" for name in light] if layout.deflector else []
    names += ["lens.theta_E", "lens.e1", "lens.e2", "lens.slope", "lens.x", "lens.y"]
    names += ["lens.gamma1", "lens.gamma2"] if layout.shear else []
    names += [f"host.{name}" for name in light]
    near = 1e-3 * (high - low)
    return tuple(
        name
        for name, value, least, most, margin in zip(names, values, low, high, near, strict=True)
        if not least + margin < value < most - margin
    )
