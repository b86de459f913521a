"""A signal at any moment of a start: the process ends as promised, and nobody is left."""

from __future__ import annotations

import contextlib
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from tests.drills.installation import PATIENCE_S, free_port
from tests.service.service_process import ROOT, eventually

_MARK = "HOSTLENS_DRILL_MARK"


SLOW = re.compile("pydantic_core|numpy")


def handles(pid: int, number: int) -> bool:
    """Whether a process has a handler of its own for a signal: before that it dies of it, whatever it is."""
    status = Path(f"/proc/{pid}/status").read_text(encoding="utf-8")
    caught = int(re.findall(r"^SigCgt:\s*(\w+)$", status, re.MULTILINE)[0], 16)
    return bool(caught >> (number - 1) & 1)


def left(mark: str) -> list[psutil.Process]:
    found = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):
            if process.status() != psutil.STATUS_ZOMBIE and process.environ().get(_MARK) == mark:
                found.append(process)
    return found


def environment(folder: Path, mark: str) -> dict[str, str]:
    return {
        **os.environ,
        _MARK: mark,
        "PYTHONPATH": str(ROOT),
        "HOSTLENS_DATA_DIR": str(folder / "data"),
        "HOSTLENS_PORT": str(free_port()),
        "HOSTLENS_TASK": "tests.drills.tasks:brief",
    }


def start(folder: Path, mark: str, *command: str) -> subprocess.Popen[bytes]:
    with (folder / "log").open("ab") as log:
        return subprocess.Popen(
            [sys.executable, "-m", *command], cwd=folder, env=environment(folder, mark), stdout=log, stderr=log
        )


def can_handle(process: subprocess.Popen[bytes]) -> bool:
    """Whether it has handlers of its own; before it runs its program it has those of the tests' process, if any."""
    arguments = b"".join(os.fsencode(argument) + b"\0" for argument in process.args)  # type: ignore[union-attr]
    own = Path(f"/proc/{process.pid}/cmdline").read_bytes() == arguments
    return own and handles(process.pid, signal.SIGTERM)


def code_after(process: subprocess.Popen[bytes], number: int, delay_s: float) -> int:
    """The exit code of a process that gets a signal so long after it could first handle it."""
    eventually(lambda: process.poll() is not None or can_handle(process), PATIENCE_S, "a handler")
    time.sleep(delay_s)
    process.send_signal(number)
    return process.wait(PATIENCE_S)


SERVICES = {
    "serve": ("service", "serve"),
    "api": ("service.api",),
    "api alone": ("service", "api"),
    "dispatcher": ("service.dispatcher",),
    "dispatcher alone": ("service", "dispatcher"),
    "scheduler": ("service", "scheduler", "--host", "127.0.0.1", "--port", "{port}", "--health", "127.0.0.1:0"),
    "worker": ("service", "worker", "tcp://127.0.0.1:1"),
}


@pytest.mark.parametrize("starts", [3, pytest.param(40, marks=[pytest.mark.long, pytest.mark.timeout(3600)])])
@pytest.mark.parametrize("name", SERVICES)
def test_a_service_that_is_stopped_at_any_moment_of_its_start_ends_with_0_and_leaves_nobody(
    name: str, starts: int, tmp_path: Path, migrated_sqlite: Path
) -> None:
    (tmp_path / "data").mkdir()
    shutil.copy(migrated_sqlite, tmp_path / "data" / "hostlens.sqlite")
    chance = random.Random(name)
    # From the first moment to well after the start, more of them early.
    delays = [0.0, *(4.0 * chance.random() ** 2 for _ in range(starts - 1))]
    for place, delay_s in enumerate(delays):
        mark = f"{name}-{os.getpid()}-{place}-{time.time_ns()}"
        command = [part.format(port=free_port()) for part in SERVICES[name]]
        number = (signal.SIGTERM, signal.SIGINT)[place % 2]
        process = start(tmp_path, mark, *command)
        try:
            code = code_after(process, number, delay_s)
            said = (tmp_path / "log").read_text(errors="replace")
            assert code == 0, (delay_s, number, said[-3000:])
            eventually(lambda mark=mark: left(mark) == [], what=f"the end of all, {delay_s:.2f} s after the start")
            assert "Traceback" not in said, (delay_s, number, said[-3000:])
        finally:
            for each in left(mark):
                each.kill()


@pytest.mark.parametrize("command", [("demo",), ("simulate", "HE0435")])
def test_a_command_that_is_stopped_says_that_its_work_is_not_done_and_leaves_nobody(
    command: tuple[str, ...], tmp_path: Path
) -> None:
    chance = random.Random(command[0])
    for place in range(3):
        delay_s, number = 3.0 * chance.random() * bool(place), (signal.SIGTERM, signal.SIGINT)[place % 2]
        mark = f"{command[0]}-{os.getpid()}-{place}-{time.time_ns()}"
        process = start(tmp_path, mark, "service", *command)
        try:
            code = code_after(process, number, delay_s)
            said = (tmp_path / "log").read_text(errors="replace")
            # Zero where it was done before the signal came.
            assert code in {0, 128 + number}, (delay_s, number, code, said[-3000:])
            eventually(lambda mark=mark: left(mark) == [], what="the end of all")
            assert "Traceback" not in said, (delay_s, number, said[-3000:])
        finally:
            for each in left(mark):
                each.kill()


def test_an_interrupt_while_a_dataclass_is_made_ends_a_command_like_any_other() -> None:
    program = """
import sys
import service.__main__, service.cli.app
def made():
    exec("raise KeyboardInterrupt")
service.cli.app.app = made
sys.argv = ["hostlens", "demo"]
service.__main__.main()
"""
    ended = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, check=False)
    assert (ended.returncode, ended.stderr) == (128 + signal.SIGINT, b"")


def test_the_handlers_are_there_before_anything_that_takes_time_to_load(tmp_path: Path) -> None:
    """All that a signal can still hit is Python's own start."""
    for command in SERVICES.values():
        mark = f"early-{os.getpid()}-{time.time_ns()}"
        process = start(tmp_path, mark, *[part.format(port=free_port()) for part in command])
        try:
            while not can_handle(process):
                assert process.poll() is None
                loaded = Path(f"/proc/{process.pid}/maps").read_text(encoding="utf-8")
                # Since the last look at the handlers they may have come, and all else after them.
                assert not SLOW.search(loaded) or can_handle(process), command
        finally:
            process.terminate()
            assert process.wait(PATIENCE_S) == 0
