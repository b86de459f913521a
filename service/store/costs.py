"""What runs should take, by stored runs of their kind."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping
from datetime import datetime

from sqlalchemy import Connection, select

from service.domain.identifiers import utc_now
from service.domain.plan import Kind
from service.domain.views import Cost, CostKind, Interval
from service.store.database import Database
from service.store.leadership import leader_view
from service.store.tables import input_group, result

_ENOUGH = 5
"""Stored runs below which their spread says little."""
_LOOKED_AT = 200
_INPUTS = 100
_MOST_KINDS = 50
"""Each costs a look into the database: a request of a thousand cameras is not answered by a thousand of them."""

Times = dict[Kind, list[tuple[float, float]]]
"""CPU and wall seconds of stored runs of each kind."""


class CostStore:
    """Looks at what stored runs took."""

    def __init__(self, database: Database, clock: Callable[[], datetime] = utc_now) -> None:
        self._database = database
        self._clock = clock

    def cost(self, runs: Mapping[Kind, int]) -> Cost:
        """CPU and wall seconds of so many runs of each kind, the wall on the workers that there are now.

        An interval is two standard deviations of the sum either way: of the runs that are to come, and of the mean of
        those that were. There is none where a kind has fewer than five stored runs; ``unknown`` says which.
        """
        with self._database.read() as connection:
            times = _times(connection, runs)
            leader = leader_view(connection)
        workers = 0 if leader is None else leader.workers
        unknown = [_kind_view(kind) for kind in runs if len(times.get(kind, ())) < _ENOUGH]
        cpu_s = wall_s = None
        if not unknown:
            cpu_s = _interval({kind: [cpu for cpu, _ in times[kind]] for kind in runs}, runs)
            alone = _interval({kind: [wall for _, wall in times[kind]] for kind in runs}, runs)
            at_once = min(workers, sum(runs.values()))
            wall_s = Interval(**{name: value / at_once for name, value in alone}) if at_once else None
        stored = sum(map(len, times.values()))
        return Cost(cpu_s=cpu_s, wall_s=wall_s, workers=workers, stored_runs=stored, unknown=unknown)

    def expected_wall_s(self, runs: Mapping[Kind, int]) -> float | None:
        """What so many runs should take on one worker [s]; None where it is not known."""
        with self._database.read() as connection:
            times = _times(connection, runs)
        if any(len(times.get(kind, ())) < _ENOUGH for kind in runs):
            return None
        return math.fsum(number * statistics.fmean(wall for _, wall in times[kind]) for kind, number in runs.items())


def _times(connection: Connection, kinds: Mapping[Kind, int]) -> Times:
    """Of each kind a few hundred stored runs, of the newest inputs."""
    return {kind: _times_of(connection, kind) for kind in list(kinds)[:_MOST_KINDS]}


def _times_of(connection: Connection, kind: Kind) -> list[tuple[float, float]]:
    alike = [input_group.c[name] == value for name, value in kind._asdict().items()]
    newest = select(input_group.c.id).where(*alike).order_by(input_group.c.id.desc()).limit(_INPUTS)
    inputs = connection.scalars(newest).all()
    taken = select(result.c.cpu_s, result.c.wall_s).where(result.c.input_id.in_(inputs)).limit(_LOOKED_AT)
    return [(row.cpu_s, row.wall_s) for row in connection.execute(taken)] if inputs else []


def _interval(taken: Mapping[Kind, list[float]], runs: Mapping[Kind, int]) -> Interval:
    expected = variance = 0.0
    for kind, number in runs.items():
        expected += number * statistics.fmean(taken[kind])
        variance += statistics.variance(taken[kind]) * (number + number**2 / len(taken[kind]))
    either_way = 2.0 * math.sqrt(variance)
    return Interval(low=max(expected - either_way, 0.0), expected=expected, high=expected + either_way)


def _kind_view(kind: Kind) -> CostKind:
    return CostKind(**kind._asdict())
