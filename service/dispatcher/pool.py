"""The workers behind a Dask client: which are there, which may be used, and one run started on one of them.

Runs are placed here and not by Dask's scheduler: so it is known which worker each of them is on, none waits behind
another, a suspect can be alone, and a worker gets its first run only after it has been greeted.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any
from uuid import uuid4

from service import logs
from service.dispatcher.clusters import open_client
from service.settings import Settings
from service.store.leases import Lease
from service.worker import Greeting, call_tasks, greet

_LOG = logging.getLogger(__name__)
_STOP_S = 5.0
_LOOK_EVERY_S, _LOOK_SOON_S = 0.5, 0.1
_GREET_AGAIN_S = 30.0
_STOPPING_S = 20.0
"""How long a worker that was stopped is not used: it is gone by then, or its address belongs to the next one."""


@dataclass(frozen=True)
class Worker:
    """A worker that runs may be given to; ``since`` is when that began, on the monotonic clock."""

    address: str
    threads: int
    engine: str
    since: float


class Pool:
    """Workers behind a Dask client."""

    def __init__(self, client: Any, settings: Settings) -> None:
        self._client = client
        self._settings = settings
        self._present: dict[str, int] | None = {}
        self._looked = float("-inf")
        self._greetings: dict[str, Any] = {}
        self._refused: dict[str, float] = {}
        self._workers: dict[str, Worker] = {}
        self._stopping: dict[str, float] = {}
        self._stopper = ThreadPoolExecutor(1, thread_name_prefix="stopper")

    @property
    def running(self) -> bool:
        """Whether the scheduler is there."""
        return bool(self._client.status == "running")

    def present(self) -> Collection[str] | None:
        """Addresses of all workers that the scheduler knows, as of the last moment; None where it does not answer."""
        self._look()
        return self._present

    def workers(self) -> list[Worker]:
        """Workers that runs may be given to."""
        self._look()
        if self._present is None:
            return []
        return [worker for address, worker in self._workers.items() if address not in self._stopping]

    def submit(self, leases: Sequence[Lease], worker: Worker) -> Any:
        """Start runs, one after the other as one task; the future of their answers, in the same order."""
        specs = [lease.spec for lease in leases]
        fields = [logs.fields_of(lease) for lease in leases]
        return self._on(worker.address, leases[0].key, call_tasks, specs, self._settings.artefacts, fields)

    def stop(self, addresses: Iterable[str], futures: Iterable[Any] = ()) -> None:
        """Start workers anew, with whatever they are at: Dask cannot interrupt a task. Does not wait for it."""
        wanted, ended = [address for address in addresses if address not in self._stopping], list(futures)
        self._stopping.update(dict.fromkeys(wanted, time.monotonic()))
        if wanted or ended:
            self._stopper.submit(self._stop, wanted, ended)

    def was_stopped(self, address: str) -> bool:
        """Whether a worker that is gone was being started anew by us."""
        return address in self._stopping

    def forget(self, address: str) -> None:
        """Give no more runs to a worker that died, before the next look finds it gone."""
        self._workers.pop(address, None)

    def closed_on_purpose(self, address: str) -> bool:
        """Whether a worker that is gone was told to go (a signal, the end of its lifetime) and did not die."""
        try:
            events = self._client.get_events(address)
        except (OSError, TimeoutError):
            return False
        # The next worker may have the same address, where ports are fixed: what counts is the last life that has ended.
        lives: list[list[str]] = [[]]
        for _, said in events:
            action = str(said.get("action")) if isinstance(said, dict) else ""
            if action == "add-worker":
                lives.append([])
            lives[-1].append(action)
        ended = [life for life in lives if "remove-worker" in life] or lives
        return "closing-worker" in ended[-1]

    def close(self) -> None:
        """Stop nothing more."""
        self._stopper.shutdown(wait=False, cancel_futures=True)

    def _on(self, address: str, key: str, function: Callable[..., Any], *arguments: Any) -> Any:
        return self._client.submit(
            function,
            self._settings.task,
            *arguments,
            key=key,
            workers=[address],
            allow_other_workers=False,
            pure=False,
            retries=0,
        )

    def _look(self) -> None:
        now = time.monotonic()
        if now - self._looked < (_LOOK_SOON_S if self._greetings else _LOOK_EVERY_S):
            return
        self._looked = now
        try:
            # Not scheduler_info(): the client's own timer overwrites its answer with one that lists no workers.
            present: dict[str, int] = self._client.nthreads()
        except (OSError, TimeoutError):
            self._present = None
            return
        self._present = present
        self._stopping = {at: since for at, since in self._stopping.items() if now - since < _STOPPING_S}
        for known in (self._workers, self._greetings, self._refused):
            for address in known.keys() - present.keys():
                del known[address]
        for address, threads in present.items():
            if address not in self._workers:
                self._greet(address, threads, now)

    def _greet(self, address: str, threads: int, now: float) -> None:
        """Ask a new worker what it carries; until it has answered it gets no run."""
        if address in self._refused and now - self._refused[address] < _GREET_AGAIN_S:
            return
        if address not in self._greetings:
            self._greetings[address] = self._on(address, f"greet-{uuid4().hex}", greet)
        future = self._greetings[address]
        if not future.done():
            return
        del self._greetings[address]
        try:
            said: Greeting = future.result(timeout=_STOP_S)
        except Exception as error:  # noqa: BLE001 - it comes from another process and may be anything
            _LOG.error("worker %s cannot be used: %r", address, error)
            self._refused[address] = now
            return
        self._workers[address] = Worker(address, threads, said.engine, now)
        _LOG.info("worker %s: engine %.12s, %s, warm after %.1f s", address, said.engine, said.threads, said.warm_s)

    def _stop(self, addresses: list[str], futures: list[Any]) -> None:
        with suppress(TimeoutError, OSError):
            if futures:
                self._client.cancel(futures, force=True)
            if not addresses:
                return
            try:
                # TimeoutError: the nanny is still at it; the worker takes no other run before it has done so.
                self._client.restart_workers(addresses, timeout=_STOP_S, raise_for_error=False)
            except ValueError:
                # Without a nanny: whatever started these workers starts them again.
                self._client.run(_die, workers=addresses, wait=False)


def _die() -> None:
    os._exit(1)


def is_lost(future: Any) -> bool:
    """Whether Dask no longer knows of a run that it was given."""
    return future.status in {"lost", "cancelled"}


@contextmanager
def open_pool(settings: Settings) -> Iterator[Pool]:
    """Workers for as long as the context lasts; OSError where a scheduler elsewhere does not answer."""
    with open_client(settings) as client:
        pool = Pool(client, settings)
        try:
            yield pool
        finally:
            pool.close()
