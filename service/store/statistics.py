"""Statistics of many groups at once: numpy arrays in, one array a statistic out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True)
class Share:
    """Part of each group, with the bounds of its 68.3 % interval after Wilson (1927); NaN in a group without any."""

    fraction: FloatArray
    low: FloatArray
    high: FloatArray


@dataclass(frozen=True)
class Moments:
    """What each group's values are like; NaN where a group has too few of them.

    ``scatter`` is the sample standard deviation, ``rmse`` that from zero; ``quantiles`` are linearly interpolated
    (Hyndman and Fan's seventh definition, numpy's). ``error`` is the standard error of the mean, by
    :func:`clustered_error`; ``clusters`` counts what it takes for independent.
    """

    number: IntArray
    mean: FloatArray
    scatter: FloatArray
    rmse: FloatArray
    median: FloatArray
    p16: FloatArray
    p84: FloatArray
    error: FloatArray
    clusters: IntArray


def share(is_in: NDArray[np.bool_], groups: IntArray, number: IntArray) -> Share:
    """Part of each group's members for which ``is_in`` holds; ``number`` has the members of each group."""
    hits = np.bincount(groups, weights=is_in, minlength=len(number))
    with np.errstate(divide="ignore", invalid="ignore"):
        fraction = hits / number
        centre = (hits + 0.5) / (number + 1.0)
        half = np.sqrt(hits * (number - hits) / number + 0.25) / (number + 1.0)
    known = number > 0
    low, high = (np.where(known, np.clip(bound, 0.0, 1.0), np.nan) for bound in (centre - half, centre + half))
    # Rounding must not leave out the fraction itself where it is none or all.
    return Share(fraction, np.minimum(low, fraction), np.maximum(high, fraction))


def moments(values: FloatArray, groups: IntArray, n_groups: int, clusters: IntArray) -> Moments:
    """Moments and quantiles of finite ``values``, each in one of ``n_groups`` groups and in one of the ``clusters``."""
    number = np.bincount(groups, minlength=n_groups)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = np.bincount(groups, weights=values, minlength=n_groups) / number
        off = values - mean[groups]
        variance = np.bincount(groups, weights=off * off, minlength=n_groups) / (number - 1)
        rmse = np.sqrt(np.bincount(groups, weights=values * values, minlength=n_groups) / number)
    scatter = np.sqrt(np.where(number > 1, variance, np.nan))
    ordered = values[np.lexsort((values, groups))]
    starts = np.concatenate([[0], np.cumsum(number)[:-1]])
    median, p16, p84 = (_quantile(ordered, starts, number, part) for part in (0.5, 0.16, 0.84))
    error, independent = clustered_error(off, groups, number, scatter, clusters)
    return Moments(number, mean, scatter, rmse, median, p16, p84, error, independent)


def clustered_error(
    off: FloatArray, groups: IntArray, number: IntArray, scatter: FloatArray, clusters: IntArray
) -> tuple[FloatArray, IntArray]:
    """Standard error of each group's mean, and the clusters in it.

    ``off`` are the values less their group's mean. Values of one cluster (seeds of one input) have its bias in common,
    so that a thousand seeds of four inputs are no four thousand independent measures of what other inputs would show:
    error^2 = k / (k - 1) sum_c (sum_i off_ci)^2 / N^2 for k clusters (Liang and Zeger 1986). Of one cluster alone it is
    scatter / sqrt(N): what other seeds would show.
    """
    n_groups = len(number)
    pairs, place = np.unique(
        groups.astype(np.int64) * (int(clusters.max(initial=0)) + 1) + clusters, return_inverse=True
    )
    owner = (pairs // (int(clusters.max(initial=0)) + 1)).astype(np.intp)
    sums = np.bincount(place, weights=off, minlength=len(pairs))
    k = np.bincount(owner, minlength=n_groups)
    with np.errstate(divide="ignore", invalid="ignore"):
        squares = np.bincount(owner, weights=sums * sums, minlength=n_groups)
        between = np.sqrt(k / (k - 1.0) * squares) / number
        within = scatter / np.sqrt(number)
    return np.where(k > 1, between, within), k


def _quantile(ordered: FloatArray, starts: IntArray, number: IntArray, part: float) -> FloatArray:
    """A quantile of each group, whose values lie one after the other in their order."""
    found = np.full(len(number), np.nan)
    known = number > 0
    place = part * (number[known] - 1)
    below = np.floor(place).astype(np.intp)
    above = np.minimum(below + 1, number[known] - 1)
    first = starts[known]
    weight = place - below
    found[known] = ordered[first + below] * (1.0 - weight) + ordered[first + above] * weight
    return found
