"""Bias and scatter of one quantity by one estimator, as functions of a lens's features.

What is modelled is y, the bias of a magnitude or the logarithm of a recovered radius or index over the true one, and s,
the deviation that a run states for it. ln s is regressed first (:mod:`engine.prediction.mixed`); then y, whose scatter
in one measurement is kappa times the s expected, with an effect of each lens beyond its features. Amplitudes of
regression, effect and scatter are those of the highest evidence.

Intervals are conformal over lenses: each lens is predicted by the others (CV+ with whole lenses left out; Barber et al.
2021), each has the same weight however many runs it has, and a lens that is not there counts as one with an infinite
score (Dunn, Wasserman & Ramdas 2023). With so few lenses that this would be infinite (fewer than 9 at 90 %) no interval
is free of assumptions: it is then Student's t of the lens effects and the normal scatter, or what the lenses left out
take where that is wider.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from scipy.optimize import minimize
from scipy.stats import t as student

from engine.conventions import FloatArray
from engine.prediction.mixed import GroupedRidge, IntArray, fit_grouped

_NORMAL = NormalDist()
LEAST_LENSES = 4
"""Lenses below which nothing is fitted: what differs from lens to lens cannot be told from what they have in common."""
_LEAST_SD = 1e-5
_CONSTANT = 3.0
"""Prior deviation of the constant of y [mag, or in logarithms]: as good as none."""
_CURVED = 0.4
"""Prior deviation of a coefficient of squares and products, in that of the linear ones."""


@dataclass(frozen=True)
class Expected:
    """What is expected of one lens: ``mean`` of y with its deviation, and the ``scatter`` of one measurement.

    ``scatter_low`` and ``scatter_high`` hold the scatter, ``mean_low`` and ``mean_high`` the mean, ``low`` and ``high``
    one measurement, each with the probability asked for.
    """

    mean: float
    mean_low: float
    mean_high: float
    scatter: float
    scatter_low: float
    scatter_high: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class _Regression:
    """A regression with what it takes to predict by it, for all lenses and for each left out."""

    ridge: GroupedRidge
    relative: bool
    effect: float
    noise: float

    def predict(self, phi: FloatArray, without: int | None = None) -> tuple[FloatArray, FloatArray]:
        """Mean and deviation of the regression at phi (points, p); the lens's own effect is not in it."""
        mean, covariance = self.ridge.posterior if without is None else self.ridge.coefficients(without)
        return phi @ mean, np.sqrt(np.maximum(np.einsum("ip,pq,iq->i", phi, covariance, phi), 0.0))


class BiasModel:
    """The regressions of one quantity by one estimator, and the scores of the lenses that they were made from.

    Parameters
    ----------
    x : (runs, features)
    y : (runs,)
        Bias, as above.
    s : (runs,)
        Stated deviation of y.
    lens : (runs,)
        Which lens, counted from 0.
    """

    def __init__(self, x: FloatArray, y: FloatArray, s: FloatArray, lens: IntArray) -> None:
        self.lenses = int(lens.max()) + 1
        if self.lenses < LEAST_LENSES:
            raise ValueError(f"lenses: got {self.lenses}, allowed are {LEAST_LENSES} at least")
        self._centre, spread = x.mean(axis=0), x.std(axis=0)
        # What all runs have in common says nothing: it is left out.
        self._used = spread > 1e-9
        self._spread = spread[self._used]
        phi = self._basis(x)
        self._ln_s = _scale(phi, np.log(np.maximum(s, _LEAST_SD)), lens)
        expected = np.exp(self._ln_s.predict(phi)[0])
        found = [_bias(phi, y, expected, lens, relative) for relative in (False, True)]
        self._y = max(found, key=lambda one: one.ridge.ln_evidence)
        self._left = self._left_out(phi, y, lens)
        self._stretches: dict[float, float] = {}

    def _basis(self, x: FloatArray) -> FloatArray:
        z = (x - self._centre)[:, self._used] / self._spread
        k = z.shape[1]
        pairs = [z[:, i] * z[:, j] for i in range(k) for j in range(i, k)]
        return np.column_stack([np.ones(len(z)), z, *pairs])

    def _predict(self, phi: FloatArray, without: int | None = None) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Mean of y, its deviation with that of the lens's effect, and the scatter."""
        expected = np.exp(self._ln_s.predict(phi, without)[0])
        mean, sd = self._y.predict(phi, without)
        effect = self._y.effect * (expected if self._y.relative else 1.0)
        return mean, np.hypot(sd, effect), self._y.noise * expected

    def _left_out(self, phi: FloatArray, y: FloatArray, lens: IntArray) -> FloatArray:
        """Of each run by the other lenses: distance from the mean, deviations of lens and run, weight; (4, runs)."""
        out = np.empty((4, len(y)))
        for place in range(self.lenses):
            mine = lens == place
            mean, sd, scatter = self._predict(phi[mine], place)
            out[:, mine] = np.abs(y[mine] - mean), sd, scatter, np.full(mine.sum(), 1.0 / mine.sum())
        return out

    def _half(self, sd: FloatArray, scatter: FloatArray, level: float) -> FloatArray:
        """Half-width of an interval by the regression: Student's t of the lens and the normal scatter of one run."""
        tail = student.ppf(0.5 + 0.5 * level, self.lenses - 2)
        return np.asarray(np.hypot(tail * sd, _NORMAL.inv_cdf(0.5 + 0.5 * level) * scatter))

    def _stretch(self, level: float) -> float:
        """What the half-width is to be multiplied with, so that the intervals hold the lenses that were left out."""
        if level not in self._stretches:
            self._stretches[level] = self._stretched(level)
        return self._stretches[level]

    def _stretched(self, level: float) -> float:
        distance, sd, scatter, weight = self._left
        scores = distance / self._half(sd, scatter, level)
        order = np.argsort(scores)
        held = np.cumsum(weight[order])
        enough = int(np.searchsorted(held, level * (self.lenses + 1.0)))
        if enough < len(held):
            return float(scores[order][enough])
        mine = min(int(np.searchsorted(held, level * self.lenses)), len(held) - 1)
        return max(1.0, float(scores[order][mine]))

    def expect(self, x: FloatArray, level: float) -> Expected:
        """What is expected at features x (features,), with intervals of probability ``level``."""
        phi = self._basis(x[None, :])
        means, sds, scatters = self._predict(phi)
        mean, sd, scatter = float(means[0]), float(sds[0]), float(scatters[0])
        tail = float(student.ppf(0.5 + 0.5 * level, self.lenses - 2))
        spread = math.exp(tail * math.hypot(float(self._ln_s.predict(phi)[1][0]), self._ln_s.effect))
        reach = self._stretch(level) * float(self._half(sds, scatters, level)[0])
        return Expected(
            mean=mean,
            mean_low=mean - tail * sd,
            mean_high=mean + tail * sd,
            scatter=scatter,
            scatter_low=scatter / spread,
            scatter_high=scatter * spread,
            low=mean - reach,
            high=mean + reach,
        )


