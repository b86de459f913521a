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
