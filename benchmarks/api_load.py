"""What a simple read of the API costs and how long it takes, at 50 clients and beside a grid that moves.

``python -m benchmarks.api_load`` starts a real API over a database with a grid of 3,000 runs that another process
finishes at 20 a second, checks what each address answers, and then asks from 50 keep-alive connections, each as fast as
it is answered. The client is one process that does nothing but send prepared bytes and find the end of the answer.
What waits for a thread is read once for all who ask for it: 50 runs, one for each connection, cost more than one.
CPU per request counts all API processes; unlike the latencies it does not depend on what else the machine does.

``--against FOLDER`` measures another checkout in the same run; ``--streams N`` holds so many event streams open
meanwhile and asks how long ``/healthz`` takes.
"""

from __future__ import annotations

import argparse
import os
import selectors
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import psutil

from service.store.database import Database
from service.store.grids import GridStore
from service.store.leadership import Leadership
from service.store.queue import RunQueue
from tests.drills.installation import eventually, free_port
from tests.service.plans import planned, result_of

ROOT = Path(__file__).resolve().parents[1]
RUNS = 3000
DONE = 100
RATE = 20.0
CLIENTS = 50
_UNDER_WAY = "hostlens_http_requests_in_progress"
_FILL = """
import sys
from benchmarks.api_load import fill
from service.store.migrate import upgrade
upgrade(sys.argv[1])
print(*fill(sys.argv[1]))
"""
_SERVE = """
import signal, threading
from service.runtime.settings import Settings
from service.runtime.supervisor import Supervisor
stop = threading.Event()
signal.signal(signal.SIGTERM, lambda *_: stop.set())
Supervisor(Settings(), modules=("service.api",)).run(stop)
"""


@dataclass
class Sample:
    """Latencies [s] of one address, and CPU of the API processes for each request [s]."""

    latencies: list[float] = field(default_factory=list)
    cpu_s: float = 0.0
    wall_s: float = 0.0

    def row(self) -> str:
        times = sorted(self.latencies)
        p50, p99 = (1e3 * times[int(part * (len(times) - 1))] for part in (0.5, 0.99))
        rate = len(times) / self.wall_s
        return f"{len(times):7d} {rate:8.0f} {p50:8.1f} {p99:8.1f} {1e3 * times[-1]:8.1f} {1e3 * self.cpu_s:8.2f}"


def fill(url: str) -> tuple[str, str]:
    """A grid with results; its id and that of a run that has one."""
    database = Database(url)
    plan = planned(RUNS)
    grid = GridStore(database).create({"benchmark": RUNS}, lambda: plan).grid.id
    finish(database, DONE)
    run = next(item.id for item in GridStore(database).runs(grid, RUNS).items if item.state == "done")
    database.close()
    return grid, run


def filled(tree: Path, url: str) -> tuple[str, str]:
    """The same by the code of a checkout, whose tables may be others."""
    command = [sys.executable, "-c", _FILL, url]
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    told = subprocess.run(
        command, env=environment, cwd=tempfile.gettempdir(), check=True, stdout=subprocess.PIPE, text=True
    )
    grid, run = told.stdout.split()
    return grid, run


def finish(database: Database, runs: int, every_s: float = 0.0) -> None:
    """Do what a dispatcher and its workers would, so many runs long."""
    generation = Leadership(database).take("benchmark", lambda _: True)
    assert generation is not None
    Leadership(database).beat(generation, {"engine": 2})
    queue = RunQueue(database)
    for _ in range(runs):
        for lease in queue.claim(generation, 1):
            queue.store(lease, result_of(lease))
        time.sleep(every_s)


@contextmanager
def started(*command: str, **environment: str) -> Iterator[psutil.Process]:
    process = subprocess.Popen([sys.executable, *command], env={**os.environ, **environment}, cwd=tempfile.gettempdir())
    try:
        yield psutil.Process(process.pid)
    finally:
        process.terminate()
        process.wait(timeout=30)


def processor_s(process: psutil.Process) -> float:
    """CPU so far of a process and its descendants."""
    times = [found.cpu_times() for found in (process, *process.children(recursive=True))]
    return sum(found.user + found.system for found in times)


def check(base: str, grid: str, run: str) -> dict[str, list[str]]:
    """The addresses that are measured, after each was seen to answer with what it should."""
    with httpx.Client(base_url=base, timeout=10.0) as client:
        eventually(lambda: _answers(client), what="an answer")
        found = client.get(f"/v1/grids/{grid}").json()
        assert (found["id"], found["n_runs"]) == (grid, RUNS)
        assert found["counts"]["done"] >= DONE
        detail = client.get(f"/v1/runs/{run}").json()
        assert (detail["id"], detail["state"], detail["result"]["degrees_of_freedom"] > 0) == (run, "done", True)
        assert len(client.get("/v1/systems").json()["items"]) > 1
        assert client.get("/healthz").json()["status"] == "ok"
        page = client.get(f"/v1/grids/{grid}/runs", params={"state": "done", "limit": CLIENTS}).json()["items"]
        assert len({one["id"] for one in page}) == CLIENTS
    return {
        "/healthz": ["/healthz"],
        "/v1/systems": ["/v1/systems"],
        "/v1/grids/{id}": [f"/v1/grids/{grid}"],
        "/v1/runs/{id}": [f"/v1/runs/{run}"],
        "a run for each": [f"/v1/runs/{one['id']}" for one in page],
    }


def _answers(client: httpx.Client) -> bool:
    try:
        return client.get("/healthz").status_code == 200
    except httpx.TransportError:
        return False


