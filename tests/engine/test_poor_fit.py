"""What is known of a host that no profile of the model describes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import integrate

from engine.light.sersic import sersic_k, sersic_normalisation
from engine.parametric.fit import ParametricFit
from engine.parametric.host_posterior import COORDINATES
from engine.parametric.poor_fit import widened
from engine.simulation.simulate import Simulation

FLUX, RADIUS = COORDINATES.index("ln_flux"), COORDINATES.index("ln_r_eff")


def test_wings_that_the_image_does_not_show_are_in_the_error_of_a_poor_fit(
    simulation: Simulation, fit: ParametricFit
) -> None:
    observation, posterior = simulation.observation, fit.hosts["wide"]
    before = posterior.covariance[[FLUX, RADIUS], [FLUX, RADIUS]]
    added = []
    for noise in (1.0, 100.0):
        # All that the model leaves is noise, so that nothing is missed among the arcs.
        noisier = replace(fit, sigma=noise * fit.sigma)
        wide = widened(replace(observation, image=fit.model), noisier, posterior)
        extra = wide.covariance[[FLUX, RADIUS], [FLUX, RADIUS]] - before
        assert extra[0] == pytest.approx(extra[1]), "nothing but wings"
        added.append(math.sqrt(float(extra[0])))
    assert added[0] < 0.2, "of a bright host of n = 2 an eighth is in wings below the noise of a pixel"
    assert added[1] > 3 * added[0], "of one in a hundred times the noise most is"


def test_the_wings_are_those_of_the_profile_beyond_what_is_seen(simulation: Simulation, fit: ParametricFit) -> None:
    observation, n = simulation.observation, 4.0
    host = replace(fit.host, n=n, r_eff=3.0)
    wide = widened(replace(observation, image=fit.model), replace(fit, host=host), fit.hosts["wide"])
    wings = math.sqrt(float(wide.covariance[FLUX, FLUX] - fit.hosts["wide"].covariance[FLUX, FLUX]))
    k, peak = sersic_k(n), sersic_normalisation(n, host.r_eff)

    def within(radius: float) -> float:
        light = integrate.quad(lambda r: r * math.exp(-k * (r / host.r_eff) ** (1 / n)), 0.0, radius)
        return 2 * math.pi * peak * float(light[0])

    # A host as large as the ring is seen out to about the ring's width: between 0.3 and 3 arcsec of its own plane.
    assert -math.log(within(3.0)) < wings < -math.log(within(0.3))


def test_light_that_is_missed_among_the_arcs_is_in_the_flux_and_not_in_the_radius(
    simulation: Simulation, fit: ParametricFit
) -> None:
    posterior = fit.hosts["wide"]
    missing = replace(simulation.observation, image=fit.model + 0.2 * fit.arc * np.sign(np.sin(np.arange(64) / 3.0)))
    extra = widened(missing, fit, posterior).covariance - posterior.covariance
    # Stripes of a fifth of the arcs: smoothed by 1.5 pixels a little is lost.
    assert math.sqrt(extra[FLUX, FLUX] - extra[RADIUS, RADIUS]) == pytest.approx(0.17, abs=0.04)
