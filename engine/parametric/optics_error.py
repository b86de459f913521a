"""The state of the telescope, as the AGN images show it where the exposures and the camera are known.

HST breathes: its focus wanders by some 15 nm, and its pointing jitters. Beside an AGN that is many times the noise. How
the PSF changes with focus and blur is known from the camera, so that two numbers are learned from the residuals of a
fit, and what they leave open is marginalised in the next one as columns of the covariance (:mod:`.shared_error`).

Residuals are what a fit with free parameters has left over. So everything here is seen without what these parameters
would explain, J being their derivatives: K' = (1 - J (J^T J)^-1 J^T) K.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from engine.conventions import FloatArray
from engine.imaging.optics.exposed import ExposedOptics
from engine.imaging.telescope import TelescopeState, quick_stamp
from engine.parametric.model import ImageModel
from engine.parametric.psf_error import laid_modes
from engine.parametric.shared_error import SharedError
from engine.parametric.solution import Solution

DEFOCUS_SD, BLUR_SD = 15.0, 5e-5
"""Prior of a telescope's state: HST's breathing [nm rms of wavefront]; 7 milliarcsec of jitter, as a variance."""
_ASK = 20.0
"""Chi^2 of four ways in which a stamp may be wrong from which on it is asked: an exact PSF has it once in 2000 runs."""
_GAIN = 8.0
"""ln of the evidence, in that of independent pixels, from which on another state is believed."""
_STEP_NM, _STEP_BLUR = 5.0, 1e-4
_FARTHEST_NM, _FARTHEST_BLUR = 60.0, 4e-4
"""Steps over which the PSF's derivatives are taken, and the farthest that these are trusted."""
_STEPS = 6
_SETTLED_NM, _SETTLED_BLUR = 0.2, 1e-6
_SMOOTHED = 0.6


@dataclass(frozen=True, eq=False)
class LearnedOptics:
    """A state of the telescope, ln of the evidence for it, and the columns of what it leaves open."""

    state: TelescopeState
    gain: float
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
    if seen.chi2(seen.laid(_broader(solution.model.observation.psf))) < _ASK:
        return None
    search = _Search(seen, response)
    found = min((search.nearest(defocus) for defocus in search.starts()), key=lambda pair: pair[1])[0]
    gain = 0.5 * (search.cost(response.state) - search.cost(found)) / seen.excess(search.derivatives(found))
    if gain < _GAIN:
        return None
    derivatives = seen.unwhitened(search.derivatives(found)) * np.array([DEFOCUS_SD, BLUR_SD])
    return LearnedOptics(found, gain, SharedError(derivatives, np.zeros(2), 0))


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
        return self._free(laid_modes(modes, self._places, self._model.shape).reshape(len(modes), -1).T
                          * self._model.weight[:, None])

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

    def __init__(self, seen: _Residual, response: ExposedOptics) -> None:
        self._seen, self._response = seen, response

    def _stamp(self, state: TelescopeState) -> FloatArray:
        assert self._response.camera is not None
        return quick_stamp(self._response.camera, self._response.geometry, state)

    def _rest(self, state: TelescopeState) -> FloatArray:
        """Residuals of a fit whose AGN images are those of a state."""
        change = self._stamp(state) - self._stamp(self._response.state)
        return self._seen.rest - self._seen.laid(change[None])[:, 0]

    def cost(self, state: TelescopeState) -> float:
        """Chi^2 with its prior."""
        rest = self._rest(state)
        return float(rest @ rest) + _prior(state.defocus_nm, state.blur)

    def _changes(self, state: TelescopeState) -> FloatArray:
        """Derivatives (3, n, n) of the stamp by defocus, by half its square, and by blur."""
        here = self._stamp(state)
        more, less = (
            self._stamp(TelescopeState(state.defocus_nm + step, state.blur)) for step in (_STEP_NM, -_STEP_NM)
        )
        # To the side on which the PSF is computed, not extrapolated.
        step = _STEP_BLUR if state.blur >= 0.0 else -_STEP_BLUR
        blurred = (self._stamp(TelescopeState(state.defocus_nm, state.blur + step)) - here) / step
        return np.stack([(more - less) / (2.0 * _STEP_NM), (more + less - 2.0 * here) / _STEP_NM**2, blurred])

    def derivatives(self, state: TelescopeState) -> FloatArray:
        """Whitened columns (pixels, 2) of the derivatives by defocus and by blur."""
        return self._seen.laid(self._changes(state)[[0, 2]])

    def starts(self) -> tuple[float, ...]:
        """Defocus [nm] to start from: where it is, and on the other side, as the PSF hardly tells the two apart."""
        here = self._step(self._response.state)[0]
        return (here.defocus_nm, -here.defocus_nm)

    def nearest(self, defocus: float) -> tuple[TelescopeState, float]:
        """The minimum that steps from a defocus lead to, and its cost."""
        state = TelescopeState(defocus, self._response.state.blur)
        cost = self.cost(state)
        for _ in range(_STEPS):
            following, moved = self._step(state)
            lower = self.cost(following)
            if lower >= cost:
                break
            state, cost = following, lower
            if not moved:
                break
        return state, cost

    def _step(self, state: TelescopeState) -> tuple[TelescopeState, bool]:
        """The minimum of cost to second order in defocus and first in blur, and whether it is elsewhere."""
        columns, rest = self._seen.laid(self._changes(state)), self._rest(state)
        square, along = columns.T @ columns, columns.T @ rest
        d = np.arange(-_FARTHEST_NM, _FARTHEST_NM + 0.05, 0.1)
        defocus = np.stack([d, 0.5 * d**2])
        # For each defocus the best blur is known.
        stiff = square[2, 2] + BLUR_SD**-2
        v = (along[2] - square[2, :2] @ defocus - state.blur / BLUR_SD**2) / stiff
        v = np.clip(v, -_FARTHEST_BLUR, _FARTHEST_BLUR)
        a = np.concatenate([defocus, v[None]])
        cost = np.sum(a * (square @ a), axis=0) - 2.0 * along @ a + _prior(state.defocus_nm + d, state.blur + v)
        best = int(np.argmin(cost))
        moved = abs(d[best]) > _SETTLED_NM or abs(v[best]) > _SETTLED_BLUR
        # Rounded, so that stamps are found again.
        return TelescopeState(round(state.defocus_nm + float(d[best]), 1), round(state.blur + float(v[best]), 7)), moved


def _prior(defocus: FloatArray | float, blur: FloatArray | float) -> FloatArray | float:
    return (defocus / DEFOCUS_SD) ** 2 + (blur / BLUR_SD) ** 2
