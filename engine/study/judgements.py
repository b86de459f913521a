"""Whether runs bear a statement out: numbers with errors, and rules that are the same for every statement.

A judge takes the answers of one estimator. Errors of medians, differences and rank correlations are standard errors by
bootstrap over the runs, with a fixed seed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from engine.biases import BiasPoint, HostQuantity, Trend
from engine.conventions import FloatArray

TARGET, INNER = 1.25, 0.5
"""Half-widths [mag] of the paper's bands: the scatter of black-hole masses, and what is wanted."""
MOST = 0.9
"""The share of runs that have to be within a bound for the statement that they are."""
ALIKE, NOT_STRONGLY = 0.1, 0.25
"""Differences [mag] that count as none, and as none to speak of."""
SMALL_ERROR = 0.1
"""Stated errors [mag] that are barely seen in a figure with bands of 0.5 and 1.25 mag."""
_SIGNIFICANT = 2.0
_RESAMPLES = 1000
Select = Callable[[BiasPoint], bool]


class Finding(NamedTuple):
    """Numbers in words, and whether they bear a statement out; None where the runs cannot tell."""

    told: str
    holds: bool | None


@dataclass(frozen=True)
class Answers:
    """One estimator's answers with n free and with n fixed to the truth."""

    free: Sequence[BiasPoint]
    fixed: Sequence[BiasPoint]


Judge = Callable[[Answers], Finding]


class TooFewError(ValueError):
    """There are too few runs of a kind to say anything."""


def everything(_: BiasPoint) -> bool:
    """Every run."""
    return True


def of(*systems: str) -> Select:
    """The runs of some systems."""
    return lambda point: point.system in systems


def _some(points: Sequence[BiasPoint], where: Select) -> list[BiasPoint]:
    found = [point for point in points if where(point)]
    if len(found) < 2:
        raise TooFewError("fewer than two runs")
    return found


def _require_several(*properties: FloatArray) -> None:
    """A correlation needs values that differ."""
    if any(np.unique(values).size < 2 for values in properties):
        raise TooFewError("the runs do not differ in it")


def _off(points: Sequence[BiasPoint], quantity: HostQuantity = "magnitude") -> FloatArray:
    return np.array([abs(point.bias(quantity)) for point in points])


def _error(statistic: Callable[..., FloatArray], *samples: FloatArray, paired: bool = False) -> float:
    from scipy.stats import bootstrap  # noqa: PLC0415 - half a second

    found = bootstrap(
        samples, statistic, n_resamples=_RESAMPLES, method="percentile", paired=paired, rng=np.random.default_rng(0)
    )
    return float(found.standard_error)


def _number(value: float, error: float, unit: str = "mag", sign: str = "+") -> str:
    return f"{value:{sign}.3f} ± {error:.3f} {unit}".rstrip()


def _medians_apart(first: FloatArray, second: FloatArray, axis: int = -1) -> FloatArray:
    return np.asarray(np.median(second, axis=axis) - np.median(first, axis=axis))


def within(where: Select, bound: float, *, share: float = MOST, both: bool = False) -> Judge:
    """At least a ``share`` of the biases are smaller than ``bound`` [mag], with n fixed too where ``both``."""

    def judge(answers: Answers) -> Finding:
        told, holds = [], True
        for name, points in (("n free", answers.free), ("n fixed", answers.fixed))[: 1 + both]:
            off = _off(_some(points, where))
            inside = int((off < bound).sum())
            label = f"{name}: " if both else ""
            told.append(f"{label}{inside} of {off.size} within {bound:g} mag, worst {off.max():.2f}")
            holds &= inside >= share * off.size
        return Finding("; ".join(told), holds)

    return judge


def beyond(where: Select, bound: float, *, share: float = 0.0) -> Judge:
    """More than a ``share`` of the biases, or one at all, are larger than ``bound`` [mag]."""

    def judge(answers: Answers) -> Finding:
        off = _off(_some(answers.free, where))
        outside = int((off > bound).sum())
        told = f"{outside} of {off.size} beyond {bound:g} mag, worst {off.max():.2f}"
        return Finding(told, outside > share * off.size)

    return judge


def above_noise(where: Select) -> Judge:
    """The median bias is larger than the stated error; for errors that are right it is 0.67 of it."""

    def judge(answers: Answers) -> Finding:
        some = _some(answers.free, where)
        ratio = np.array([abs(point.bias("magnitude")) / point.sd("magnitude") for point in some])
        value, error = float(np.median(ratio)), _error(np.median, ratio)
        return Finding(f"median {value:.2f} ± {error:.2f} stated errors", value - 1.0 > _SIGNIFICANT * error)

    return judge


