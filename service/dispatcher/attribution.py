"""Who killed a worker: nobody is charged for another's crash.

A run that was alone on a worker that died is charged with it. Where several runs could have done it - they shared the
worker, or several workers died at once - nobody is, and all of them go to the suspect lane, where each runs alone: the
next death there is certain to be its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

FlightT = TypeVar("FlightT")

JUDGE_AFTER_S = 1.0
"""Deaths closer together than this are taken for one: a machine that fails takes its workers within moments."""


@dataclass(frozen=True)
class Verdict(Generic[FlightT]):
    """What a death means: a run that did it, or several that may have."""

    guilty: FlightT | None
    suspects: tuple[FlightT, ...]


class Deaths(Generic[FlightT]):
    """Runs whose workers died, until enough time has passed to tell."""

    def __init__(self, judge_after_s: float = JUDGE_AFTER_S) -> None:
        self._judge_after_s = judge_after_s
        self._flights: list[FlightT] = []
        self._latest = 0.0

    def add(self, flights: Sequence[FlightT], now: float) -> None:
        """Runs that were on a worker when it died."""
        if flights:
            self._flights += flights
            self._latest = now

    def __len__(self) -> int:
        return len(self._flights)

    @property
    def waiting(self) -> tuple[FlightT, ...]:
        """Runs that are not judged yet."""
        return tuple(self._flights)

    def take_back(self) -> tuple[FlightT, ...]:
        """Give up judging: everything that waits for it, once."""
        flights, self._flights = tuple(self._flights), []
        return flights

    def judge(self, now: float) -> Verdict[FlightT] | None:
        """The verdict once nothing more has died for a moment, None before and where nothing died."""
        if not self._flights or now - self._latest < self._judge_after_s:
            return None
        flights = self.take_back()
        return Verdict(flights[0], ()) if len(flights) == 1 else Verdict(None, flights)
