"""The threads that handlers run in: who only looks does not queue behind who waits."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Hashable
from concurrent.futures import Executor, ThreadPoolExecutor
from contextvars import copy_context
from functools import partial, wraps
from inspect import iscoroutinefunction
from typing import Any, TypeVar

from fastapi.routing import APIRoute

T = TypeVar("T")
QUICK = ThreadPoolExecutor(3, "quick")
"""For reads of the database. More threads answer no sooner: they only take turns at the interpreter."""
PATIENT = ThreadPoolExecutor(32, "patient")
"""For what may have to wait: a transaction that writes for its turn, an artefact for its store."""
EVENTS = ThreadPoolExecutor(4, "events")
PROBES = ThreadPoolExecutor(2, "probes")


async def run_in(threads: Executor, call: Callable[..., T], *arguments: Any, **named: Any) -> T:
    """Call in one of these threads, under the ids that this request logs with."""
    bound = partial(copy_context().run, call, *arguments, **named)
    return await asyncio.get_running_loop().run_in_executor(threads, bound)


class SharedReads:
    """Reads that several ask for at once, done once for all of them.

    Who asks for what still waits for a thread is answered with it: it begins after he asked, so that he sees whatever
    was committed before. What has begun is joined by nobody.
    """

    def __init__(self, threads: Executor) -> None:
        self._threads = threads
        self._waiting: dict[Hashable, asyncio.Future[Any]] = {}

    async def ask(self, call: Callable[..., T], *arguments: Hashable) -> T:
        """Call in one of the threads, or wait for the same call of somebody else that has not begun."""
        key = (call, *arguments)
        found = self._waiting.get(key)
        if found is None:
            loop = asyncio.get_running_loop()
            found = self._waiting[key] = loop.create_future()
            begun = partial(self._begin, key)
            running = loop.run_in_executor(self._threads, copy_context().run, begun, call, *arguments)
            running.add_done_callback(partial(_hand_on, found))
        # Whoever goes away takes the answer from nobody else.
        result: T = await asyncio.shield(found)
        return result

    def _begin(self, key: Hashable, call: Callable[..., T], *arguments: Hashable) -> T:
        del self._waiting[key]
        return call(*arguments)


def _hand_on(waiting: asyncio.Future[Any], done: asyncio.Future[Any]) -> None:
    """Answer those who wait as a call ended."""
    if done.cancelled():
        waiting.cancel()
    elif (error := done.exception()) is None:
        waiting.set_result(done.result())
    else:
        waiting.set_exception(error)
        # All who asked may have gone: nobody is told then, and none has to be.
        waiting.exception()


def patient(handler: Callable[..., T]) -> Callable[..., T]:
    """Mark a handler of a GET that may have to wait."""
    handler.__dict__["is_patient"] = True
    return handler


class Route(APIRoute):
    """A route whose plain handler runs in the threads that suit its method."""

    def __init__(self, path: str, endpoint: Callable[..., Any], **options: Any) -> None:
        if not iscoroutinefunction(endpoint):
            looks = set(options.get("methods") or ()) <= {"GET", "HEAD"} and not hasattr(endpoint, "is_patient")
            endpoint = _threaded(endpoint, QUICK if looks else PATIENT)
        super().__init__(path, endpoint, **options)


def _threaded(handler: Callable[..., T], threads: Executor) -> Callable[..., Any]:
    @wraps(handler)
    async def run(**values: Any) -> T:
        return await run_in(threads, handler, **values)

    return run
