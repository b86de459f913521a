"""A handler that writes to standard error and never waits for whoever reads it."""

from __future__ import annotations

import logging
import os
import queue
import sys
import threading
import time

_MOST_LINES = 10_000
_LAST_S = 1.0
"""How long the end of a process waits for its last lines to be taken."""
_AGAIN_S = 0.05


class PatientHandler(logging.Handler):
    """Lines wait in memory for a thread that writes them, and are dropped, and counted, where too many wait.

    A pipe that nobody reads takes 64 KiB; whoever then writes to it stands still, with all locks that it holds.
    """

    def __init__(self) -> None:
        super().__init__()
        self._lines: queue.Queue[str] = queue.Queue(_MOST_LINES)
        self._dropped = 0
        self._thread: threading.Thread | None = None

    def emit(self, record: logging.LogRecord) -> None:
        """Hand over a line."""
        try:
            line = self.format(record)
        except Exception:  # noqa: BLE001 - as every handler of the standard library: a line never breaks its caller
            self.handleError(record)
            return
        descriptor = _descriptor()
        if descriptor is None:
            print(line, file=sys.stderr)  # in memory: there is nobody to wait for
            return
        if self._thread is None:
            self._thread = threading.Thread(target=self._write, args=(descriptor,), name="log-writer", daemon=True)
            self._thread.start()
        try:
            self._lines.put_nowait(line)
        except queue.Full:
            self._dropped += 1

    def flush(self) -> None:
        """Wait until all is written, or until it is clear that nobody reads."""
        until = time.monotonic() + _LAST_S
        while self._lines.unfinished_tasks and time.monotonic() < until:
            time.sleep(0.002)

    def _write(self, descriptor: int) -> None:
        while True:
            line = self._lines.get()
            dropped, self._dropped = self._dropped, 0
            if dropped:
                line = f"{line}\n{dropped} lines were dropped before this, because nobody read them"
            # Not by sys.stderr, whose lock the end of the process needs.
            left = f"{line}\n".encode(errors="replace")
            while left:
                try:
                    left = left[os.write(descriptor, left) :]
                except BlockingIOError:
                    time.sleep(_AGAIN_S)
                except OSError:
                    break  # whoever read it is gone
            self._lines.task_done()


def _descriptor() -> int | None:
    try:
        return sys.stderr.fileno()
    except (AttributeError, OSError, ValueError):
        return None
