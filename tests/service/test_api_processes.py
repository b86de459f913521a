"""Several API processes on one port: any answers for all, and one that dies is neither missed nor forgotten."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import httpx
import psutil

from tests.drills.installation import Installation
from tests.service.service_process import eventually, serving

# A connection each: which process accepts it is the kernel's choice.
ASKING = httpx.Client(timeout=120.0, trust_env=False, limits=httpx.Limits(max_keepalive_connections=0))
API = ["-m", "service.api"]


def apis(service: Installation) -> list[psutil.Process]:
    return [process for process in service.processes() if process.cmdline()[1:3] == API]


def counted(service: Installation) -> float:
    """Answered requests for /healthz, as whichever process is asked tells them."""
    shown = ASKING.get(f"http://127.0.0.1:{service.port}/metrics").text
    name = 'hostlens_http_requests_total{method="GET",route="/healthz",status="200"}'
    return sum(float(line.split()[-1]) for line in shown.splitlines() if line.startswith(name))


def ask(service: Installation, times: int) -> None:
    for _ in range(times):
        assert ASKING.get(f"http://127.0.0.1:{service.port}/healthz").status_code == 200


def test_each_process_tells_the_metrics_of_all_and_a_killed_one_is_started_again(tmp_path: Path) -> None:
    with serving(tmp_path, HOSTLENS_API_PROCESSES="2") as service:
        first = eventually(lambda: len(found := apis(service)) == 2 and found, what="two processes")
        before = counted(service)
        ask(service, 20)
        assert {counted(service) for _ in range(6)} == {before + 20}
        print(f"{[found.memory_info().rss >> 20 for found in first]} MB", file=sys.stderr)
        os.kill(first[0].pid, signal.SIGKILL)
        # Nobody is refused meanwhile.
        ask(service, 20)
        again = eventually(
            lambda: len(found := apis(service)) == 2 and first[0].pid not in {one.pid for one in found} and found,
            what="another process",
        )
        assert first[1].pid in {one.pid for one in again}
        ask(service, 20)
        assert counted(service) == before + 60
        assert service.end() == 0
        eventually(lambda: service.processes() == [], what="the end of all processes")
        assert not list((tmp_path / "data").glob("metrics-*"))
