"""What runs on a Dask worker: one realization through the engine, its figure and arrays into the artefact store.

A worker sees no database. It answers with bytes of JSON only, errors included: see :mod:`service.worker.answers`.
"""

from __future__ import annotations

import io
import logging
import os
import sys
import time
import traceback
from base64 import b64encode
from contextlib import suppress
from importlib import import_module
from typing import TYPE_CHECKING, Any

import psutil

from service.domain.payload import ArtefactPayload, result_payload
from service.runtime import logs
from service.store.artefacts import ArtefactStore, keeping
from service.worker.answers import LIMIT_BYTES, RUNNING, to_bytes
from service.worker.machine import machine

if TYPE_CHECKING:
    from engine import RunResult

_LOG = logging.getLogger(__name__)
_running: list[None] = []
"""As long as what this process is at: Dask takes a task for executed that waits for a thread which never comes."""
_FIRST_COLD = "parametric"
"""Stage of the engine before which a warm-up ends: nearly all that is slow the first time is in the one before."""


def answer_run(task: str, spec: dict[str, Any], artefact_url: str, fields: logs.Fields | None = None) -> bytes:
    """Run the task for a specification; :class:`service.worker.answers.Answer`.

    The dispatcher submits this function, so that it need not import the engine itself. ``fields`` go on every line
    that is logged meanwhile.
    """
    _running.append(None)
    try:
        with logs.bound(**(fields or {})):
            answer = _plain(call_task(task, spec, artefact_url))
    finally:
        _running.pop()
    return b'{"answer":%b,"memory":%d}' % (answer, _memory())


def _plain(answer: dict[str, Any]) -> bytes:
    """An answer as bytes; where that cannot be, one that says so."""
    try:
        data = to_bytes(answer)
        if len(data) <= LIMIT_BYTES:
            return data
        wrong = f"the result has {len(data)} bytes, allowed are {LIMIT_BYTES}"
    except Exception as error:  # noqa: BLE001 - what the task answered may be anything, and so may what it raises
        wrong = f"the result is not plain data: {type(error).__name__}"
    return to_bytes({"error": {"code": "invalid_result", "message": wrong, "permanent": True}})


def _memory() -> int:
    """Memory of this process [bytes]."""
    return int(psutil.Process().memory_info().rss)


def call_task(task: str, spec: dict[str, Any], artefact_url: str) -> dict[str, Any]:
    """Run the task called ``module:function`` and answer ``{"payload": ...}`` or ``{"error": ...}``.

    A payload comes with the digest of the engine that this process has loaded, and with the artefacts that the store
    did not take (base64, by their keys): it is the dispatcher that waits for the store, not a worker.
    """
    try:
        module, _, name = task.partition(":")
        with keeping() as kept:
            payload = getattr(import_module(module), name)(spec, artefact_url)
        answer = {"payload": payload, "engine": _engine()}
        return answer | ({"artefacts": {key: b64encode(data).decode() for key, data in kept.items()}} if kept else {})
    except BaseException as error:  # noqa: BLE001 - whatever went wrong must go home as data; the dispatcher decides
        _LOG.warning("the run failed on the worker", exc_info=error)
        return {
            "error": {
                "code": _error_code(error),
                "message": "".join(traceback.format_exception_only(error)).strip()[:2000],
                "permanent": _is_permanent(error),
            }
        }


def greet(task: str) -> bytes:
    """Make a worker ready: one thread for every numeric library, and the task's module loaded and warm.

    What comes back is a :class:`service.worker.answers.Greeting`.

    A module says by a function ``warm_up`` how it gets warm. Workers that were started elsewhere have seldom been
    told how many threads to use, so it is set here, as far as what is loaded already lets it.
    """
    began = time.perf_counter()
    for name in ("OMP", "OPENBLAS", "MKL", "NUMEXPR", "NUMBA"):
        os.environ[f"{name}_NUM_THREADS"] = "1"
    module = import_module(task.partition(":")[0])
    engine = _engine()
    getattr(module, "warm_up", lambda: None)()
    threads = one_thread()
    warm_s = time.perf_counter() - began
    said = {"engine": engine, "threads": threads, "warm_s": warm_s, "pid": os.getpid(), "memory": _memory()}
    return to_bytes({**said, **_join()})


