"""How much goes through: runs without work, submission, overhead of short runs."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import ClassVar

import psutil

from service.store.migrate import upgrade
from tests.drills.drill import Drill, Ground, body
from tests.drills.installation import DrillError, Installation, free_port, installation
from tests.drills.postgres import PostgresServer
from tests.drills.remote import working_time
from tests.drills.report import Claim, Figure, Report, quantile
from tests.drills.stored import records

APART = (("service.api",), ("tests.drills.timed_dispatcher",))
"""API and dispatcher without a supervisor, and with the times of the claims."""


@contextmanager
def one_core(core: int | None = None) -> Iterator[int]:
    """Everything that is started within this context shares one core."""
    allowed = os.sched_getaffinity(0)
    chosen = max(allowed) if core is None else core
    os.sched_setaffinity(0, {chosen})
    try:
        yield chosen
    finally:
        os.sched_setaffinity(0, allowed)


@contextmanager
def timed(ground: Ground, settings: dict[str, str]) -> Iterator[Installation]:
    """An installation whose dispatcher writes down its claims."""
    folder = ground.folder / "drill"
    (folder / "data").mkdir(parents=True)
    upgrade(ground.database_url or f"sqlite:///{folder / 'data' / 'hostlens.sqlite'}")
    times = str(folder / "claims")
    everything = {"HOSTLENS_DRILL_TIMES": times, **ground.settings, **settings}
    with installation(folder, everything, commands=APART, ready=False) as service:
        yield service


def claim_times(service: Installation) -> list[float]:
    """Seconds of each claim that was made."""
    return [float(line.split()[0]) for line in (service.folder / "claims").read_text().splitlines()]


def start_threads(service: Installation, address: str, threads: int, processes: int = 1) -> None:
    """A scheduler and so many worker threads, shared out among processes: what sleeps in one costs little anywhere."""
    host, _, port = address.removeprefix("tcp://").partition(":")
    service.start("service", "scheduler", "--host", host, "--port", port, "--health", "127.0.0.1:0")
    each = threads // processes
    room = (address, "--nthreads", str(each), "--no-nanny", "--no-dashboard", "--memory-limit", "0")
    for _ in range(processes):
        service.start("service.dispatcher.dask_command", "worker", *room, "--preload", "service.runtime.logs")
    service.wait_ready(each * processes, timeout_s=600.0)


def cpu_seconds(service: Installation, server: PostgresServer | None = None) -> dict[str, float]:
    """CPU seconds so far of API, dispatcher and workers, and of the drill's own database server if it has one."""
    spent: dict[str, float] = {}
    for process in service.processes():
        with suppress(psutil.Error):
            command = process.cmdline()
            kind = "worker" if command[3:4] == ["worker"] else command[2].rpartition(".")[2]
            times = process.cpu_times()
            spent[kind] = spent.get(kind, 0.0) + times.user + times.system
    kinds = ("api", "timed_dispatcher", "dask_command", "worker")
    found = {kind: spent[kind] for kind in kinds if kind in spent}
    return found if server is None else {**found, "PostgreSQL": server.cpu_seconds()}


@dataclass(frozen=True)
class Throughput(Drill):
    """Runs that do nothing, so that only the queue is left."""

    name: ClassVar[str] = "throughput"
    what: ClassVar[str] = "100,000 runs without work through API, queue, Dask and store, all on one core"
    claim: ClassVar[str] = ">= 100 runs/s, dispatcher grows < 50 MB, claim p99 < 50 ms"
    small: ClassVar[dict[str, object]] = {"runs": 3000}

    runs: int = 100_000
    threads: int = 64

    def run(self, ground: Ground) -> Report:
        """Submit one grid and look at the dispatcher's memory while it is worked off."""
        address = f"tcp://127.0.0.1:{free_port()}"
        settings = {
            "HOSTLENS_TASK": "tests.drills.tasks:nothing",
            "HOSTLENS_SCHEDULER_ADDRESS": address,
            "HOSTLENS_RECONCILE_S": "10",
        }
        memory: list[tuple[int, float]] = []
        with one_core() as core, timed(ground, settings) as service:
            if ground.server is not None:
                ground.server.keep_to(core)
            start_threads(service, address, self.threads)
            dispatcher = service.child("tests.drills.timed_dispatcher")
            spent = cpu_seconds(service, ground.server)
            began = time.monotonic()
            grid = service.client.submit(body(self.runs))
            submitted = time.monotonic() - began

            def seen(view: object) -> None:
                done = view.counts.done  # type: ignore[attr-defined]
                memory.append((done, dispatcher.memory_info().rss / 1e6 if dispatcher is not None else 0.0))
                time.sleep(0.9)

            service.watch(grid.id, seen, timeout_s=3600)
            took = time.monotonic() - began - submitted
            used = {
                name: seconds - spent.get(name, 0.0) for name, seconds in cpu_seconds(service, ground.server).items()
            }
            load = os.getloadavg()[0]
            found = records(service, grid.id)
            claims = claim_times(service)
        # What the process needs to warm up is no growth.
        warm = next((size for done, size in memory if done >= 0.02 * self.runs), memory[-1][1])
        middle = next((size for done, size in memory if done >= 0.5 * self.runs), memory[-1][1])
        rate, growth, p99 = self.runs / took, memory[-1][1] - warm, 1e3 * quantile(claims, 0.99)
        return Report(
            self.name,
            f"{self.runs} runs, {self.threads} worker threads, "
            f"all processes{'' if ground.owns_database else ' but the database'} on one core, {ground.backend}",
            (
                Figure("rate", rate, "runs/s"),
                Figure("submission", submitted, "s"),
                Figure("wall time after it", took, "s"),
                *(Figure(f"CPU a run, {name}", 1e3 * seconds / self.runs, "ms") for name, seconds in used.items()),
                Figure("runs per CPU second", self.runs / sum(used.values()), "runs/s"),
                Figure("dispatcher memory, warm", warm, "MB"),
                Figure("dispatcher memory, growth", growth, "MB"),
                Figure("of it in the second half", memory[-1][1] - middle, "MB"),
                Figure("claims", len(claims)),
                Figure("claim, median", 1e3 * quantile(claims, 0.5), "ms"),
                Figure("claim, p99", p99, "ms"),
                Figure("claim, longest", 1e3 * max(claims), "ms"),
                Figure("load of the machine at the end", load),
            ),
            (
                Claim(f"{self.runs} runs done, each stored once", found.stored == self.runs),
                Claim("at least 100 runs/s", rate >= 100),
                Claim("the dispatcher grows by less than 50 MB", growth < 50),
                Claim("claim p99 below 50 ms", p99 < 50),
            ),
        )


