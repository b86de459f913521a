"""A process beside the dispatcher for a cluster that is started from here: Dask's scheduler, its nannies, the nursery.

Scheduler and nannies carry out what anybody with the cluster's credentials tells them to, and every worker has these:
so they are kept out of the process that has the database, and know nothing of it. The dispatcher starts this one first
of all, and it loads while that does; a line on its standard input, the settings, makes it start the cluster, and the
end of that input, with the dispatcher, makes it end.
"""

from __future__ import annotations

import json
import logging
import os
import select
import signal
import subprocess
import sys
from contextlib import suppress
from typing import IO, TYPE_CHECKING, Any, cast

from service.runtime import start

if TYPE_CHECKING:
    from service.runtime.settings import Settings

_START_S = 120.0
_CLOSE_S, _END_S = 7.0, 3.0
_SECRETS = ("PG", "HOSTLENS_DATABASE_URL", "HOSTLENS_PARENT_FD")
"""What the names of variables begin with that no worker is to see."""


class Host:
    """The process, as the dispatcher holds it."""

    def __init__(self, kind: str) -> None:
        environment = {name: value for name, value in os.environ.items() if not name.startswith(_SECRETS)}
        with start.kept_back():
            self._process = subprocess.Popen(
                [sys.executable, "-m", "service.dispatcher.cluster_process", kind],
                env=environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
            )
        self._input = cast("IO[bytes]", self._process.stdin)
        self._output = cast("IO[bytes]", self._process.stdout)

    def start_cluster(self, settings: Settings) -> dict[str, Any]:
        """Address and credentials of the scheduler; OSError where there is none."""
        line = settings.model_dump_json(exclude={"database_url"}).encode() + b"\n"
        self._input.write(line)
        self._input.flush()
        if not select.select([self._output], [], [], _START_S)[0]:
            raise TimeoutError(f"the cluster did not start within {_START_S:g} s")
        said = self._output.readline()
        if not said:
            raise OSError("the cluster did not start")
        found: dict[str, Any] = json.loads(said)
        return found

    def close(self) -> None:
        """End the cluster and the process."""
        with suppress(OSError):
            self._input.close()
        self._wait(_CLOSE_S)

    def end(self) -> None:
        """End the process, which has no cluster yet: while it still loads it would not notice the end of its input."""
        self._process.terminate()
        with suppress(OSError):
            self._input.close()
        self._wait(_END_S)

    def _wait(self, patience_s: float) -> None:
        try:
            self._process.wait(patience_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._output.close()


_prepared: list[Host] = []


def prepare_host() -> None:
    """Start the process for workers of this machine, if it has not been; it loads what it needs and waits."""
    if not _prepared:
        # A signal meanwhile waits until it is known whom to end.
        with start.kept_back():
            _prepared.append(Host("local"))


def take_host(kind: str) -> Host:
    """The process that was prepared, or another where that has been taken or the workers are not of this machine."""
    return _prepared.pop() if _prepared and kind == "local" else Host(kind)


def end_prepared() -> None:
    """End the process that was prepared, if nobody has taken it."""
    while _prepared:
        _prepared.pop().end()


def _serve() -> None:
    """What the process does."""
    start.begin()
    # Ctrl-C in a terminal reaches all of a process group; this process ends with its dispatcher.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Only the answer may go where the dispatcher reads; whatever else is printed is a log.
    answer = os.dup(1)
    os.dup2(2, 1)
    from service.worker.fork_server import close_nursery, open_nursery

    start.on_early_end(close_nursery)
    if sys.argv[1:] == ["local"]:
        # Before all else, so that it loads while this process does.
        open_nursery()
    try:
        _serve_cluster(answer)
    finally:
        close_nursery()


def _serve_cluster(answer: int) -> None:
    """Start the cluster once the settings have come, and keep it until the dispatcher is done with it."""
    from service.dispatcher.clusters import start_cluster
    from service.runtime import logs
    from service.runtime.settings import Settings

    line = sys.stdin.readline()
    if not line:
        return
    settings = Settings(**json.loads(line))
    logs.configure(settings, "cluster")
    # Dask says at INFO and WARNING what is normal here: workers that come and go with us.
    logging.getLogger("distributed").setLevel(logging.ERROR)
    with start_cluster(settings) as found:
        os.write(answer, json.dumps(found).encode() + b"\n")
        os.close(answer)
        sys.stdin.read()  # to its end


# Dask's workers import this module again when they are spawned; only the process itself serves.
if __name__ == "__main__":
    _serve()
