"""What a worker says to the dispatcher: bytes of JSON, and how they are read there.

The dispatcher holds the database's password and workers hold nothing, so nothing that a worker says may become more
than data: it is never unpickled, its size is bounded, and what it means is checked where it is used.
"""

from __future__ import annotations

import json
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

LIMIT_BYTES = 64 * 2**20
"""Of the answer for one run. That of the engine has some 20 kB; figure and arrays, of megabytes, come home with it
where the artefact store does not take them."""
_GREETING_BYTES = 2**20
RUNNING = "hostlens_running"
"""Among the metrics in a worker's heartbeats: how many tasks it is at."""

_DocumentT = TypeVar("_DocumentT", bound=BaseModel)
_Name = Annotated[str, Field(max_length=64)]


class NotPlainError(TypeError):
    """Something came from another process that is not plain data, or is too large."""


class Greeting(BaseModel):
    """What a worker says before its first run.

    Digest of its engine, its threads by library, seconds that it took to get warm; number of its process, memory of
    that by then, and the limit of it and the fraction of that beyond which Dask gives it no more tasks (None: there is
    none) [bytes].
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    engine: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    threads: Annotated[dict[_Name, int], Field(max_length=100)]
    warm_s: Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
    pid: int
    memory: Annotated[int, Field(ge=0)]
    memory_limit: Annotated[int, Field(gt=0)] | None = None
    pause_fraction: Annotated[float, Field(gt=0.0, allow_inf_nan=False)] | None = None


class Answer(BaseModel):
    """What a worker says after a run: its answer, and the memory of the worker's process by then [bytes]."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    answer: dict[str, Any]
    memory: Annotated[int, Field(ge=0)] = 0


def to_bytes(document: object) -> bytes:
    """A document as a worker says it; TypeError or ValueError where it is not plain data."""
    return json.dumps(document, separators=(",", ":")).encode()


def read_greeting(said: object) -> Greeting:
    """A worker's greeting; NotPlainError where it is none."""
    return _read(Greeting, said, _GREETING_BYTES)


def read_answer(said: object) -> Answer:
    """A worker's answer for a run; NotPlainError where it is none."""
    return _read(Answer, said, 2 * LIMIT_BYTES)


def _read(kind: type[_DocumentT], said: object, limit: int) -> _DocumentT:
    if not isinstance(said, bytes):
        raise NotPlainError(f"the worker's answer is not plain data but {type(said).__name__}")
    if len(said) > limit:
        raise NotPlainError(f"the worker's answer has {len(said)} bytes, allowed are {limit}")
    try:
        return kind.model_validate(json.loads(said))
    except ValidationError as error:
        first = error.errors()[0]
        raise NotPlainError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from error
    except (ValueError, RecursionError) as error:
        raise NotPlainError("the worker's answer is not JSON") from error
