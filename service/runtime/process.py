"""What every process of the service does about its parent and its siblings."""

from __future__ import annotations

import gc
import os
import signal
import threading
from socket import socket

PARENT_FD = "HOSTLENS_PARENT_FD"
"""Names the pipe whose other end only the supervisor holds."""
LISTENER_FD = "HOSTLENS_LISTENER_FD"
"""Names the socket that the supervisor listens on, for its API processes to accept from."""
API_NUMBER = "HOSTLENS_API_NUMBER"
"""Which of several API processes this one is: its next start goes on with its metrics."""
METRICS_DIR = "PROMETHEUS_MULTIPROC_DIR"
"""Where API processes keep their metrics, so that each can tell those of all; the variable is Prometheus's own."""


def spare_collector() -> None:
    """Take what is loaded by now out of Python's garbage collection, and have it run less often.

    A summary of a thousand inputs makes twenty thousand objects, and every few hundred of them the collector would look
    through all of the engine again: half of the time that the answer takes.
    """
    gc.enable()
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 100)


def inherited_listener() -> socket | None:
    """The socket that a supervisor listens on for this process; None where there is none."""
    descriptor = os.environ.pop(LISTENER_FD, None)
    return None if descriptor is None else socket(fileno=int(descriptor))


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
