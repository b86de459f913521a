"""Whether the parts of a chain agree."""

from __future__ import annotations

import math

import numpy as np

from engine.conventions import FloatArray


def r_hat(groups: FloatArray) -> float:
    """R-hat of groups of samples (m, samples, parameters), the largest over the parameters.

    sqrt(1 + B / W - 1/N) with B the variance of the groups' means and W the mean of their variances (Gelman & Rubin
    1992, without the correction for the number of groups). Infinite where nothing varies within a group.
    """
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
