"""Where randomness comes from: a generator for each realization and purpose, handed down and never global."""

from __future__ import annotations

import numpy as np

from engine.spec.realization import Realization


def generator(realization: Realization, purpose: int) -> np.random.Generator:
    """The random generator of a realization for one purpose: equal specs give equal streams."""
    return _generator(realization.digest, realization.seed, purpose)


def sky_generator(realization: Realization, purpose: int) -> np.random.Generator:
    """The same for what is observed: however a realization is analysed, its image has the same noise."""
    return _generator(realization.observation_digest, realization.seed, purpose)


def _generator(digest: str, seed: int, purpose: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence([seed, int(digest[:16], 16), purpose]))