def _amplitudes(phi: FloatArray, features: int, size: float) -> FloatArray:
    """Prior deviations: linear terms ``size``, squares and products less, the constant whatever it may be."""
    out = np.full(phi.shape[1], size * _CURVED)
    out[1 : features + 1] = size
    out[0] = _CONSTANT
    return out


def _features_of(phi: FloatArray) -> int:
    """How many features a basis of 1 + k + k (k + 1) / 2 columns is of."""
    return round((math.sqrt(8.0 * phi.shape[1] + 1.0) - 3.0) / 2.0)


def _scale(phi: FloatArray, ln_s: FloatArray, lens: IntArray) -> _Regression:
    """The regression of ln s."""

    def fit(parameters: FloatArray) -> tuple[GroupedRidge, float, float]:
        size, effect, noise = np.exp(parameters)
        amplitude = _amplitudes(phi, _features_of(phi), float(size))
        amplitude[0] = 10.0
        ones = np.ones(len(ln_s))
        return fit_grouped(phi, ln_s, amplitude, lens, effect * ones, noise * ones), float(effect), float(noise)

    best = _most_evident(lambda parameters: fit(parameters)[0].ln_evidence, np.log([0.5, 0.2, 0.1]))
    ridge, effect, noise = fit(best)
    return _Regression(ridge, False, effect, noise)


def _bias(phi: FloatArray, y: FloatArray, expected: FloatArray, lens: IntArray, relative: bool) -> _Regression:
    """The regression of y, with an effect of each lens that is constant or in proportion to the scatter."""
    size = float(np.sqrt(np.mean(y**2))) + 1e-6
    typical = float(np.median(expected))

    def fit(parameters: FloatArray) -> tuple[GroupedRidge, float, float]:
        amplitude, effect, noise = np.exp(parameters)
        effects = effect * (expected if relative else np.ones(len(y)))
        ridge = fit_grouped(
            phi, y, _amplitudes(phi, _features_of(phi), float(amplitude)), lens, effects, noise * expected
        )
        return ridge, float(effect), float(noise)

    start = np.log([0.3 * size, 0.3 * (size / typical if relative else size), 1.2])
    # Amplitude and effect are kept off zero, where few lenses put them too often, by a prior that grows with them
    # (Chung et al. 2013): at zero the interval of the mean would be nothing.
    best = _most_evident(lambda parameters: fit(parameters)[0].ln_evidence + parameters[0] + parameters[1], start)
    ridge, effect, noise = fit(best)
    return _Regression(ridge, relative, effect, noise)


def _most_evident(ln_evidence: object, start: FloatArray) -> FloatArray:
    """Where the evidence is highest, within a factor e^6 of the start."""
    low, high = start - 6.0, start + 6.0

    def loss(parameters: FloatArray) -> float:
        return -float(ln_evidence(np.clip(parameters, low, high)))  # type: ignore[operator]

    found = minimize(loss, start, method="Nelder-Mead", options={"maxfev": 150, "xatol": 0.03, "fatol": 0.03})
    return np.asarray(np.clip(found.x, low, high))
