"""Names of dispatcher processes, made so that another process of the machine can tell whether one is dead."""

from __future__ import annotations

import os
import platform
from pathlib import Path

import psutil


def own_name() -> str:
    """Name of the process that asks, for the leader row."""
    return f"{_place()}|{os.getpid()}|{psutil.Process().create_time():.2f}"


def is_dead(name: str) -> bool:
    """Whether the process called ``name`` is certainly gone.

    False for processes of another machine, or of another container of this one: nothing is known of them but their
    heartbeat.
    """
    place, _, process = name.partition("|")
    pid, _, created = process.partition("|")
    if place != _place() or not pid.isdigit():
        return False
    try:
        found = psutil.Process(int(pid))
        return f"{found.create_time():.2f}" != created or found.status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


def _place() -> str:
    """A machine since its last start, and the namespace that process numbers count in."""
    namespace = Path("/proc/self/ns/pid")
    inside = namespace.readlink() if namespace.is_symlink() else ""
    return f"{platform.node()[:80]}/{psutil.boot_time():.0f}/{inside}"
