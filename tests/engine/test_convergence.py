"""R-hat of chains whose parts agree, drift or stick."""

import math

import numpy as np
import pytest
from scipy.stats import norm

from engine.posterior.convergence import r_hat, split_r_hat


def test_parts_of_one_distribution_agree() -> None:
    samples = np.random.default_rng(0).normal(size=(400, 20, 3))
    # Four parts of 2,000 samples each: the means differ by 1/sqrt(2000), so R-hat is 1 + 1/4000 or so.
    assert split_r_hat(samples) == pytest.approx(1.0, abs=1.5e-3)


def test_a_drift_and_walkers_apart_are_seen() -> None:
    samples = np.random.default_rng(0).normal(size=(400, 20, 3))
    drifting, apart = samples.copy(), samples.copy()
    drifting[200:, :, 1] += 1.0
    apart[:, 10:, 2] += 1.0
    # Means one deviation apart in pairs: variance of the means 1/3 (of four), so sqrt(1 + 1/3).
    assert split_r_hat(drifting) == pytest.approx(math.sqrt(4 / 3), abs=0.03)
    assert split_r_hat(apart) == pytest.approx(math.sqrt(4 / 3), abs=0.03)


def test_groups_are_compared_by_their_ranks() -> None:
    groups = np.array([[[0.0], [2.0]], [[1.0], [5.0]]])
    # Ranks 1, 3 and 2, 4 of four as normal scores, and the textbook formula on them.
    score = norm.ppf((np.arange(1, 5) - 0.375) / 4.25)
    within = 0.5 * (score[2] - score[0]) ** 2
    between = 0.5 * (0.5 * (score[1] + score[3]) - 0.5 * (score[0] + score[2])) ** 2
    by_ranks = math.sqrt(0.5 + between / within)
    assert r_hat(groups) >= by_ranks
    # Whatever keeps the order keeps the ranks: a tail cannot hide what the groups do.
    heavy = np.random.default_rng(2).standard_cauchy((4, 2000, 1))
    heavy[0] += 3.0
    assert r_hat(heavy) > 1.05


def test_groups_of_different_widths_are_told_apart() -> None:
    samples = np.random.default_rng(3).normal(size=(400, 20, 2))
    samples[:, 10:, 1] *= 2.0
    # Their means agree; by the means and variances alone R-hat would be 1.00.
    assert split_r_hat(samples) > 1.05


def test_what_does_not_move_is_not_converged_and_too_little_is_refused() -> None:
    assert split_r_hat(np.zeros((10, 4, 2))) == math.inf
    with pytest.raises(ValueError, match="steps"):
        split_r_hat(np.zeros((3, 4, 2)))
