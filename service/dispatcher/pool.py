"""The workers behind a Dask client: which are there, which may be used, and one run started on one of them.

Runs are placed here and not by Dask's scheduler: so it is known which worker each of them is on, none waits behind
another, a suspect can be alone, and a worker gets its first run only after it has been greeted.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any
from uuid import uuid4

from distributed.client import ClosedClientError

from service.dispatcher.clusters import open_client
from service.dispatcher.pickle_guard import read_error
from service.dispatcher.stalls import LOOK_S, Asked, Condition, Stall, Stalls, WorkerMemory, read_conditions
from service.domain.plan import IMAGE
from service.runtime import logs
from service.runtime.settings import Settings
from service.store.leases import Lease
from service.worker.answers import NotPlainError, read_greeting
from service.worker.tasks import answer_run, greet

_LOG = logging.getLogger(__name__)
MEASURE = "service.worker.measuring:measure"
"""What a worker runs for an uploaded image, whatever it runs for a realization."""
_STOP_S = 5.0
_LOOK_EVERY_S, _LOOK_SOON_S = 0.5, 0.1
_ASK_S = 10.0
"""How long the scheduler may take to answer; where it says nothing for longer than ``_GONE_S`` there is none."""
_GONE_S = 60.0
_GREET_AGAIN_S, _MAX_GREET_AGAIN_S = 10.0, 300.0
_STOPPING_S = 20.0
"""How long a worker that was stopped is not used: it is gone by then, or its address belongs to the next one."""


@dataclass(frozen=True)
class Worker:
    """A worker that runs may be given to; ``since`` is when that began, on the monotonic clock."""

    address: str
    threads: int
    engine: str
    since: float
    memory: WorkerMemory = field(default_factory=WorkerMemory, compare=False)


class Pool:
    """Workers behind a Dask client."""

    def __init__(self, client: Any, settings: Settings) -> None:
        self._client = client
        self._settings = settings
        self._present: dict[str, int] | None = {}
        self._looked = float("-inf")
        self._answered = time.monotonic()
        self._greetings: dict[str, Asked] = {}
        self._refused: set[str] = set()
        self._conditions: dict[str, Condition] = {}
        self._stalls = Stalls(settings.worker_ttl_s, settings.worker_patience_s)
        self._conditions_due = float("-inf")
        self._unfit: list[tuple[float, Stall]] = []
        self._failures = 0
        """Greetings that have failed since one was answered."""
        self._workers: dict[str, Worker] = {}
        self._stopping: dict[str, float] = {}
        self._stopper = ThreadPoolExecutor(1, thread_name_prefix="stopper")

    @property
    def running(self) -> bool:
        """Whether the scheduler is there and answers."""
        if self._present is None and time.monotonic() - self._answered > _GONE_S:
            return False
        # The task that listens to the scheduler: it ends where that said what Dask's client cannot read.
        listens = self._client._handle_report_task
        return bool(self._client.status == "running" and listens is not None and not listens.done())

    def present(self) -> Collection[str] | None:
        """Addresses of all workers that the scheduler knows, as of the last moment; None where it does not answer."""
        self._look()
        return self._present

    def workers(self) -> list[Worker]:
        """Workers that runs may be given to."""
        self._look()
        if self._present is None:
            return []
        return [
            worker
            for address, worker in self._workers.items()
            if address not in self._stopping and self._is_fit(address)
        ]

    def _is_fit(self, address: str) -> bool:
        condition = self._conditions.get(address)
        return condition is None or condition.takes_work

    def stalled(self, busy: Mapping[str, float]) -> list[Stall]:
        """Workers that take no work and are to be replaced, each once; they get no more runs.

        ``busy`` says since when, on the monotonic clock, each worker that was given runs has had the oldest of them.
        """
        now = time.monotonic()
        if now < self._conditions_due:
            return []
        self._conditions_due = now + LOOK_S
        try:
            self._conditions = read_conditions(self._ask(self._client.scheduler.identity, n_workers=-1))
        except (OSError, TimeoutError, NotPlainError):
            return []
        self._conditions_due = now + LOOK_S * (1.0 + len(self._conditions) / 100.0)
        known = {address: found for address, found in self._conditions.items() if address not in self._stopping}
        refused = [stall for due, stall in self._unfit if due <= now]
        self._unfit = [(due, stall) for due, stall in self._unfit if due > now]
        return [*refused, *self._stalls.look(known, busy, now)]

    def memory_kill(self, memory: WorkerMemory) -> int | None:
        """Memory for which a nanny has ended this worker [bytes], None where it has not."""
        try:
            events = self._ask(self._client.scheduler.events, topic="worker-restart-memory")
            return next((int(said["rss"]) for _, said in reversed(events) if said["pid"] == memory.pid), None)
        except (OSError, NotPlainError, TypeError, ValueError, KeyError):
            return None

    def submit(self, lease: Lease, worker: Worker) -> Any:
        """Start a run; the future of its answer."""
        fields = logs.fields_of(lease)
        task = MEASURE if lease.kind == IMAGE else self._settings.task
        return self._on(worker.address, lease.key, answer_run, task, lease.spec, self._settings.artefacts, fields)

    def stop(self, addresses: Iterable[str], futures: Iterable[Any] = ()) -> None:
        """Start workers anew, with whatever they are at: Dask cannot interrupt a task. Does not wait for it."""
        wanted, ended = [address for address in addresses if address not in self._stopping], list(futures)
        self._stopping.update(dict.fromkeys(wanted, time.monotonic()))
        for address in wanted:
            # The next one may come to the same address, and has to be greeted.
            self._workers.pop(address, None)
            self._greetings.pop(address, None)
            self._refused.discard(address)
        if wanted or ended:
            self._stopper.submit(self._stop, wanted, ended)

    def was_stopped(self, address: str) -> bool:
        """Whether a worker that is gone was being started anew by us."""
        return address in self._stopping

    def forget(self, address: str) -> None:
        """Give no more runs to a worker that died, before the next look finds it gone."""
        self._workers.pop(address, None)

    def closed_on_purpose(self, address: str) -> bool:
        """Whether a worker that is gone was told to go (by a signal, say) and did not die."""
        try:
            events = self._client.get_events(address)
        except (OSError, TimeoutError, NotPlainError, RuntimeError):
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

    def _ask(self, question: Callable[..., Any], **options: Any) -> Any:
        """An answer of the scheduler; OSError or TimeoutError where none comes."""
        try:
            return self._client.sync(question, callback_timeout=_ASK_S, **options)
        except RuntimeError as error:
            # Dask's client has closed itself in this moment, because the scheduler is gone.
            raise OSError(f"the scheduler cannot be asked: {error}") from error

    def _on(self, address: str, key: str, function: Callable[..., Any], *arguments: Any) -> Any:
        """The future of a call on a worker; OSError where the scheduler has gone."""
        try:
            return self._client.submit(
                function,
                *arguments,
                key=key,
                workers=[address],
                allow_other_workers=False,
                pure=False,
                retries=0,
            )
        except ClosedClientError as error:
            raise OSError(f"the scheduler cannot be given anything: {error}") from error

    def _look(self) -> None:
        now = time.monotonic()
        if now - self._looked < (_LOOK_SOON_S if self._greetings else _LOOK_EVERY_S):
            return
        self._looked = now
        try:
            # Not scheduler_info(): the client's own timer overwrites its answer with one that lists no workers.
            present: dict[str, int] = self._ask(self._client.scheduler.ncores, workers=None)
        except (OSError, TimeoutError, NotPlainError):
            self._present = None
            return
        passed, self._answered = min(now - self._answered, 1.0), now
        self._present = present
        self._stopping = {at: since for at, since in self._stopping.items() if now - since < _STOPPING_S}
        for address in self._greetings.keys() - present.keys():
            _LOG.error("worker %s went before it had answered its greeting", address)
            self._unfit.append((now, Stall(address, "greeting", begun=True, memory=0)))
        for known in (self._workers, self._greetings):
            for address in known.keys() - present.keys():
                del known[address]
        self._refused &= present.keys()
        for address, threads in present.items():
            if address not in self._workers and address not in self._refused and address not in self._stopping:
                self._greet(address, threads, now, passed)

    def _greet(self, address: str, threads: int, now: float, passed: float) -> None:
        """Ask a new worker what it carries; until it has answered it gets no run, and if it does not it is replaced."""
        if address not in self._greetings:
            self._greetings[address] = Asked(self._on(address, f"greet-{uuid4().hex}", greet, self._settings.task), now)
        asked = self._greetings[address]
        if not asked.future.done():
            if asked.has_stalled(self._conditions.get(address), passed, now):
                self._refuse(address, "it does not answer its greeting")
            return
        try:
            said = read_greeting(asked.future.result(timeout=_STOP_S))
        except Exception as error:  # noqa: BLE001 - it comes from another process and may be anything
            self._refuse(address, repr(read_error(error)))
            return
        del self._greetings[address]
        self._failures = 0
        memory = WorkerMemory(said.pid, said.memory, said.memory, said.memory_limit, said.pause_fraction)
        self._workers[address] = Worker(address, threads, said.engine, now, memory)
        _LOG.info("worker %s: engine %.12s, %s, warm after %.1f s", address, said.engine, said.threads, said.warm_s)

    def _refuse(self, address: str, why: str) -> None:
        """Do not use a worker that cannot be greeted; it is replaced at the next look at what is stalled."""
        _LOG.error("worker %s cannot be used: %s", address, why)
        del self._greetings[address]
        self._refused.add(address)
        # The first at once; where none can be greeted, that they are started anew and again is of no use.
        due = time.monotonic() + min(_GREET_AGAIN_S * self._failures, _MAX_GREET_AGAIN_S)
        self._failures += 1
        self._unfit.append((due, Stall(address, "greeting", begun=True, memory=0)))

    def _stop(self, addresses: list[str], futures: list[Any]) -> None:
        # KeyError: a worker that is gone.
        with suppress(TimeoutError, OSError, KeyError, NotPlainError, ClosedClientError):
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


async def _die() -> None:
    # A coroutine, since Dask waits for the answer of everything else.
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
