"""What a worker that means harm can do to the dispatcher: nothing."""

from __future__ import annotations

from pathlib import Path

import psutil

from tests.service.hostile import GREETINGS, MODES
from tests.service.plans import body
from tests.service.service_process import Serving, eventually, serving


def harmed(folder: Path, service: Serving) -> list[list[str]]:
    """Command lines of the processes that ran a worker's code and are no workers."""
    workers = {process.pid for process in service.workers()}
    touched = {int(file.name) for file in folder.iterdir() if file.name.isdigit()} - workers
    return [psutil.Process(pid).cmdline() for pid in touched if psutil.pid_exists(pid)]


def test_nothing_that_a_worker_answers_becomes_code_in_the_dispatcher(tmp_path: Path) -> None:
    """Neither to a greeting, by which a worker is refused and replaced, nor to a run."""
    harm = tmp_path / "harm"
    harm.mkdir()
    for kind in GREETINGS:
        (harm / f"greeting-{kind}").touch()
    settings = {
        "HOSTLENS_TASK": "tests.service.hostile:answer",
        "HOSTLENS_RETRY_DELAY_S": "0.1",
        "HOSTLENS_DRILL_HARM": str(harm),
        "HOSTLENS_DRILL_SLEEP": "0.1",
        "HOSTLENS_WORKERS": "1",
    }
    with serving(tmp_path, **settings) as service:
        # It is ready, so both greetings have been given and a third worker's was plain data.
        assert list(harm.glob("greeting-*")) == []
        assert service.log.read_text().count("cannot be used") == len(GREETINGS)
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
