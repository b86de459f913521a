"""Tasks that take memory: for good, for a moment, or more than there is; and workers that take no work."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import psutil
from distributed import get_worker
from distributed.core import Status

from tests.service.tasks import fast

_kept: list[bytearray] = []


def _fill(fraction: float) -> bytearray:
    """Take memory until this process has so much of its worker's limit."""
    limit = get_worker().memory_manager.memory_limit
    missing = int(fraction * limit) - psutil.Process().memory_info().rss
    return bytearray(b"\x01") * max(missing, 0)


def leaking(spec: dict[str, Any], artefact_url: str) -> dict[str, Any]:
    """A run that leaves its worker nearly full, once; the others are innocent."""
    if spec["seed"] == 0 and spec["host"]["n"] == 2.0 and _first():
        _kept.append(_fill(0.87))
    return fast(spec, artefact_url)


def greedy(spec: dict[str, Any], artefact_url: str) -> dict[str, Any]:
    """Seed 1 takes more than there is, seed 2 stays just below what its worker is ended for, the others are modest."""
    if spec["seed"] == 1:
        while True:
            _kept.append(bytearray(b"\x01") * 2**24)
            time.sleep(0.05)
    if spec["seed"] == 2:
        held = _fill(0.87)
        time.sleep(600)
        del held
    return fast(spec, artefact_url)


def idle(spec: dict[str, Any], artefact_url: str) -> dict[str, Any]:
    """Before its first run is sent back, a worker stops taking work as its seed says."""
    if spec["seed"] == 0 and _first():
        worker = get_worker()
        worker.loop.add_callback(setattr, worker, "status", Status.closing_gracefully)
    return fast(spec, artefact_url)


def _first() -> bool:
    try:
        os.close(os.open(Path(os.environ["HOSTLENS_DRILL_LOG"] + ".once"), os.O_CREAT | os.O_EXCL))
    except FileExistsError:
        return False
    return True