@dataclass(frozen=True)
class Overhead(Drill):
    """What the service adds to runs of a second."""

    name: ClassVar[str] = "overhead"
    what: ClassVar[str] = "60 runs of 1 s on two local workers, settings as they are by default"
    claim: ClassVar[str] = "overhead of a run < 2 % of its second"
    small: ClassVar[dict[str, object]] = {"runs": 8}

    runs: int = 60
    sleep_s: float = 1.0
    workers: int = 2

    def run(self, ground: Ground) -> Report:
        """Compare the time from the first start to the last end with what the runs alone would take."""
        settings = {
            "HOSTLENS_DRILL_SLEEP": str(self.sleep_s),
            "HOSTLENS_WORKERS": str(self.workers),
            **ground.settings,
        }
        with installation(ground.folder / "drill", settings) as service:
            service.wait_ready(self.workers)
            grid = service.client.submit(body(self.runs))
            service.watch(grid.id, every_s=1.0)
            took = working_time(service, grid.id)
            found = records(service, grid.id)
        alone = self.sleep_s * self.runs / self.workers
        share = took / alone - 1.0
        return Report(
            self.name,
            f"{self.runs} runs of {self.sleep_s:g} s, {self.workers} local workers, {ground.backend}",
            (
                Figure("first start to last end", took, "s"),
                Figure("the runs alone", alone, "s"),
                Figure("overhead of a run", 1e3 * share * self.sleep_s, "ms"),
                Figure("share", 1e2 * share, "%"),
                Figure("load of the machine at the end", os.getloadavg()[0]),
            ),
            (
                Claim(f"{self.runs} runs done, each stored once", found.stored == self.runs),
                Claim("overhead below 2 %", share < 0.02),
            ),
        )


@dataclass(frozen=True)
class Breadth(Drill):
    """As many workers as a cluster has, and the dispatcher on one core."""

    name: ClassVar[str] = "breadth"
    what: ClassVar[str] = "1,000 worker threads with runs of 5 to 15 s; the dispatcher has one core"
    claim: ClassVar[str] = "100 runs/s stored: < 10 ms of the dispatcher's CPU a run"
    small: ClassVar[dict[str, object]] = {"runs": 200, "threads": 20, "sleep_s": 1.0}

    runs: int = 5000
    threads: int = 1000
    processes: int = 1
    """The threads are shared out among so many; what sleeps in one of them costs as little as elsewhere."""
    sleep_s: float = 10.0

    def run(self, ground: Ground) -> Report:
        """Work off one grid on a scheduler and workers apart; what each process spends on it."""
        address = f"tcp://127.0.0.1:{free_port()}"
        settings = {
            "HOSTLENS_SCHEDULER_ADDRESS": address,
            "HOSTLENS_DRILL_SLEEP": str(self.sleep_s / 2.0),
            "HOSTLENS_TASK": "tests.drills.tasks:uneven",
            "HOSTLENS_RECONCILE_S": "10",
        }
        with timed(ground, settings) as service:
            start_threads(service, address, self.threads, self.processes)
            dispatcher = service.child("tests.drills.timed_dispatcher")
            if dispatcher is None:
                raise DrillError("the dispatcher is gone")
            dispatcher.cpu_affinity([max(os.sched_getaffinity(0))])
            before = dispatcher.cpu_times()
            grid = service.client.submit(body(self.runs))
            service.watch(grid.id, every_s=2.0, timeout_s=3600)
            after = dispatcher.cpu_times()
            took = working_time(service, grid.id)
            spent = after.user + after.system - before.user - before.system
            found, claims, load = records(service, grid.id), claim_times(service), os.getloadavg()[0]
        alone = self.sleep_s * self.runs / self.threads
        return Report(
            self.name,
            f"{self.runs} runs of {self.sleep_s:g} s on average, {self.threads} threads in {self.processes} processes, "
            f"{ground.backend}",
            (
                Figure("first start to last end", took, "s"),
                Figure("the runs alone", alone, "s"),
                Figure("rate", self.runs / took, "runs/s"),
                Figure("CPU a run, dispatcher", 1e3 * spent / self.runs, "ms"),
                Figure("runs a second of the dispatcher's core", self.runs / spent, "runs/s"),
                Figure("claims", len(claims)),
                Figure("claim, median", 1e3 * quantile(claims, 0.5), "ms"),
                Figure("load of the machine at the end", load),
            ),
            (
                Claim(f"{self.runs} runs done, each stored once", found.stored == self.runs),
                Claim("less than 10 ms of the dispatcher's CPU a run", spent < 0.01 * self.runs),
            ),
        )
