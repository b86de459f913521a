"""A process of its own for drawing: matplotlib holds the interpreter, and whoever asks for anything else would wait."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context, parent_process
from typing import Any, TypeVar

T = TypeVar("T")


class DrawingProcess:
    """Starts with the first figure, begins anew where it was killed, and ends with the process that asks it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pool: ProcessPoolExecutor | None = None

    def call(self, function: Callable[..., T], *arguments: Any) -> T:
        """What a function of a module gives for some arguments there; raises what it raises."""
        pool = self._running()
        try:
            return pool.submit(function, *arguments).result()
        except BrokenProcessPool:
            # Killed for its memory, say: once more, and if it dies of this figure too that is told.
            self._forget(pool)
        return self._running().submit(function, *arguments).result()

    def _running(self) -> ProcessPoolExecutor:
        with self._lock:
            if self._pool is None:
                # Not forked: this process has threads, whose locks nobody would open in a copy.
                self._pool = ProcessPoolExecutor(1, get_context("spawn"), _begin)
            return self._pool

    def _forget(self, pool: ProcessPoolExecutor) -> None:
        with self._lock:
            if self._pool is pool:
                self._pool = None


def _begin() -> None:
    # Ctrl-C reaches all processes of a terminal; the one that asks ends this one.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_the_other, name="end with the API", daemon=True).start()


def _end_with_the_other() -> None:
    """Killed, it cannot say so, and this process would wait for figures for ever."""
    other = parent_process()
    if other is not None:
        other.join()
        os._exit(0)
