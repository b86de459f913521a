"""Nothing that another process sent is unpickled in the dispatcher, which holds the database's password.

Dask's client unpickles in many places: results, exceptions, the type of a result, warnings, whatever a scheduler or a
worker marks as pickled. None of that can be turned off, so it is refused where it would become more than data: Python
asks its audit hooks before a pickle may name a class or a function.
"""

from __future__ import annotations

import pickletools
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from distributed import KilledWorker

from service.worker.answers import NotPlainError

_ALLOWED = frozenset({("builtins", "bytes")})
"""How Dask says that a result is bytes."""
_READ_BYTES, _TEXTS = 100_000, 50
_depth = 0
_hooked = False


@contextmanager
def only_plain_data() -> Iterator[None]:
    """Refuse, in the whole process and while the context lasts, every pickle that is more than data.

    It raises :class:`~service.worker.answers.NotPlainError`, a TypeError: Dask takes it for a traceback that is broken.
    """
    global _depth, _hooked  # noqa: PLW0603 - a hook stays to the end of the process
    if not _hooked:
        sys.addaudithook(_look)
        _hooked = True
    _depth += 1
    try:
        yield
    finally:
        _depth -= 1


def _look(event: str, arguments: tuple[Any, ...]) -> None:
    if event == "pickle.find_class" and _depth and arguments not in _ALLOWED:
        raise NotPlainError(f"refused to unpickle {arguments[0]}.{arguments[1]}")


def read_error(error: BaseException) -> BaseException:
    """What Dask says of a task that failed; of an exception that was not unpickled, the text that is in it."""
    pickled = error.args[0] if type(error) is Exception and len(error.args) == 1 else None
    if not isinstance(pickled, bytes):
        return error
    texts = _texts(pickled[:_READ_BYTES])
    if texts[:2] == ["distributed.scheduler", "KilledWorker"]:
        killed: BaseException = KilledWorker(" ".join(texts[2:3]), None, 0)
        return killed
    return RuntimeError(" ".join(texts[:_TEXTS]) or "an exception without a text")


def _texts(pickled: bytes) -> list[str]:
    """Pieces of text in a pickle, which is read and not carried out."""
    texts = []
    try:
        for _, argument, _ in pickletools.genops(pickled):
            if isinstance(argument, str):
                texts.append(argument)
    except Exception:  # noqa: BLE001 - it may be anything, cut off for one
        return texts
    return texts
