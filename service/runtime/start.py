"""The first thing in every process of the service, before anything that takes time to load.

It loads next to nothing itself, so that a signal at any moment of a start ends the process as promised: a service that
was told to stop has done what it was told (0), a command that was told to stop has not done its work (130, 143).
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn

CONFIGURATION = 2
"""Exit code of what is asked for and cannot be: another start would end in the same way."""
STOPS = (signal.SIGINT, signal.SIGTERM)
_AGAIN_S = 0.05
_LOADERS = ("<frozen importlib", "/llvmlite/", "/numba/")
"""Parts of the names of files whose code loads what a program is made of."""
_left_behind: list[Callable[[], None]] = []


class ConfigurationError(ValueError):
    """A setting, or what it names, is not acceptable: one line that names the variable and what is allowed.

    To start again would not help: processes end by it with exit code 2, and nobody starts them again.
    """


def begin(*, service: bool = True) -> None:
    """Make standard streams that are closed, a home that is missing, and the handlers of the signals that end it.

    They are in force until the process puts its own in their place. Whoever started it may have kept the signals
    back until now.
    """
    _open_streams()
    _name_a_home()
    finish(service=service)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPS)


def finish(*, service: bool) -> None:
    """From now on a signal ends the process at once: there is nothing to clean up yet, or any more."""
    for number in STOPS:
        signal.signal(number, _end_well if service else _end_early)


def interruptible() -> None:
    """From now on a signal unwinds what a command is at, so that it can clean up.

    Not while a module or a compiled kernel is being loaded: what is raised there is swallowed by pydantic's core, which
    builds schemas, and by llvmlite's callbacks. The signal then comes again a moment later.
    """

    def interrupted(number: int, frame: FrameType | None) -> None:
        if _loading(frame):
            again = threading.Timer(_AGAIN_S, os.kill, (os.getpid(), number))
            again.daemon = True
            again.start()
        elif number == signal.SIGINT:
            raise KeyboardInterrupt
        else:
            sys.exit(128 + number)

    for number in STOPS:
        signal.signal(number, interrupted)


def _loading(frame: FrameType | None) -> bool:
    """Whether a module or a compiled kernel is being loaded where a frame stands."""
    while frame is not None:
        if any(part in frame.f_code.co_filename for part in _LOADERS):
            return True
        frame = frame.f_back
    return False


def on_early_end(end: Callable[[], None]) -> None:
    """Call ``end`` if a signal comes before the process handles it itself: a process that it has started, say."""
    _left_behind.append(end)


@contextmanager
def kept_back() -> Iterator[None]:
    """Hold these signals back in the processes that are started meanwhile, until they ``begin``.

    Python itself takes a while before the first line of a program, and would die of them.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOPS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def refusing() -> Iterator[None]:
    """Say in one line what is wrong with the configuration, and end with the code for it."""
    try:
        yield
    except ConfigurationError as error:
        print(f"hostlens: {error}", file=sys.stderr)
        sys.exit(CONFIGURATION)


def _end_well(_number: int, _frame: FrameType | None) -> NoReturn:
    _end(0)


def _end_early(number: int, _frame: FrameType | None) -> NoReturn:
    _end(128 + number)


def _end(code: int) -> NoReturn:
    for end in _left_behind:
        end()
    # Not sys.exit: a library that is being loaded might catch it.
    os._exit(code)


def _open_streams() -> None:
    """Put the null device where a standard stream is closed, or the next file to be opened would take its number.

    What is then written to standard error, by whichever library, would be written into that file: the database, say.
    A character that the terminal's encoding lacks is written as a question mark.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free: this one
            setattr(sys, name, open(number, "w" if number else "r", encoding="utf-8", closefd=False))  # noqa: SIM115
        stream = getattr(sys, name)
        if number and hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")


def _name_a_home() -> None:
    """As :mod:`engine.home` does, for what is loaded without the engine."""
    home = os.path.expanduser("~")
    try:
        os.stat(f"{home}/.")
    except PermissionError:
        home = "~"
    except OSError:
        pass  # not there: nobody reads or writes anything in it
    if home == "~":
        os.environ["HOME"] = "/nonexistent"
