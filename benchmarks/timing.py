"""Timing for the benchmarks: the least of several repetitions, because everything else only adds."""

import time
from collections.abc import Callable


def least(function: Callable[[], object], repetitions: int = 7) -> float:
    """Seconds of the fastest of several calls, after one that warms up."""
    function()
    times = []
    for _ in range(repetitions):
        began = time.perf_counter()
        function()
        times.append(time.perf_counter() - began)
    return min(times)


def in_turns(*functions: Callable[[], object], repetitions: int = 15) -> list[float]:
    """Seconds of the fastest of several calls of each function, taken in turns so that all see the same machine."""
    best = [float("inf")] * len(functions)
    for _ in range(repetitions):
        for k, function in enumerate(functions):
            began = time.perf_counter()
            function()
            best[k] = min(best[k], time.perf_counter() - began)
    return best
