"""Optics: the PSF of the sky is not the one that the analysis is given"""

from dataclasses import replace

import pytest

from engine import Analysis, Host, Realization, run
from engine.spec.instrument import Optics
from tests.engine.conftest import cut

IMAGE = Analysis(estimators=("image",))
BREATHING = {
    "HE1104": Realization(system=cut("HE1104"), l_eta=1.0, host=Host(n=2.0, r_eff=0.4, magnitude=19.5), seed=3),
    "HS2209": Realization(system=cut("HS2209", 100), l_eta=1.0, host=Host(n=2.0, r_eff=0.4, magnitude=20.0), seed=3),
}
"""Fields that are smaller than the catalogue's: a fit takes a third as long."""


@pytest.mark.parametrize(("name", "defocus"), [("HE1104", 40.0), ("HS2209", 20.0)])
def test_a_telescope_out_of_focus_is_no_failure_and_no_bias(name: str, defocus: float) -> None:
    """AGN up to ten magnitudes above their host, 20 and 40 nm out of focus and analysed with the nominal PSF.

    Could go wrong: the AGN's wings are misfitted by many times the noise; the run fails, or the host takes them. Holds:
    the run ends with a chi2 per degree of freedom below 1.2, flux, radius and index lie within three of their stated
    deviations, and the focus that was found is told.
    """
    result = run(replace(BREATHING[name], optics=Optics(defocus_nm=defocus), analysis=IMAGE))
    assert result.chi2 < 1.2 * result.degrees_of_freedom
    host = result.estimate("image", "wide")
    for quantity in (host.magnitude, host.r_eff, host.n):
        assert quantity.bias == pytest.approx(0.0, abs=3.0 * quantity.sd)
    # A nominal PSF is 0.04 and more off, or the run has no result at all.
    assert host.magnitude.sd < 0.1
    (told,) = (warning for warning in result.warnings if warning.startswith("psf:"))
    found = float(told.partition("has ")[2].partition(" nm")[0])
    # To a tenth of HST's breathing, which is the prior.
    assert found == pytest.approx(defocus, abs=1.5)
