"""The workers: a local Dask cluster or one that was started elsewhere. Dask executes and keeps nothing."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import dask
from distributed import Client, LocalCluster

from service.settings import Settings
from service.store.leases import Lease
from service.worker import call_task

_LOG = logging.getLogger(__name__)
_ONE_THREAD = {f"{name}_NUM_THREADS": 1 for name in ("OMP", "OPENBLAS", "MKL", "NUMEXPR", "NUMBA")}
_CONFIG = {
    # The first death of a worker comes to us: how often a run may be tried again is the queue's decision.
    "distributed.scheduler.allowed-failures": 0,
    # One task per thread and not one more that waits on a worker, or its death would be blamed on both.
    "distributed.scheduler.worker-saturation": 1.0,
    "distributed.scheduler.work-stealing": False,
    # Dask pins all of these but NUMBA_NUM_THREADS by itself.
    "distributed.nanny.pre-spawn-environ": _ONE_THREAD,
    "distributed.worker.daemon": True,
    "distributed.comm.timeouts.connect": "10s",
    # Dask looks at itself fifty times a second in each process, for a dashboard that nobody sees; on two cores this
    # took 7 % of one from the engine.
    "distributed.admin.tick.interval": "500ms",
    "distributed.admin.system-monitor.interval": "5s",
    "distributed.worker.profile.enabled": False,
}
_STOP_S = 5.0
_COUNT_EVERY_S = 0.5


class Pool:
    """Workers behind a Dask client."""

    def __init__(self, client: Any, settings: Settings) -> None:
        self._client = client
        self._settings = settings
        self._threads = 0
        self._counted = -math.inf

    @property
    def running(self) -> bool:
        """Whether the scheduler is there."""
        return bool(self._client.status == "running")

    def threads(self) -> int:
        """Worker threads, as they were within the last moment."""
        if time.monotonic() - self._counted > _COUNT_EVERY_S:
            try:
                # Not scheduler_info(): the client's own timer overwrites its answer with one that lists no workers.
                self._threads = sum(self._client.nthreads().values())
            except OSError:
                self._threads = 0
            self._counted = time.monotonic()
        return self._threads

    def submit(self, lease: Lease, done: Callable[[Any], None]) -> Any:
        """Start a run; ``done`` is called with the future from another thread when it has ended."""
        future: Any = self._client.submit(
            call_task,
            self._settings.task,
            lease.spec,
            self._settings.artefacts,
            key=lease.key,
            pure=False,
            retries=0,
        )
        future.add_done_callback(done)
        return future

    def stop(self, future: Any) -> None:
        """Stop a run that is being worked on, by starting its worker anew: Dask cannot interrupt a task."""
        working = [address for address, keys in self._client.processing().items() if future.key in keys]
        future.cancel(force=True)
        if working:
            # TimeoutError: the nanny is still at it; the worker takes no other run before it has done so.
            with suppress(TimeoutError, OSError):
                self._client.restart_workers(working, timeout=_STOP_S, raise_for_error=False)


def is_lost(future: Any) -> bool:
    """Whether Dask no longer knows of a run that it was given."""
    return future.status in {"lost", "cancelled"}


@contextmanager
def open_pool(settings: Settings) -> Iterator[Pool]:
    """Workers for as long as the context lasts; OSError where a scheduler elsewhere does not answer."""
    with dask.config.set({**_CONFIG, "temporary-directory": settings.scratch}):
        if settings.scheduler_address is not None:
            with Client(settings.scheduler_address, timeout="15s", set_as_default=False) as client:
                yield Pool(client, settings)
            return
        cluster = LocalCluster(
            n_workers=settings.workers,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address=None,
            memory_limit=settings.worker_memory,
            silence_logs=logging.ERROR,
        )
        try:
            with Client(cluster, set_as_default=False) as client:
                yield Pool(client, settings)
        finally:
            cluster.close(timeout=_STOP_S)
