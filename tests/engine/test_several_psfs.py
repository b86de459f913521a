"""One image by several PSFs that it may have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from engine import Host, ImageMeasurement, Realization, SpecError, measure_image, simulate_realization
from engine.several_psfs import averaged
from engine.simulation.simulate import Simulation
from tests.engine.conftest import cut

KNOWN = {"agn_images": 0, "deflector": False, "theta_E": 1.2, "inversion": False}


@pytest.fixture(scope="module")
def ring() -> Simulation:
    """A host without AGN and without a deflector's light: a second a fit."""
    system = replace(cut(pixels=48), agn=(), deflector=None)
    return simulate_realization(Realization(system=system, l_eta=1.0, host=Host(n=1.5, r_eff=0.3, magnitude=21.0)))


@pytest.fixture(scope="module")
def alone(ring: Simulation) -> ImageMeasurement:
    return measure_image(replace(ring.observation, response=None, covariance=None), **KNOWN)  # type: ignore[arg-type]


def test_a_psf_that_fits_worse_has_no_part_in_the_answer(ring: Simulation, alone: ImageMeasurement) -> None:
    good = replace(ring.observation, response=None, covariance=None)
    broad = ndimage.gaussian_filter(good.psf, 1.0)
    found = measure_image(replace(good, psf=broad), **KNOWN, other_psfs=[good.psf])  # type: ignore[arg-type]
    first, second = found.by_psf
    assert (first.place, second.place) == (0, 1)
    assert second.weight > 0.999
    assert second.chi2_per_dof < first.chi2_per_dof
    assert found.host.magnitude.mean == pytest.approx(alone.host.magnitude.mean, abs=0.1 * alone.host.magnitude.sd)
    np.testing.assert_array_equal(found.observation.psf, good.psf)
    document = found.to_dict()["psfs"]
    assert [one["psf"] for one in document] == [1, 2]
    assert document[1]["magnitude"] == pytest.approx(21.0, abs=0.05)


def test_psfs_that_fit_alike_share_the_answer_and_its_error_holds_how_far_they_differ(alone: ImageMeasurement) -> None:
    fit, shift = alone.fit, 0.5
    wide = fit.hosts["wide"]
    moved = wide.mean.copy()
    moved[0] += shift
    other = replace(
        fit,
        hosts={**fit.hosts, "wide": replace(wide, mean=moved)},
        lens=replace(fit.lens, theta_E=fit.lens.theta_E + 0.1),
    )
    place, mixed, told = averaged(alone.observation, [(0, fit), (1, other)])
    assert place == 0
    assert [one.weight for one in told] == pytest.approx([0.5, 0.5])
    # A mixture of two: mean between them, variance larger by the square of half their distance.
    assert mixed.hosts["wide"].mean[0] == pytest.approx(wide.mean[0] + shift / 2)
    assert mixed.hosts["wide"].covariance[0, 0] == pytest.approx(wide.covariance[0, 0] + (shift / 2) ** 2)
    # The lens stays the best one's: its second moment about that.
    assert mixed.lens_covariance[0, 0] == pytest.approx(fit.lens_covariance[0, 0] + 0.5 * 0.1**2)


def test_several_psfs_beside_known_exposures_are_refused(ring: Simulation) -> None:
    with pytest.raises(SpecError, match="psf"):
        measure_image(ring.observation, **KNOWN, other_psfs=[ring.observation.psf])  # type: ignore[arg-type]
