"""How long others wait while a very large grid is stored, cancelled, paused, resumed and tried again.

``python -m benchmarks.large_grids [--runs 100000] [--database postgresql]``: one process works on the grid as the API
does; another commits one small transaction after the other, as a dispatcher and its heartbeat do, and keeps the longest
that one of them took. Before each figure the counts of the grid are asserted.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.synchronize import Event

from service.domain.requests import GridRequest, plan
from service.store.database import Database
from service.store.grids import GridStore
from service.store.leadership import Leadership
from service.store.migrate import upgrade
from tests.drills.postgres import postgres_server


def rival(url: str, stop: Event, longest: multiprocessing.Queue[tuple[float, int]]) -> None:
    """Beat as a leader does, again and again; tell the longest beat [s] and how many there were."""
    database = Database(url)
    leadership = Leadership(database)
    generation = leadership.take("rival", lambda _: True) or 0
    waits = []
    while not stop.is_set():
        began = time.perf_counter()
        leadership.beat(generation, {"engine": 2})
        waits.append(time.perf_counter() - began)
        time.sleep(0.005)
    longest.put((max(waits), len(waits)))
    database.close()


@contextmanager
def beside_a_rival(url: str, what: str) -> Iterator[None]:
    context = multiprocessing.get_context("spawn")
    stop, longest = context.Event(), context.Queue()
    process = context.Process(target=rival, args=(url, stop, longest))
    process.start()
    time.sleep(2.0)
    began = time.perf_counter()
    yield
    took = time.perf_counter() - began
    stop.set()
    worst, beats = longest.get(timeout=60)
    process.join()
    print(f"{what:10s} {took:8.2f} {worst:18.3f} {beats:8d}", flush=True)


def measure(url: str, runs: int) -> None:
    upgrade(url)
    database = Database(url)
    grids = GridStore(database)
    request = GridRequest.model_validate({"preset": "h0licow-vi/HE0435", "replicates": -(-runs // 48)})
    made: list[str] = []

    def submit() -> None:
        made.append(grids.create(request.canonical(), lambda: plan(request, 10 * runs)).grid.id)

    steps: tuple[tuple[str, Callable[[], object], str], ...] = (
        ("submit", submit, "queued"),
        ("pause", lambda: grids.pause(made[0]), "paused"),
        ("resume", lambda: grids.resume(made[0]), "queued"),
        ("cancel", lambda: grids.cancel(made[0]), "cancelled"),
        ("retry", lambda: grids.revive(made[0]), "queued"),
    )
    print(f"{'':10s} {'took [s]':>8s} {'longest wait [s]':>18s} {'beats':>8s}")
    for name, step, state in steps:
        with beside_a_rival(url, name):
            step()
        counts = grids.grid(made[0]).counts
        assert getattr(counts, state) >= runs, (name, counts)
    database.close()
    print(f"load {os.getloadavg()[0]:.1f}")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=100_000)
    parser.add_argument("--database", choices=("sqlite", "postgresql"), default="sqlite")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        if options.database == "sqlite":
            measure(f"sqlite:///{folder}/large.sqlite", options.runs)
            return
        with postgres_server() as server:
            measure(server.create("large"), options.runs)


if __name__ == "__main__":
    main()
