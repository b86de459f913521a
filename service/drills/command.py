"""The drills by name, for ``hostlens drill``."""

from __future__ import annotations

from service.drills.drill import Drill
from service.drills.kills import DispatcherKills, SchedulerKills, WorkerKills
from service.drills.outages import DiskFull, PostgresKills, SqliteLock
from service.drills.requests import Cancel, Idempotency
from service.drills.rivals import Poison, StoppedWorker, TwoDispatchers
from service.drills.scale import Throughput
from service.drills.volume import Listing, Submission

DRILLS: dict[str, type[Drill]] = {
    drill.name: drill
    for drill in (
        DispatcherKills,
        WorkerKills,
        SchedulerKills,
        PostgresKills,
        SqliteLock,
        StoppedWorker,
        TwoDispatchers,
        Poison,
        Cancel,
        Idempotency,
        DiskFull,
        Throughput,
        Submission,
        Listing,
    )
}
