"""A worker that means harm: what it answers would run code in whatever process unpickles it."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

from distributed import get_worker
from distributed.protocol.serialize import ToPickle

from service.worker import tasks
from tests.service.tasks import fast

_FOLDER = "HOSTLENS_DRILL_HARM"
GREETINGS = ("result", "exception")
"""Ways to answer a greeting; beside them there is silence, which takes long to be noticed."""
MODES = ("well", "payload", "raw", "exception", "huge", "deep", "not_json", "events", "nothing", "exit")


def harm() -> str:
    """Leave the number of the process that was made to run this."""
    (Path(os.environ[_FOLDER]) / str(os.getpid())).touch()
    return "harmed"


class Harmful:
    def __reduce__(self) -> Any:
        return harm, ()


class HarmfulError(BaseException):
    """Not an Exception, so that it leaves the worker as Dask sends it."""

    def __reduce__(self) -> Any:
        return harm, ()


_ANSWERS = {
    "raw": Harmful(),
    "huge": b" " * (3 * 2**20),
    "deep": b"[" * 200_000,
    "not_json": b"\x80\x04.",
    "nothing": b'{"memory":1}',
}
_well = tasks.answer_run
_greet_well = tasks.to_bytes


def _answer_run(task: str, spec: dict[str, Any], *arguments: Any) -> Any:
    mode = MODES[spec["seed"]]
    if mode == "exception":
        raise HarmfulError("text that is in it")
    return _ANSWERS[mode] if mode in _ANSWERS else _well(task, spec, *arguments)


if _FOLDER in os.environ:  # in a worker, not where the tests themselves import this
    tasks.answer_run = _answer_run


def answer(spec: dict[str, Any], artefact_url: str) -> dict[str, Any]:
    """A run that does as its seed says."""
    mode = MODES[spec["seed"]]
    if mode == "exit":
        raise SystemExit("text of an exit")
    payload = fast(spec, artefact_url)
    if mode == "payload":
        payload["warnings"] = [Harmful()]
    if mode == "events":
        # Dask's own log_event refuses it; a worker that means harm speaks to the scheduler by itself.
        for topic in (get_worker().address, "worker-restart-memory"):
            get_worker().batched_stream.send({"op": "log-event", "topic": topic, "msg": ToPickle(Harmful())})
    return payload


def warm_up() -> None:
    """Harm by greeting, once in each of the ways that the folder names."""
    for kind in (*GREETINGS, "silence"):
        try:
            (Path(os.environ[_FOLDER]) / f"greeting-{kind}").unlink()
        except FileNotFoundError:
            continue
        if kind == "exception":
            raise HarmfulError
        if kind == "silence":
            time.sleep(3600)
        tasks.to_bytes = lambda _: Harmful()  # type: ignore[assignment, return-value]
        return
