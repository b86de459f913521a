"""The state of the telescope, as the AGN images show it where the exposures and the camera are known.

HST breathes: its focus wanders by some 15 nm, and its pointing jitters. Beside an AGN that is many times the noise. How
the PSF changes with focus and blur is known from the camera, so that two numbers are learned from the residuals of a
fit, and what they leave open is marginalised in the next one as columns of the covariance (:mod:`.shared_error`).

Residuals are what a fit with free parameters has left over. So everything here is seen without what these parameters
would explain, J being their derivatives: K' = (1 - J (J^T J)^-1 J^T) K.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from engine.conventions import FloatArray
from engine.imaging.optics.exposed import ExposedOptics
from engine.imaging.telescope import NOMINAL_STATE, TelescopeState, quick_stamp
from engine.parametric.model import ImageModel
from engine.parametric.psf_error import laid_modes
from engine.parametric.shared_error import SharedError
from engine.parametric.solution import Solution
from engine.spec.instrument import Camera

DEFOCUS_SD, BLUR_SD, COLOUR_SD = 15.0, 5e-5, 1.0
"""Prior of a telescope's state: HST's breathing [nm rms of wavefront]; 7 milliarcsec of jitter, as a variance
[arcsec^2]; a star of another class."""
_SD = np.array([DEFOCUS_SD, BLUR_SD, COLOUR_SD])
_ASK = 20.0
"""Chi^2 of four ways in which a stamp may be wrong from which on it is asked: an exact PSF has it once in 2000 runs."""
_GAIN = 8.0
"""ln of the evidence, in that of independent pixels, from which on another state is believed."""
_STEP_NM, _STEP_BLUR, _STEP_COLOUR = 5.0, 1e-4, 1.0
_FARTHEST_NM, _FARTHEST = 60.0, np.array([4e-4, 3.0])
"""Steps over which the PSF's derivatives are taken, and the farthest that these are trusted."""
_STEPS = 6
_SETTLED_NM, _SETTLED = 0.2, np.array([1e-6, 0.02])
_SMOOTHED = 0.6


@dataclass(frozen=True, eq=False)
class LearnedOptics:
    """A state of the telescope, what it lowers chi^2 by, and the columns of what it leaves open."""

    state: TelescopeState
    explained: float
    shared: SharedError


def learned_optics(solution: Solution) -> LearnedOptics | None:
    """The state of the telescope that a fit of the whole image asks for; None where it asks for none.

    Asking takes a hundredth of a fit where the PSF is right. ``solution`` may marginalise the state that was found
    before.
    """
    response = solution.model.observation.response
    if response is None or response.camera is None or not solution.space.n_agn:
        return None
    seen = _Residual(solution)
    search = _Search(seen, response, response.camera)
    if not _asks(seen, solution):
        # A search begun anew has a state that is right, but does not yet marginalise it.
        anew = response.state != NOMINAL_STATE and solution.model.shared is None
        return search.learned(response.state, 0.0) if anew else None
    found = search.nearest(response.state)
    # On the other side of focus the PSF is much the same.
    mirrored = replace(found, defocus_nm=-found.defocus_nm)
    if search.cost(mirrored) < search.cost(found):
        found = search.nearest(mirrored)
    explained = search.cost(response.state) - search.cost(found)
    if 0.5 * explained / seen.excess(search.derivatives(found)) < _GAIN:
        return None
    return search.learned(found, explained)


def stamp_is_wrong(solution: Solution) -> bool:
    """Whether the residuals of a fit at its AGN images are such as no exact PSF leaves."""
    if not solution.space.n_agn:
        return False
    return _asks(_Residual(solution), solution)


def _asks(seen: _Residual, solution: Solution) -> bool:
    return seen.chi2(seen.laid(_broader(solution.model.observation.psf))) >= _ASK


def _broader(stamp: FloatArray) -> FloatArray:
    """Four changes (4, n, n) of a stamp: smoothed, stretched, and stretched along one axis of two."""
    half = stamp.shape[0] // 2
    y, x = np.indices(stamp.shape) - half
    down, across = np.gradient(stamp)
    stretched = 2.0 * stamp + x * across + y * down
    oval, tilted = x * across - y * down, x * down + y * across
    return np.stack([ndimage.gaussian_filter(stamp, _SMOOTHED) - stamp, stretched, oval, tilted])


class _Residual:
    """Whitened residuals of a fit, without shared errors, and what columns explain of them."""

    def __init__(self, solution: Solution) -> None:
        self._model: ImageModel = solution.model.exact_only()
        model, values = self._model, solution.values
        amplitudes, rest, _ = model.amplitudes(values)
        jacobian = model.full_jacobian(values)[0][: model.data.size]
        self._basis, _ = np.linalg.qr(jacobian)
        self.rest = self._free(rest)
        scale, (ny, nx) = model.observation.pixel_scale, model.observation.shape
        self._places = [
            (x / scale + (nx - 1) / 2.0, y / scale + (ny - 1) / 2.0, flux)
            for (x, y), flux in zip(solution.space.agn(values), amplitudes, strict=False)
        ]
        observation = model.observation
        noise = np.where(observation.valid, observation.noise, 0.0).ravel()
        self._more = np.maximum(1.0 - (noise * model.weight) ** 2, 0.0) * (model.weight > 0)

    def _free(self, columns: FloatArray) -> FloatArray:
        return np.asarray(columns - self._basis @ (self._basis.T @ columns))

    def laid(self, modes: FloatArray) -> FloatArray:
        """Columns (pixels, m) of changes of the stamp (m, n, n), without what the fit's parameters explain."""
        return self._free(
            laid_modes(modes, self._places, self._model.shape).reshape(len(modes), -1).T * self._model.weight[:, None]
        )

    def unwhitened(self, columns: FloatArray) -> FloatArray:
        weight = self._model.weight[:, None]
        return np.divide(columns, weight, out=np.zeros_like(columns), where=weight > 0)

    def _noise(self, columns: FloatArray) -> FloatArray:
        """Covariance (m, m) that noise gives the products of columns (pixels, m) and residuals."""
        covariance, weight = self._model.observation.covariance, self._model.weight[:, None]
        if covariance is None:
            return columns.T @ columns
        weighted = weight * columns
        return np.asarray(weighted.T @ (covariance @ weighted) + columns.T @ (self._more[:, None] * columns))

    def chi2(self, columns: FloatArray) -> float:
        """Chi^2 (m) of the residuals along m columns."""
        along = columns.T @ self.rest
        return float(along @ np.linalg.solve(self._noise(columns), along))

    def excess(self, columns: FloatArray) -> float:
        """Variance of the residuals along columns in that of independent pixels: neighbours share their noise."""
        return max(1.0, float(np.trace(self._noise(columns)) / np.sum(columns**2)))


