"""Where randomness comes from: a generator for each realization and purpose, handed down and never global."""

from __future__ import annotations

import numpy as np

from engine.spec import Realization


def generator(realization: Realization, purpose: int) -> np.random.Generator:
    """The random generator of a realization for one purpose: equal specs give equal streams."""
    key = int(realization.digest[:16], 16)
    return np.random.default_rng(np.random.SeedSequence([realization.seed, key, purpose]))