def errors_below(where: Select, bound: float = SMALL_ERROR) -> Judge:
    """The median stated error of the magnitude is smaller than ``bound``."""

    def judge(answers: Answers) -> Finding:
        sd = np.array([point.sd("magnitude") for point in _some(answers.free, where)])
        return Finding(f"median {np.median(sd):.3f}, largest {sd.max():.3f} mag", bool(np.median(sd) < bound))

    return judge


def median_below(where: Mapping[str, Select], bound: float) -> Judge:
    """The median bias of each of some groups is smaller than ``bound`` [mag]."""

    def judge(answers: Answers) -> Finding:
        medians = {name: float(np.median(_off(_some(answers.free, one)))) for name, one in where.items()}
        told = ", ".join(f"{name} {value:.3f}" for name, value in medians.items())
        return Finding(f"median {told} mag", max(medians.values()) < bound)

    return judge


def signed(where: Select, sign: int, quantity: HostQuantity = "magnitude", unit: str = "mag") -> Judge:
    """The median bias has a ``sign``, by two of its errors."""

    def judge(answers: Answers) -> Finding:
        bias = np.array([point.bias(quantity) for point in _some(answers.free, where)])
        value, error = float(np.median(bias)), _error(np.median, bias)
        share = float((sign * bias > 0.0).mean())
        side = "above" if sign > 0 else "below"
        told = f"median {_number(value, error, unit)}, {share:.0%} {side} the truth"
        return Finding(told, sign * value > _SIGNIFICANT * error)

    return judge


def smaller(where: Select, than: Select) -> Judge:
    """The median size of the bias of some runs is smaller than of others, by two errors of the difference."""

    def judge(answers: Answers) -> Finding:
        first, second = (_off(_some(answers.free, one)) for one in (where, than))
        value, error = float(_medians_apart(first, second)), _error(_medians_apart, first, second)
        told = f"median {np.median(first):.3f} against {np.median(second):.3f}: {_number(value, error)}"
        return Finding(told, value > _SIGNIFICANT * error)

    return judge


def alike(
    where: Select, others: Select, quantity: HostQuantity = "magnitude", tolerance: float = NOT_STRONGLY,
    unit: str = "mag",
) -> Judge:  # fmt: skip
    """Median sizes of the bias of two groups differ by less than the tolerance."""

    def judge(answers: Answers) -> Finding:
        first, second = (_off(_some(answers.free, one), quantity) for one in (where, others))
        value, error = float(_medians_apart(second, first)), _error(_medians_apart, second, first)
        told = f"median {np.median(first):.3f} against {np.median(second):.3f}: {_number(value, error, unit)}"
        return Finding(told, abs(value) < tolerance)

    return judge


def unmoved_by(field: str, where: Select = everything, tolerance: float = ALIKE) -> Judge:
    """The bias moves by less than the tolerance, in the mean, between the two values of an input.

    Runs are paired whose other inputs and seeds are equal.
    """

    def judge(answers: Answers) -> Finding:
        pairs: dict[tuple[object, ...], list[tuple[float, float]]] = {}
        for point in _some(answers.free, where):
            inputs = {name: getattr(point, name) for name in ("system", "n", "r_eff", "magnitude", "l_eta", "seed")}
            value = inputs.pop(field)
            pairs.setdefault(tuple(inputs.values()), []).append((value, point.bias("magnitude")))
        moved = np.array([max(pair)[1] - min(pair)[1] for pair in pairs.values() if len(pair) == 2])
        if moved.size < 2:
            raise TooFewError("fewer than two pairs")
        value, error = float(moved.mean()), float(moved.std(ddof=1)) / math.sqrt(moved.size)
        return Finding(f"larger less smaller {field}: {_number(value, error)} in the mean", abs(value) < tolerance)

    return judge


def _rank_correlation(x: FloatArray, y: FloatArray, axis: int = -1) -> FloatArray:
    from scipy.stats import rankdata  # noqa: PLC0415 - as above

    ranks = [rankdata(values, axis=axis) for values in (x, y)]
    away = [values - values.mean(axis=axis, keepdims=True) for values in ranks]
    norm = np.sqrt((away[0] ** 2).sum(axis=axis) * (away[1] ** 2).sum(axis=axis))
    return np.asarray((away[0] * away[1]).sum(axis=axis) / norm)