class _Search:
    """The likeliest state of a telescope."""

    def __init__(self, seen: _Residual, response: ExposedOptics, camera: Camera) -> None:
        self._seen, self._response, self._camera = seen, response, camera

    def _stamp(self, state: TelescopeState) -> FloatArray:
        return quick_stamp(self._camera, self._response.geometry, state)

    def _rest(self, state: TelescopeState) -> FloatArray:
        """Residuals of a fit whose AGN images are those of a state."""
        change = self._stamp(state) - self._stamp(self._response.state)
        return self._seen.rest - self._seen.laid(change[None])[:, 0]

    def cost(self, state: TelescopeState) -> float:
        """Chi^2 with its prior."""
        rest = self._rest(state)
        return float(rest @ rest) + float(np.sum((_values(state) / _SD) ** 2))

    def _changes(self, state: TelescopeState) -> FloatArray:
        """Derivatives (4, n, n) of the stamp by defocus, by half its square, by blur and by colour."""
        here = self._stamp(state)
        more, less = (self._stamp(replace(state, defocus_nm=state.defocus_nm + step)) for step in (_STEP_NM, -_STEP_NM))
        # To the side on which the PSF is computed, not extrapolated.
        step = _STEP_BLUR if state.blur >= 0.0 else -_STEP_BLUR
        blurred = (self._stamp(replace(state, blur=state.blur + step)) - here) / step
        # This one hardly depends on the others, and need not be computed again.
        usual = self._response.state
        bluer = (self._stamp(replace(usual, colour=usual.colour + _STEP_COLOUR)) - self._stamp(usual)) / _STEP_COLOUR
        return np.stack([(more - less) / (2.0 * _STEP_NM), (more + less - 2.0 * here) / _STEP_NM**2, blurred, bluer])

    def derivatives(self, state: TelescopeState) -> FloatArray:
        """Whitened columns (pixels, 3) of the derivatives by defocus, blur and colour."""
        return self._seen.laid(self._changes(state)[[0, 2, 3]])

    def learned(self, state: TelescopeState, explained: float) -> LearnedOptics:
        """A state with the columns of its prior, of whose amplitudes the fit has none yet."""
        columns = self._seen.unwhitened(self.derivatives(state)) * _SD
        return LearnedOptics(state, explained, SharedError(columns, np.zeros(_SD.size), 0))

    def nearest(self, state: TelescopeState) -> TelescopeState:
        """The minimum that steps from a state lead to."""
        cost = self.cost(state)
        for _ in range(_STEPS):
            following, moved = self._step(state)
            lower = self.cost(following)
            if lower >= cost:
                break
            state, cost = following, lower
            if not moved:
                break
        return state

    def _step(self, state: TelescopeState) -> tuple[TelescopeState, bool]:
        """The minimum of cost to second order in defocus and first in the others, and whether it is elsewhere."""
        columns, rest = self._seen.laid(self._changes(state)), self._rest(state)
        square, along = columns.T @ columns, columns.T @ rest
        d = np.arange(-_FARTHEST_NM, _FARTHEST_NM + 0.05, 0.1)
        defocus = np.stack([d, 0.5 * d**2])
        # For each defocus the best of the others are known.
        others, sd = _values(state)[1:, None], _SD[1:, None]
        stiff = square[2:, 2:] + np.diag(_SD[1:] ** -2)
        v = np.linalg.solve(stiff, along[2:, None] - square[2:, :2] @ defocus - others / sd**2)
        v = np.clip(v, -_FARTHEST[:, None], _FARTHEST[:, None])
        a = np.concatenate([defocus, v])
        cost = np.sum(a * (square @ a), axis=0) - 2.0 * along @ a
        cost += ((state.defocus_nm + d) / DEFOCUS_SD) ** 2 + np.sum(((others + v) / sd) ** 2, axis=0)
        best = int(np.argmin(cost))
        moved = abs(d[best]) > _SETTLED_NM or bool(np.any(np.abs(v[:, best]) > _SETTLED))
        blur, colour = (others[:, 0] + v[:, best]).tolist()
        # Rounded, so that stamps are found again.
        return TelescopeState(round(state.defocus_nm + float(d[best]), 1), round(blur, 7), round(colour, 3)), moved


def _values(state: TelescopeState) -> FloatArray:
    return np.array([state.defocus_nm, state.blur, state.colour])
