"""``hostlens scheduler`` and ``hostlens worker``: Dask's own processes, started apart by the rules of this service."""

from __future__ import annotations

import os
import re
import signal
import sys
from copy import deepcopy
from typing import Any, NoReturn

import dask.config

from service.dispatcher.clusters import dask_config
from service.runtime import preflight, start
from service.runtime.settings import Settings, bracketed
from service.runtime.start import ConfigurationError
from service.worker.fork_server import ONE_THREAD

_DEATH_TIMEOUT_S = 60


def scheduler_arguments(settings: Settings, host: str, port: int, health: str) -> list[str]:
    """Arguments of ``dask scheduler``; ``health`` is where it answers HTTP, as ``:8787``.

    Raises
    ------
    service.runtime.settings.ConfigurationError
        It could not listen where it is told to, or its certificates cannot be used.
    """
    host = host.removeprefix("[").removesuffix("]")
    preflight.require_free(host, port, "--host and --port")
    _require_health(health)
    preflight.require_certificates(settings)
    listen = ["--host", bracketed(host), "--port", str(port), "--dashboard-address", health, "--no-dashboard"]
    return ["scheduler", *listen, *_tls(settings)]


def worker_arguments(settings: Settings, address: str, workers: int, health: str) -> list[str]:
    """Arguments of ``dask worker``: processes of one thread under nannies; raises as :func:`scheduler_arguments`."""
    _require_health(health)
    preflight.require_certificates(settings)
    room = ["--nworkers", str(workers), "--nthreads", "1", "--memory-limit", settings.worker_memory]
    listen = ["--dashboard-address", health, "--no-dashboard", "--death-timeout", str(_DEATH_TIMEOUT_S)]
    listen += ["--preload-nanny", "service.runtime.logs"]
    return ["worker", address, *room, *listen, "--local-directory", settings.scratch, *_tls(settings)]


def become(settings: Settings, arguments: list[str]) -> NoReturn:
    """Replace this process by Dask's, so that signals and the exit code are its own."""
    preflight.require_data(settings)
    environment = {
        **os.environ,
        **{name: str(number) for name, number in ONE_THREAD.items()},
        # As Dask hands its configuration on to processes that it starts.
        "DASK_INTERNAL_INHERIT_CONFIG": dask.config.serialize(_config(settings)),
    }
    # Kept back until the program that comes can handle them.
    signal.pthread_sigmask(signal.SIG_BLOCK, start.STOPS)
    command = [sys.executable, "-m", "service.dispatcher.dask_command", *arguments]
    os.execve(sys.executable, command, environment)  # noqa: S606 - without a shell


def _require_health(address: str) -> None:
    matched = re.fullmatch(r"([A-Za-z0-9._-]*):(\d{1,5})", address)
    if matched is None or int(matched[2]) > 65535:
        allowed = "host:port, as 127.0.0.1:8787, or :8787 for all; Dask takes no IPv6 address here"
        raise ConfigurationError(f"--health: got {address!r}; allowed is {allowed}")
    if int(matched[2]):
        preflight.require_free(matched[1] or "0.0.0.0", int(matched[2]), "--health")  # noqa: S104 - as asked for


def _config(settings: Settings) -> dict[str, Any]:
    flat = {**dask_config(settings), "distributed.scheduler.preload": ["service.runtime.logs"]}
    nested: dict[str, Any] = {}
    with dask.config.set(flat, config=nested):
        return deepcopy(nested)  # leaving the context empties it


def _tls(settings: Settings) -> list[str]:
    if settings.tls_ca is None:
        return []
    files = (("--tls-ca-file", settings.tls_ca), ("--tls-cert", settings.tls_cert), ("--tls-key", settings.tls_key))
    return [part for option, file in files for part in (option, str(file))]
