"""How a run that came back from Dask ends: what is stored, what is tried again, what is given up."""

from __future__ import annotations

import hashlib
import traceback
from base64 import b64decode
from dataclasses import dataclass
from typing import Any

from service.domain.payload import InvalidResultError, Payload, read_measurement, read_payload
from service.domain.plan import IMAGE
from service.store.leases import Lease, Outcome
from service.store.queue import Failure
from service.worker.answers import NotPlainError

ERROR_RETRIES = 2
WORKER_LOST_RETRIES = 2
DEADLINE_RETRIES = 1


@dataclass(frozen=True)
class OtherEngine:
    """A result that is not taken: the worker's engine, of this digest, is not the grid's."""

    digest: str


def judge_answer(lease: Lease, answer: Any) -> Payload | Failure | OtherEngine:
    """What a worker's answer means for the run."""
    if not isinstance(answer, dict) or not {"payload", "error"} & set(answer):
        return _invalid("the worker's answer has neither a payload nor an error")
    if "error" in answer:
        return _read_error(answer["error"])
    if lease.engine is not None and answer.get("engine") != lease.engine:
        return OtherEngine(clean(answer.get("engine"), 64))
    try:
        payload: Payload = (read_measurement if lease.kind == IMAGE else read_payload)(answer["payload"])
    except InvalidResultError as error:
        return _invalid(str(error))
    if payload.realization_digest != lease.digest:
        return _invalid(f"the result is that of another realization: {payload.realization_digest}")
    return payload


def _read_error(error: Any) -> Failure:
    if not isinstance(error, dict) or not isinstance(error.get("code"), str) or not error["code"]:
        return _invalid("the worker's error has no code")
    # Nothing but a plain yes forbids another attempt.
    retries = 0 if error.get("permanent") is True else ERROR_RETRIES
    return Failure(Outcome.ERROR, clean(error["code"], 64), clean(error.get("message", "")), retries)


def read_artefacts(payload: Payload, answer: dict[str, Any]) -> dict[str, bytes]:
    """The artefacts of a payload that came home with it because the store did not take them, by their keys.

    Raises
    ------
    service.domain.payload.InvalidResultError
        They are not what the payload names.
    """
    brought = answer.get("artefacts", {})
    if not isinstance(brought, dict):
        raise InvalidResultError("artefacts: they are not named by their keys")
    artefacts = {}
    for named in (payload.figure, payload.products):
        if named is None or named.key not in brought:
            continue
        try:
            data = b64decode(brought[named.key], validate=True)
        except (TypeError, ValueError) as error:
            raise InvalidResultError(f"artefacts: {named.key} is not base64") from error
        if hashlib.sha256(data).hexdigest() != named.digest:
            raise InvalidResultError(f"artefacts: {named.key} is not what the payload names")
        artefacts[named.key] = data
    return artefacts


def read_exception(error: BaseException) -> Failure:
    """What Dask's own failure to run a run means for it, or an answer that is not plain data."""
    if isinstance(error, NotPlainError):
        return _invalid(str(error))
    # Not str(error): that calls code of whatever library raised it, which may raise itself.
    text = clean("".join(traceback.format_exception_only(error)).strip())
    return Failure(Outcome.ERROR, "task_error", text, ERROR_RETRIES)


def worker_lost() -> Failure:
    """A run that was alone on a worker when that died."""
    text = "the worker died while it ran this"
    return Failure(Outcome.WORKER_LOST, "worker_lost", text, WORKER_LOST_RETRIES, suspect=True)


def memory_exceeded(reached: int, limit: int) -> Failure:
    """A run that needs more memory than its worker has."""
    text = f"it took {reached / 2**20:.0f} MiB of a worker that has {limit / 2**20:.0f} MiB"
    return Failure(Outcome.WORKER_LOST, "memory", text, WORKER_LOST_RETRIES, suspect=True)


def overdue(deadline_s: float) -> Failure:
    """A run that took longer than it may."""
    return Failure(Outcome.DEADLINE, "deadline", f"not done within {deadline_s:g} s", DEADLINE_RETRIES)


def refused_artefact(reason: str) -> Failure:
    """A run one of whose artefacts the store refuses while it takes others: to run it again would change nothing."""
    return Failure(Outcome.ERROR, "artefact_refused", clean(reason), retries=0)


def lost_artefact(reason: str) -> Failure:
    """A run one of whose artefacts was lost while it waited for the store."""
    return Failure(Outcome.ERROR, "artefact_lost", clean(reason), ERROR_RETRIES)


def unstorable(error: BaseException) -> Failure:
    """A payload that the database refuses."""
    return _invalid(f"the database refused the result: {type(error).__name__}")


def clean(text: object, length: int = 2000) -> str:
    """Text that every database takes: messages of foreign libraries can hold anything."""
    return str(text).encode("utf-8", "replace").decode("utf-8").replace("\x00", "\ufffd")[:length]


def _invalid(detail: str) -> Failure:
    return Failure(Outcome.ERROR, "invalid_result", clean(detail), retries=0)
