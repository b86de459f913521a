"""``python -m tests.drills.timed_dispatcher``: the dispatcher, with the time of every claim written down.

The file named by ``HOSTLENS_DRILL_TIMES`` gets a line for each claim that was made: its seconds and its runs.
"""

from __future__ import annotations

import gc
import os
import sys
import time
from typing import Any

from service.runtime.settings import Settings
from service.store.leases import Lease
from service.store.queue import RunQueue

_CLAIM = RunQueue.claim


def _timed_claim(queue: RunQueue, *arguments: Any, **options: Any) -> list[Lease]:
    began = time.perf_counter()
    leases = _CLAIM(queue, *arguments, **options)
    took = time.perf_counter() - began
    with open(os.environ["HOSTLENS_DRILL_TIMES"], "a", encoding="utf-8") as file:
        file.write(f"{took:.6f} {len(leases)}\n")
    return leases


if __name__ == "__main__":
    gc.disable()
    from service.dispatcher.cluster_process import prepare_host
    from service.dispatcher.dispatch import dispatch

    prepare_host()
    setattr(RunQueue, "claim", _timed_claim)  # noqa: B010 - mypy refuses the assignment
    sys.exit(dispatch(Settings()))
