"""CPU seconds of a call, and settings measured one after the other."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from engine.accuracy.curves import Curve, Knob, Point, Refusal
from engine.errors import EngineError

_REPETITIONS, _ENOUGH_SECONDS = 15, 0.2


def least_cpu(work: Callable[[], object]) -> float:
    """CPU seconds of this thread in the fastest of several calls, after one that warms up; fewer of a slow one."""
    first = cpu_of(work)
    times = [cpu_of(work)]
    while len(times) < _REPETITIONS and first + sum(times) < _ENOUGH_SECONDS:
        times.append(cpu_of(work))
    return min(times)


def cpu_of(work: Callable[[], object]) -> float:
    """CPU seconds of this thread in one call, of work that is remembered or too long to be repeated."""
    began = time.thread_time()
    work()
    return time.thread_time() - began


@dataclass
class Measuring:
    """A curve that grows."""

    knob: Knob
    floor: float = 0.0
    points: list[Point] = field(default_factory=list)
    refused: list[Refusal] = field(default_factory=list)

    def add(self, setting: str, measure: Callable[[], tuple[float, float]], *, default: bool = False) -> None:
        """Take the (cost, error) of a setting, or what the engine says against it."""
        try:
            cost, error = measure()
        except EngineError as refusal:
            self.refused.append(Refusal(setting, str(refusal)))
        else:
            self.points.append(Point(setting, cost, error, default))

    def add_peers(self, points: Iterable[Point]) -> None:
        """Points of other programs."""
        self.points += points

    def curve(self) -> Curve:
        """What was measured."""
        return Curve(self.knob, self.floor, tuple(self.points), tuple(self.refused))