class Connection:
    """One keep-alive connection with at most one request under way."""

    def __init__(self, port: int, request: bytes) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port))
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.request = request
        self.sent = 0.0
        self.left = -1
        self.head = b""

    def ask(self) -> None:
        self.head, self.left, self.sent = b"", -1, time.perf_counter()
        self.socket.sendall(self.request)

    def read(self) -> bool:
        """Take what has come; whether the answer is whole."""
        data = self.socket.recv(1 << 18)
        assert data, "the server closed the connection"
        if self.left < 0:
            self.head += data
            head, found, body = self.head.partition(b"\r\n\r\n")
            if not found:
                return False
            assert head.startswith(b"HTTP/1.1 200"), head
            self.left = int(head.lower().partition(b"content-length: ")[2].partition(b"\r\n")[0])
            data = body
        self.left -= len(data)
        return self.left == 0


def load(port: int, addresses: Sequence[str], clients: int, seconds: float) -> Sample:
    """Ask for these addresses, in turn one for each of so many connections, for so long."""
    requests = [f"GET {address} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode() for address in addresses]
    sample = Sample()
    with selectors.DefaultSelector() as ready:
        for number in range(clients):
            connection = Connection(port, requests[number % len(requests)])
            ready.register(connection.socket, selectors.EVENT_READ, connection)
            connection.ask()
        began = time.perf_counter()
        until = began + seconds
        while (now := time.perf_counter()) < until:
            for key, _ in ready.select(1.0):
                if key.data.read():
                    sample.latencies.append(time.perf_counter() - key.data.sent)
                    key.data.ask()
        sample.wall_s = now - began
        for key in list(ready.get_map().values()):
            key.data.socket.close()
    return sample


@contextmanager
def streaming(port: int, grid: str, streams: int) -> Iterator[None]:
    """So many event streams open and read by a process of its own."""
    command = ("-m", "benchmarks.api_load", "--read-streams", str(port), grid, str(streams))
    with started(*command, PYTHONPATH=str(ROOT)):
        eventually(lambda: under_way(port) >= streams, what="all streams")
        yield
        assert under_way(port) >= streams, "a stream has ended"


def under_way(port: int) -> float:
    """Requests that the API has not answered to the end."""
    shown = httpx.get(f"http://127.0.0.1:{port}/metrics", timeout=60.0).text
    return next(float(line.split()[1]) for line in shown.splitlines() if line.startswith(f"{_UNDER_WAY} "))


def read_streams(port: int, grid: str, streams: int) -> None:
    """Hold streams open until the end of this process."""
    request = f"GET /v1/grids/{grid}/events HTTP/1.1\r\nHost: localhost\r\nAccept: text/event-stream\r\n\r\n".encode()
    with selectors.DefaultSelector() as ready:
        for _ in range(streams):
            connection = Connection(port, request)
            connection.ask()
            ready.register(connection.socket, selectors.EVENT_READ, connection)
        while True:
            for key, _ in ready.select(1.0):
                assert key.data.socket.recv(1 << 18), "the server closed a stream"


def probe(port: int, seconds: float) -> list[float]:
    """How long /healthz takes, asked every 50 ms over a connection of its own each time."""
    times = []
    until = time.perf_counter() + seconds
    while time.perf_counter() < until:
        began = time.perf_counter()
        connection = Connection(port, b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
        connection.ask()
        while not connection.read():
            pass
        times.append(time.perf_counter() - began)
        connection.socket.close()
        time.sleep(0.05)
    return sorted(times)


def measure(tree: Path, options: argparse.Namespace) -> None:
    with tempfile.TemporaryDirectory() as folder:
        url = f"sqlite:///{folder}/load.sqlite"
        grid, run = filled(tree, url)
        port = free_port()
        settings = {
            "HOSTLENS_DATABASE_URL": url,
            "HOSTLENS_DATA_DIR": folder,
            "HOSTLENS_PORT": str(port),
            "HOSTLENS_LOG_LEVEL": "WARNING",
            "PYTHONPATH": str(tree),
        }
        base = f"http://127.0.0.1:{port}"
        busy = ("-m", "benchmarks.api_load", "--finish", url)
        with started("-c", _SERVE, **settings) as api:
            addresses = check(base, grid, run)
            with started(*busy, PYTHONPATH=str(tree)):
                print(f"{tree}\n{'':18s} answers    1/s   p50 ms   p99 ms   max ms   CPU ms")
                for name, asked in addresses.items():
                    load(port, asked, options.clients, 1.0)
                    before = processor_s(api)
                    sample = load(port, asked, options.clients, options.seconds)
                    sample.cpu_s = (processor_s(api) - before) / len(sample.latencies)
                    print(f"{name:16s} {sample.row()}", flush=True)
                if options.streams:
                    with streaming(port, grid, options.streams):
                        before, began = processor_s(api), time.perf_counter()
                        times = probe(port, options.seconds)
                        share = (processor_s(api) - before) / (time.perf_counter() - began)
                    print(
                        f"/healthz beside {options.streams} streams: median {1e3 * times[len(times) // 2]:.1f} ms, "
                        f"max {1e3 * times[-1]:.1f} ms; CPU of the API {share:.2f} cores",
                        flush=True,
                    )


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--against", type=Path, help="another checkout, measured first")
    parser.add_argument("--clients", type=int, default=CLIENTS)
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--streams", type=int, default=0)
    parser.add_argument("--finish", help=argparse.SUPPRESS)
    parser.add_argument("--read-streams", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.finish:
        finish(Database(options.finish), RUNS - DONE, 1.0 / RATE)
    elif options.read_streams:
        port, grid, streams = options.read_streams
        read_streams(int(port), grid, int(streams))
    else:
        for tree in filter(None, (options.against, ROOT)):
            measure(tree, options)


if __name__ == "__main__":
    main()
