"""What every process of the service does about its parent and its siblings."""

from __future__ import annotations

import gc
import os
import signal
import threading

PARENT_FD = "HOSTLENS_PARENT_FD"
"""Names the pipe whose other end only the supervisor holds."""


def spare_collector() -> None:
    """Take what is loaded by now out of Python's garbage collection, and have it run less often.

    A summary of a thousand inputs makes twenty thousand objects, and every few hundred of them the collector would look
    through all of the engine again: half of the time that the answer takes.
    """
    gc.enable()
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 100)


def stop_with_parent() -> None:
    """End as if by SIGTERM when the supervisor is gone, however it went; without one, do nothing.

    The pipe closes with the supervisor even on kill -9, where no handler of its own could run.
    """
    descriptor = os.environ.pop(PARENT_FD, None)
    if descriptor is not None:
        threading.Thread(target=_watch, args=(int(descriptor),), name="parent-watch", daemon=True).start()


def _watch(descriptor: int) -> None:
    while os.read(descriptor, 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
