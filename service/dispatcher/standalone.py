"""``hostlens scheduler`` and ``hostlens worker``: Dask's own processes, started apart by the rules of this service."""

from __future__ import annotations

import os
import sys
from copy import deepcopy
from typing import Any, NoReturn

import dask.config

from service.dispatcher.clusters import dask_config
from service.dispatcher.nursery import ONE_THREAD
from service.settings import Settings

_DEATH_TIMEOUT_S = 60


def scheduler_arguments(settings: Settings, host: str, port: int, health: str) -> list[str]:
    """Arguments of ``dask scheduler``; ``health`` is where it answers HTTP, as ``:8787``."""
    listen = ["--host", host, "--port", str(port), "--dashboard-address", health, "--no-dashboard"]
    return ["scheduler", *listen, *_tls(settings)]


def worker_arguments(settings: Settings, address: str, workers: int, health: str) -> list[str]:
    """Arguments of ``dask worker``: processes of one thread under nannies, which end when nobody answers."""
    room = ["--nworkers", str(workers), "--nthreads", "1", "--memory-limit", settings.worker_memory]
    listen = ["--dashboard-address", health, "--no-dashboard", "--death-timeout", str(_DEATH_TIMEOUT_S)]
    listen += ["--preload-nanny", "service.logs"]
    return ["worker", address, *room, *listen, "--local-directory", settings.scratch, *_tls(settings)]


def become(settings: Settings, arguments: list[str]) -> NoReturn:
    """Replace this process by Dask's, so that signals and the exit code are its own."""
    environment = {
        **os.environ,
        **{name: str(number) for name, number in ONE_THREAD.items()},
        # As Dask hands its configuration on to processes that it starts.
        "DASK_INTERNAL_INHERIT_CONFIG": dask.config.serialize(_config(settings)),
    }
    os.execve(sys.executable, [sys.executable, "-m", "dask", *arguments], environment)  # noqa: S606 - without a shell


def _config(settings: Settings) -> dict[str, Any]:
    flat = {**dask_config(settings), "distributed.scheduler.preload": ["service.logs"]}
    nested: dict[str, Any] = {}
    with dask.config.set(flat, config=nested):
        return deepcopy(nested)  # leaving the context empties it


def _tls(settings: Settings) -> list[str]:
    if settings.tls_ca is None:
        return []
    files = (("--tls-ca-file", settings.tls_ca), ("--tls-cert", settings.tls_cert), ("--tls-key", settings.tls_key))
    return [part for option, file in files for part in (option, str(file))]
