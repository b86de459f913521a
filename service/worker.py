"""What runs on a Dask worker: one realization through the engine, its figure and arrays into the artefact store.

A worker sees no database. It answers with data only, errors included: an exception of a library that the dispatcher
has not installed would not unpickle there.
"""

from __future__ import annotations

import dataclasses
import io
import logging
import traceback
from importlib import import_module
from typing import TYPE_CHECKING, Any

from service.artefacts import ArtefactStore
from service.payload import ArtefactPayload, result_payload

if TYPE_CHECKING:
    from engine import RunResult

_LOG = logging.getLogger(__name__)


def call_task(task: str, spec: dict[str, Any], artefact_url: str) -> dict[str, Any]:
    """Run the task called ``module:function`` and answer ``{"payload": ...}`` or ``{"error": ...}``.

    The dispatcher submits this function, so that it need not import the engine itself.
    """
    try:
        module, _, name = task.partition(":")
        return {"payload": getattr(import_module(module), name)(spec, artefact_url)}
    except Exception as error:  # noqa: BLE001 - whatever went wrong must go home as data; the dispatcher decides
        _LOG.warning("run failed on the worker:\n%s", traceback.format_exc())
        return {
            "error": {
                "code": _error_code(error),
                "message": "".join(traceback.format_exception_only(error)).strip()[:2000],
                "permanent": _is_permanent(error),
            }
        }


def execute(spec: dict[str, Any], artefact_url: str) -> dict[str, Any]:
    """Run one realization and return its payload, ready for JSON.

    Raises
    ------
    engine.errors.SpecError
        The specification is not acceptable.
    service.payload.InvalidResultError
        The engine returned a number that is not finite.
    """
    # Imported by the first run: the engine takes seconds to load, and only workers need it.
    from engine import realization_from_dict, run

    result = run(realization_from_dict(spec))
    artefacts = ArtefactStore(artefact_url)
    figure = artefacts.put(_figure(result), "png")
    return result_payload(result, figure, _products(result, artefacts)).model_dump(mode="json")


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

    values = {field.name: getattr(result.products, field.name) for field in dataclasses.fields(result.products)}
    arrays = {name: numpy.asarray(value) for name, value in values.items() if value is not None}
    data = io.BytesIO()
    # Objects would be pickled, and nobody should have to unpickle a file to read it.
    plain: dict[str, Any] = {name: array for name, array in arrays.items() if array.dtype != object}
    numpy.savez_compressed(data, **plain)
    return artefacts.put(data.getvalue(), "npz")


def _is_permanent(error: Exception) -> bool:
    """Whether another attempt cannot help: the engine gives the same answer, errors included, to the same spec."""
    # By name, because importing the engine's errors would load the engine where the task is not the engine's.
    names = {kind.__name__ for kind in type(error).__mro__}
    return not names.isdisjoint({"EngineError", "InvalidResultError"})


def _error_code(error: Exception) -> str:
    names = {kind.__name__ for kind in type(error).__mro__}
    codes = {
        "InvalidResultError": "invalid_result",
        "SpecError": "invalid_spec",
        "EngineError": "engine_error",
    }
    return next((code for name, code in codes.items() if name in names), "error")
