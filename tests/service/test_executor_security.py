"""What a worker that means harm can do to the dispatcher: nothing."""

from __future__ import annotations

from pathlib import Path

import psutil
import pytest

from tests.service.hostile import MODES
from tests.service.plans import body
from tests.service.service_process import Serving, eventually, serving


def harmed(folder: Path, service: Serving) -> list[list[str]]:
    """Command lines of the processes that ran a worker's code and are no workers."""
    workers = {process.pid for process in service.workers()}
    touched = {int(file.name) for file in folder.iterdir() if file.name.isdigit()} - workers
    return [psutil.Process(pid).cmdline() for pid in touched if psutil.pid_exists(pid)]


def test_nothing_that_a_worker_answers_becomes_code_in_the_dispatcher(tmp_path: Path) -> None:
    harm = tmp_path / "harm"
    harm.mkdir()
    settings = {
        "HOSTLENS_TASK": "tests.service.hostile:answer",
        "HOSTLENS_RETRY_DELAY_S": "0.1",
        "HOSTLENS_DRILL_HARM": str(harm),
        "HOSTLENS_DRILL_SLEEP": "0.1",
    }
    with serving(tmp_path, **settings) as service:
        grid = service.client.submit(body(len(MODES)))
        ended = service.client.wait(grid.id, timeout_s=300)
        runs = {
            mode: service.client.run(found.id) for mode, found in zip(MODES, service.client.runs(grid.id), strict=True)
        }
        told = {mode: (found.state, found.error and found.error.code) for mode, found in runs.items()}
        assert told.pop("well") == told.pop("events") == ("done", None)
        assert told.pop("exception") == ("failed", "task_error")
        assert told.pop("exit") == ("failed", "error")
        assert set(told.values()) == {("failed", "invalid_result")}, told
        assert "HarmfulError" in str(runs["exception"].error)
        assert "text of an exit" in str(runs["exit"].error)
        assert ended.counts.done == 2
        dispatcher = service.child("service.dispatcher")
        assert dispatcher is not None
        assert not (harm / str(dispatcher.pid)).exists(), harmed(harm, service)
        # It goes on, with the same dispatcher.
        again = service.client.submit(body(2, seed=0))
        eventually(lambda: service.client.status(again.id).finished_at is not None, what="the end of another grid")
        assert service.child("service.dispatcher") == dispatcher


@pytest.mark.parametrize("kind", ["result", "exception"])
def test_a_greeting_that_is_not_plain_data_is_refused_and_the_worker_replaced(tmp_path: Path, kind: str) -> None:
    harm = tmp_path / "harm"
    harm.mkdir()
    (harm / "greeting").write_text(kind)
    settings = {
        "HOSTLENS_TASK": "tests.service.hostile:answer",
        "HOSTLENS_DRILL_HARM": str(harm),
        "HOSTLENS_WORKERS": "1",
    }
    with serving(tmp_path, **settings) as service:
        assert "cannot be used" in service.tail()
        dispatcher = service.child("service.dispatcher")
        assert dispatcher is not None
        assert not (harm / str(dispatcher.pid)).exists(), harmed(harm, service)
