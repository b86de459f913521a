"""What workers run in the tests: the drills' stand-ins for the engine."""

from __future__ import annotations

import random
from typing import Any

from service.store.artefacts import ArtefactStore
from tests.drills.tasks import PNG, moody, synthetic_payload
from tests.drills.tasks import brief as fast

__all__ = ["PNG", "fast", "heavy", "moody", "synthetic_payload"]


def heavy(spec: dict[str, Any], artefact_url: str) -> dict[str, Any]:
    """A run whose figure and products are as large as those of a large cutout: three megabytes each."""
    payload = synthetic_payload(spec)
    dice = random.Random(payload["realization_digest"])
    store = ArtefactStore(artefact_url)
    for name, suffix in (("figure", "png"), ("products", "npz")):
        payload[name] = store.put(dice.randbytes(3_000_000), suffix).model_dump()
    return payload