def _join() -> dict[str, Any]:
    """Have Dask's heartbeats tell what is run here; what memory Dask lets this worker use. Nothing where it is none."""
    from distributed import get_worker

    try:
        worker = get_worker()
    except ValueError:
        return {}
    worker.metrics[RUNNING] = lambda _: len(_running)
    rules = worker.memory_manager
    return {"memory_limit": rules.memory_limit, "pause_fraction": rules.memory_pause_fraction or None}


def one_thread() -> dict[str, int]:
    """Hold every loaded numeric library to one thread; how many each then uses."""
    from threadpoolctl import threadpool_info, threadpool_limits

    threadpool_limits(1)
    threads = {str(pool["internal_api"]): int(pool["num_threads"]) for pool in threadpool_info()}
    if "numba" in sys.modules:
        # Read anew from the environment; where Numba's threads run already it refuses, and says how many there are.
        from numba import config

        config.reload_config()
        threads["numba"] = int(config.NUMBA_NUM_THREADS)
    return threads


def _engine() -> str:
    from engine import engine_digest

    return engine_digest()


class _WarmError(Exception):
    """Ends a run that has loaded what it was started for."""


def warm_up() -> None:
    """Load or compile the engine's kernels, with a small run that is ended before its long stages."""
    from engine import Analysis, Host, Realization, run

    def seen(stage: str, _done: float) -> None:
        if stage == _FIRST_COLD:
            raise _WarmError

    small = Analysis(source_pixels=(12, 12), subrays=1, walkers=4, max_steps=10, draws=2)
    realization = Realization("HE0435", 1.0, Host(n=2.0, r_eff=0.39, magnitude=21.0), analysis=small)
    with suppress(_WarmError):
        run(realization, seen)


def execute(spec: dict[str, Any], artefact_url: str) -> dict[str, Any]:
    """Run one realization and return its payload, ready for JSON.

    Raises
    ------
    engine.errors.SpecError
        The specification is not acceptable.
    service.domain.payload.InvalidResultError
        The engine returned a number that is not finite.
    """
    # Imported by the first run: the engine takes seconds to load, and only workers need it.
    from engine import realization_from_dict, run

    result = run(realization_from_dict(spec))
    artefacts = ArtefactStore(artefact_url)
    figure = artefacts.put(_figure(result), "png")
    payload = result_payload(result, figure, _products(result, artefacts))
    return payload.model_copy(update={"versions": payload.versions | machine()}).model_dump(mode="json")


def _figure(result: RunResult) -> bytes:
    from engine.figures import run_figure

    data = io.BytesIO()
    run_figure(result).savefig(data, format="png", dpi=110)
    return data.getvalue()


def _products(result: RunResult, artefacts: ArtefactStore) -> ArtefactPayload | None:
    """Every array and number of the products as NPZ, under the names that the engine gives them."""
    if result.products is None:
        return None
    import numpy

    data = io.BytesIO()
    # Objects would be pickled, and nobody should have to unpickle a file to read it.
    plain: dict[str, Any] = {n: array for n, array in result.products.arrays().items() if array.dtype != object}
    numpy.savez_compressed(data, **plain)
    return artefacts.put(data.getvalue(), "npz")


def _is_permanent(error: BaseException) -> bool:
    """Whether another attempt cannot help: the engine gives the same answer, errors included, to the same spec."""
    # By name, because importing the engine's errors would load the engine where the task is not the engine's.
    names = {kind.__name__ for kind in type(error).__mro__}
    return not names.isdisjoint({"EngineError", "InvalidResultError"})


def _error_code(error: BaseException) -> str:
    names = {kind.__name__ for kind in type(error).__mro__}
    codes = {
        "InvalidResultError": "invalid_result",
        "SpecError": "invalid_spec",
        "ObservationError": "invalid_observation",
        "EngineError": "engine_error",
        "MemoryError": "memory",
    }
    return next((code for name, code in codes.items() if name in names), "error")
