"""``image``: the ray-traced Sersic fitted to the data themselves, together with the lens and all other light.

That is what the parametric fit of the whole image does. The source map has no part in it, nor has the lens of the
chain, which does not know that the host is a Sersic profile: where the arc is faint it strays from the lenses behind
which it is one. And the sky is known from the whole field, where the ring of the inversion cannot tell it from the
host's wings.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from engine.estimators.sersic_fit import Refit, SersicFit
from engine.parametric.host_posterior import HostPosterior
from engine.result import IndexPrior


def refit_image(
    hosts: Mapping[IndexPrior, HostPosterior], priors: tuple[IndexPrior, ...], draws: int, seed: int
) -> list[Refit]:
    """As many draws of the host for each prior of n, from the same random numbers; None where it has no fit."""
    out = []
    for prior in priors:
        fits: tuple[SersicFit | None, ...] = (None,) * draws
        if prior in hosts:
            host = hosts[prior]
            profiles = host.draws(draws, np.random.default_rng(seed))
            fits = tuple(SersicFit(profile, host.n_at_bound, host.r_eff_at_bound) for profile in profiles)
        out.append(Refit("image", prior, fits))
    return out
