"""A real ``hostlens serve`` with a fast task, for tests that kill things: the installation of the drills."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.drills.installation import Installation, eventually, free_port

__all__ = ["ROOT", "Serving", "eventually", "free_port", "serving"]

ROOT = Path(__file__).resolve().parents[2]
Serving = Installation


@contextmanager
def serving(folder: Path, **settings: str) -> Iterator[Installation]:
    """A service that is gone afterwards, whatever happened; one API process, for each takes seconds to start."""
    service = Installation(folder, {"HOSTLENS_API_PROCESSES": "1", **settings})
    try:
        service.wait_ready()
        yield service
    except BaseException:
        print(service.tail())
        raise
    finally:
        service.kill_all()
