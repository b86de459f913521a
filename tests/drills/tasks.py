"""What a worker runs in a drill beside :func:`service.worker.synthetic.brief`: fast, slow, hungry or deadly."""

from __future__ import annotations

import os
import random
import time
from typing import Any

from engine import realization_from_dict
from service.store.artefacts import ArtefactStore
from service.worker.synthetic import PNG, brief, log_execution, payload_of, seconds, synthetic_payload

__all__ = ["PNG", "brief", "payload_of", "synthetic_payload"]
POISON_EVERY = 40
"""Of the runs of :func:`poisonous`, those with seed 1 modulo this kill their worker."""


def nothing(spec: dict[str, Any], _artefact_url: str) -> dict[str, Any]:
    """No work at all: what remains is the queue."""
    return synthetic_payload(spec)


def pictured(spec: dict[str, Any], artefact_url: str) -> dict[str, Any]:
    """Like brief, with a figure and products of its own, 20 kB each: no other run has written them before."""
    payload = brief(spec, artefact_url)
    dice = random.Random(payload["realization_digest"])
    store = ArtefactStore(artefact_url)
    for name, suffix in (("figure", "png"), ("products", "npz")):
        payload[name] = store.put(PNG + dice.randbytes(20_000), suffix).model_dump()
    return payload


def uneven(spec: dict[str, Any], artefact_url: str) -> dict[str, Any]:
    """Like brief, and then for up to twice as long again, by the seed: runs that begin together do not end so."""
    time.sleep(seconds() * 2.0 * random.Random(spec["seed"]).random())
    return brief(spec, artefact_url)


def busy(spec: dict[str, Any], _artefact_url: str) -> dict[str, Any]:
    """A run that computes: as much of a core as brief sleeps, counted in CPU time, whatever else runs beside it."""
    payload = synthetic_payload(spec)
    until = time.thread_time() + seconds()
    while time.thread_time() < until:
        sum(range(10_000))
    log_execution(payload["realization_digest"])
    return payload


def poisonous(spec: dict[str, Any], artefact_url: str) -> dict[str, Any]:
    """Like brief, but one seed in forty kills its worker on every attempt, a moment after the run has begun."""
    if spec["seed"] % POISON_EVERY == 1:
        time.sleep(seconds() / 2)
        os._exit(9)
    return brief(spec, artefact_url)


def moody(spec: dict[str, Any], artefact_url: str) -> dict[str, Any]:
    """Behaves as the seed says: 1 raises, 2 answers NaN, 3 refuses the spec, 4 kills its worker, else well."""
    seed = spec["seed"]
    if seed == 1:
        raise RuntimeError("the dice fell off the table \x00 \ud800")
    if seed == 3:
        realization_from_dict({**spec, "seed": -1})
    if seed == 4:
        os._exit(9)
    payload = brief(spec, artefact_url)
    if seed == 2:
        payload["estimates"]["paper_free"]["n"]["mean"] = float("nan")
    return payload
