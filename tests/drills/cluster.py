"""``hostlens scheduler`` and ``hostlens worker`` as processes of their own, started again when they end."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from threading import Event, Thread

from tests.drills.installation import Installation, free_port


@dataclass
class Cluster:
    """How scheduler and workers are started beside a service."""

    service: Installation
    workers: int
    port: int = field(default_factory=free_port)

    @property
    def address(self) -> str:
        """Where the scheduler listens."""
        return f"tcp://127.0.0.1:{self.port}"

    def scheduler(self) -> subprocess.Popen[bytes]:
        """Start the scheduler."""
        listen = ("--host", "127.0.0.1", "--port", str(self.port), "--health", "127.0.0.1:0")
        return self.service.start("service", "scheduler", *listen)

    def worker(self) -> subprocess.Popen[bytes]:
        """Start a worker with one thread."""
        return self.service.start("service", "worker", self.address)


@contextmanager
def kept_running(cluster: Cluster) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Scheduler (first) and workers for as long as the context lasts."""
    running = [cluster.scheduler(), *(cluster.worker() for _ in range(cluster.workers))]
    stop = Event()

    def look() -> None:
        while not stop.wait(0.2):
            for place, process in enumerate(running):
                if process.poll() is not None and not stop.is_set():
                    running[place] = cluster.worker() if place else cluster.scheduler()

    keeper = Thread(target=look, name="keeper")
    keeper.start()
    try:
        yield running
    finally:
        stop.set()
        keeper.join()
