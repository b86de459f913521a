"""``hostlens drill``: the drills by name."""

from __future__ import annotations

from collections.abc import Iterable

from service.drills.drill import Drill
from service.drills.kills import DispatcherKills, SchedulerKills, WorkerKills
from service.drills.scale import Throughput

DRILLS: dict[str, type[Drill]] = {
    drill.name: drill
    for drill in (
        DispatcherKills,
        WorkerKills,
        SchedulerKills,
        Throughput,
    )
}
