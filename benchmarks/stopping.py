"""What stop-when-precise rules do to a mean: how far it is off where they stop, and after how many replicates.

``python -m benchmarks.stopping [--points 4000]``: biases of known distributions with a standard deviation of one are
looked at after each replicate. ``n*`` is how many one would take who knew the scatter. All in units of the error that
is asked for: root mean square and mean of (mean - truth), and the part of the points whose true standard error is more
than 1.25 times it.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import special, stats

from service.domain.precision import upper_limit

Floats = NDArray[np.float64]


def outliers(dice: np.random.Generator, shape: tuple[int, int]) -> Floats:
    """Five in a hundred scatter by five times as much."""
    wide = np.where(dice.random(shape) < 0.05, 5.0, 1.0)
    return dice.standard_normal(shape) * wide / math.sqrt(0.95 + 0.05 * 25.0)


BIASES: dict[str, Callable[[np.random.Generator, tuple[int, int]], Floats]] = {
    "normal": lambda dice, shape: dice.standard_normal(shape),
    "tails (t, 4)": lambda dice, shape: dice.standard_t(4, shape) / math.sqrt(2.0),
    "outliers": outliers,
    "skew (gamma, 2)": lambda dice, shape: (dice.gamma(2.0, 1.0, shape) - 2.0) / math.sqrt(2.0),
}


def factors(numbers: NDArray[np.int_]) -> dict[str, Floats]:
    """By how much more than s / sqrt(n) each rule takes the standard error to be."""
    k = np.maximum(numbers - 1, 1)
    return {
        "s / sqrt(n)": np.ones(len(numbers)),
        "Student's t at 84 %": special.stdtrit(k, stats.norm.cdf(1.0)),
        "limit at 84 % (ours)": np.array([upper_limit(1.0, number) or np.inf for number in numbers.tolist()]),
        "limit at 95 %": np.sqrt(k / stats.chi2.ppf(0.05, k)),
    }


def measure(points: int, at_least: int) -> None:
    print(f"{'biases':16s} {'n*':>4s} {'rule':22s} {'rms':>5s} {'shift':>6s} {'runs/n*':>8s} {'>1.25':>6s}")
    for name, draw in BIASES.items():
        for ratio in (3.0, 5.0, 8.0):
            runs = int(4 * ratio**2) + 60
            values = draw(np.random.default_rng(1), (points, runs))
            numbers = np.arange(1, runs + 1)
            means = np.cumsum(values, axis=1) / numbers
            with np.errstate(invalid="ignore", divide="ignore"):
                variance = (np.cumsum(values**2, axis=1) - numbers * means**2) / (numbers - 1)
            scatter = np.sqrt(np.maximum(variance, 0.0))
            for rule, factor in factors(numbers).items():
                kept = (factor * scatter / np.sqrt(numbers) <= 1.0 / ratio) & (numbers >= at_least)
                kept[:, -1] = True
                stops = kept.argmax(axis=1)
                off = means[np.arange(points), stops] * ratio
                worse = np.mean(ratio / np.sqrt(stops + 1.0) > 1.25)
                said = f"{math.sqrt(np.mean(off**2)):5.2f} {off.mean():+6.2f} {np.mean(stops + 1) / ratio**2:8.2f}"
                print(f"{name:16s} {ratio**2:4.0f} {rule:22s} {said} {worse:6.2f}")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=4000)
    parser.add_argument("--at-least", type=int, default=10)
    options = parser.parse_args(arguments)
    measure(options.points, options.at_least)


if __name__ == "__main__":
    main()
