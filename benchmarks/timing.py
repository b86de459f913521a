"""Timing for the benchmarks: the least of several repetitions, because everything else only adds.

``clock`` is wall time, or ``time.thread_time`` for code of a single thread on a machine that others use too.
"""

import time
from collections.abc import Callable


def least(
    function: Callable[[], object], repetitions: int = 7, clock: Callable[[], float] = time.perf_counter
) -> float:
    """Seconds of the fastest of several calls, after one that warms up."""
    function()
    times = []
    for _ in range(repetitions):
        began = clock()
        function()
        times.append(clock() - began)
    return min(times)


def in_turns(
    *functions: Callable[[], object], repetitions: int = 15, clock: Callable[[], float] = time.perf_counter
) -> list[float]:
    """Seconds of the fastest of several calls of each function, taken in turns so that all see the same machine."""
    best = [float("inf")] * len(functions)
    for _ in range(repetitions):
        for k, function in enumerate(functions):
            began = clock()
            function()
            best[k] = min(best[k], clock() - began)
    return best
