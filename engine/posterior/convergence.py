"""Whether the parts of a chain agree."""

from __future__ import annotations

import math

import numpy as np
from scipy import stats

from engine.conventions import FloatArray


def r_hat(groups: FloatArray) -> float:
    """Rank-normalised R-hat of groups of samples (m, samples, parameters), the largest over the parameters.

    That of the ranks, and that of the ranks of the distances from the median, which tells groups of one place but of
    different widths apart; the larger one counts (Vehtari et al. 2021, section 4.1). Infinite where nothing varies
    within a group. By hand, because these lines are all that arviz would be needed for.
    """
    folded = np.abs(groups - np.median(groups, axis=(0, 1)))
    return max(_gelman_rubin(_normal_scores(groups)), _gelman_rubin(_normal_scores(folded)))


def _normal_scores(groups: FloatArray) -> FloatArray:
    """Normal quantiles of the ranks among all groups (Blom 1958), ties at their mean rank."""
    m, samples, parameters = groups.shape
    ranks = stats.rankdata(groups.reshape(m * samples, parameters), axis=0)
    return np.asarray(stats.norm.ppf((ranks - 0.375) / (m * samples + 0.25)).reshape(groups.shape))


def _gelman_rubin(groups: FloatArray) -> float:
    """sqrt(1 - 1/N + B/W), B the variance of the groups' means and W the mean of their variances, at its largest."""
    samples = groups.shape[1]
    within = groups.var(axis=1, ddof=1).mean(axis=0)
    between = groups.mean(axis=1).var(axis=0, ddof=1)
    if not (within > 0).all():
        return math.inf
    return float(np.sqrt((samples - 1) / samples + between / within).max())


def split_r_hat(samples: FloatArray) -> float:
    """R-hat of a chain (steps, walkers, parameters) against itself: halves of the walkers by halves of the time.

    A drift shows between the times, a part of the ensemble that is stuck between the walkers. Needs four steps and two
    walkers.
    """
    steps, walkers, parameters = samples.shape
    if steps < 4 or walkers < 2:
        raise ValueError(
            f"samples: got {steps} steps of {walkers} walkers, allowed are four steps and two walkers at least"
        )
    half, side = steps // 2, walkers // 2
    parts = [
        samples[start : start + half, first : first + side].reshape(-1, parameters)
        for start in (0, steps - half)
        for first in (0, walkers - side)
    ]
    return r_hat(np.stack(parts))
