"""The threads that handlers run in: who only looks does not queue behind who waits."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
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