def grows_with(against: Trend, sign: int = 1, where: Select = everything) -> Judge:
    """The size of the bias grows with a property of the observation (falls where ``sign`` is -1): rank correlation."""

    def judge(answers: Answers) -> Finding:
        some = _some(answers.free, lambda point: where(point) and getattr(point, against) is not None)
        x, y = np.array([sign * getattr(point, against) for point in some]), _off(some)
        _require_several(x)
        value, error = float(_rank_correlation(x, y)), _error(_rank_correlation, x, y, paired=True)
        return Finding(f"rank correlation {_number(value, error, '')}", value > _SIGNIFICANT * error)

    return judge


def matters_more(first: Mapping[Trend, int], than: Trend) -> Judge:
    """The size of the bias goes more closely with each of some properties than with another: rank correlations."""

    def judge(answers: Answers) -> Finding:
        some = _some(answers.free, lambda point: point.agn_contrast is not None)
        y = _off(some)
        columns = {name: np.array([float(getattr(point, name)) for point in some]) for name in (*first, than)}
        _require_several(*columns.values())
        found = {name: float(_rank_correlation(first.get(name, 1) * x, y)) for name, x in columns.items()}
        apart = [
            _error(_difference, sign * columns[name], columns[than], y, paired=True) for name, sign in first.items()
        ]
        told = ", ".join(f"{name.replace('_', ' ')} {value:.2f}" for name, value in found.items())
        gains = [found[name] - found[than] for name in first]
        holds = all(gain > _SIGNIFICANT * error for gain, error in zip(gains, apart, strict=True))
        return Finding(f"rank correlations: {told}; differences ± {max(apart):.2f}", holds)

    return judge


def _difference(x: FloatArray, other: FloatArray, y: FloatArray, axis: int = -1) -> FloatArray:
    return _rank_correlation(x, y, axis) - _rank_correlation(other, y, axis)


def helped_by_fixed_index(where: Select) -> Judge:
    """With n fixed to the truth the median size of the bias is smaller, by two errors of the difference."""

    def judge(answers: Answers) -> Finding:
        free, fixed = (_off(_some(points, where)) for points in (answers.free, answers.fixed))
        value, error = float(_medians_apart(fixed, free)), _error(_medians_apart, fixed, free)
        told = f"median {np.median(free):.3f}, n fixed {np.median(fixed):.3f}: better by {_number(value, error)}"
        return Finding(told, value > _SIGNIFICANT * error)

    return judge


def smallest_of_all(system: str) -> Judge:
    """No other system has a smaller median size of the bias."""

    def judge(answers: Answers) -> Finding:
        _some(answers.free, of(system))
        names = sorted({point.system for point in answers.free} - {system})
        medians = {name: float(np.median(_off(_some(answers.free, of(name))))) for name in names}
        if not medians:
            raise TooFewError("no other system")
        best = min(medians, key=medians.__getitem__)
        told, _ = smaller(of(system), of(best))(answers)
        return Finding(f"{told} ({best})", float(np.median(_off(_some(answers.free, of(system))))) < medians[best])

    return judge


def values_within(
    name: str, of_run: Callable[[BiasPoint], float | None], where: Select, low: float, high: float
) -> Judge:
    """At least :data:`MOST` of the runs have a property of the observation between two values."""

    def judge(answers: Answers) -> Finding:
        found = np.array([of_run(point) for point in _some(answers.free, where)], dtype=float)
        inside = ((found >= low) & (found <= high)).mean()
        told = f"{name} {found.min():.2f} to {found.max():.2f} mag, median {np.median(found):.2f}"
        return Finding(told, bool(inside >= MOST))

    return judge


def lowest_of_all(name: str, of_run: Callable[[BiasPoint], float], system: str, sign: int = 1) -> Judge:
    """No other system has a lower median of a property of the observation (higher where ``sign`` is -1)."""

    def judge(answers: Answers) -> Finding:
        names = sorted({point.system for point in answers.free})
        _some(answers.free, of(system))
        medians = {one: float(np.median([of_run(p) for p in _some(answers.free, of(one))])) for one in names}
        others = {one: value for one, value in medians.items() if one != system}
        if not others:
            raise TooFewError("no other system")
        best = min(others, key=lambda one: sign * others[one])
        told = f"median {name} {medians[system]:.2f} mag, next {others[best]:.2f} ({best})"
        return Finding(told, sign * medians[system] < sign * others[best])

    return judge


def untested(why: str) -> Judge:
    """What these runs cannot say anything about."""
    return lambda _: Finding(why, None)
