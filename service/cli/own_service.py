"""A service of a command's own: started with it, ended with it, by Ctrl-C too."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

from service.cli.watch import Show
from service.domain.views import GridView
from service.runtime import preflight
from service.runtime.installation import Installation, eventually, free_port
from service.runtime.settings import Settings
from service.runtime.start import STOPS
from service.runtime.supervisor import as_environment

_READY_S = 120.0


class StoppedError(RuntimeError):
    """Someone pressed Ctrl-C."""


class Wanted(threading.Event):
    """Set by the signal ``number``."""

    number = 0

    def by_signal(self, number: int, _frame: FrameType | None) -> None:
        """Handle it."""
        self.number = number
        self.set()

    def require_unset(self) -> None:
        """Go no further once it is set."""
        if self.is_set():
            raise StoppedError("interrupted")

    def until(self, show: Show) -> Show:
        """Show each look at a grid until it is set."""

        def shown(grid: GridView) -> None:
            show(grid)
            self.require_unset()

        return shown


@contextmanager
def own_service(settings: Settings) -> Iterator[tuple[Installation, Wanted]]:
    """The supervised service on a free port of this machine, for as long as the context lasts.

    The event is set when the user wants to stop. Cluster, database and store are those of the settings.
    """
    folder = settings.data_dir.absolute()
    own = {"data_dir": folder, "host": "127.0.0.1", "port": free_port(), "auth": None}
    settings = settings.model_copy(update=own)
    preflight.require_data(settings)
    wanted = Wanted()
    before = {number: signal.signal(number, wanted.by_signal) for number in STOPS}
    unset = [name for name in os.environ if name.startswith("HOSTLENS_")]
    service = Installation(folder, as_environment(settings), without=unset)
    try:
        yield service, wanted
    finally:
        with suppress(subprocess.TimeoutExpired):
            service.end(signal.SIGTERM)
        service.kill_all()
        for number, handler in before.items():
            signal.signal(number, handler)


def wait_until_ready(service: Installation, stop: Wanted) -> None:
    """Wait until it computes.

    Raises
    ------
    StoppedError
        The user does not want to wait.
    DidNotHappenError
        It does not start.
    """
    eventually(lambda: stop.is_set() or service.is_ready(), _READY_S, "readiness")
    stop.require_unset()
