"""What the compose file describes, run for real: its own commands and settings, a real PostgreSQL, real kills."""

from __future__ import annotations

import os
from pathlib import Path

import httpx
import pytest

from service.client import ApiError, Client
from service.store.migrate import differences
from tests.deploy.compose import Topology
from tests.drills.stored import read_records
from tests.service.conftest import new_database
from tests.service.plans import body
from tests.service.service_process import eventually

RUNS = 24


@pytest.mark.postgres
def test_a_grid_completes_in_the_compose_file_s_topology_through_kills_of_a_worker_and_of_the_dispatcher(
    tmp_path: Path, postgres_server: str
) -> None:
    url = new_database(postgres_server, f"topology_{os.getpid()}")
    brief = {"HOSTLENS_TASK": "tests.service.tasks:fast", "HOSTLENS_DRILL_SLEEP": "0.4", "HOSTLENS_RECONCILE_S": "1"}
    topology = Topology(tmp_path, url, **brief, HOSTLENS_RETRY_DELAY_S="0.1")
    with topology.running(), Client(f"http://127.0.0.1:{topology.port('8421')}") as client:

        def workers() -> int:
            try:
                return client.readiness().workers
            except (httpx.TransportError, ApiError):
                return 0  # the API is still starting

        eventually(lambda: workers() == 2, what="two workers")
        for instance, name in topology.instances().items():
            if "healthcheck" in topology.services[name]:
                assert topology.healthy(name, instance), instance
        assert differences(url) is None
        grid = client.submit(body(RUNS))

        def done() -> int:
            return client.status(grid.id).counts.done

        eventually(lambda: done() >= 4, what="the first results")
        topology.kill("worker-0")
        eventually(lambda: done() >= 10, what="results after the kill of a worker")
        topology.kill("dispatcher-0")
        ended = client.wait(grid.id, timeout_s=300)
        assert ended.counts.done == RUNS
        assert topology.restarts == 2
        eventually(lambda: workers() == 2, what="the killed worker's successor")
        assert client.readiness().status == "ready"
    found = read_records(url, grid.id)
    assert (found.states, found.stored) == ({"done": RUNS}, RUNS)
