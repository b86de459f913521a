"""Images of other people, as they are: each may be a lens, and nothing is odd but what is."""

from pathlib import Path

import numpy as np
import pytest

from engine import read_external_observation
from engine.parametric.detectability import why_no_lens
from engine.plausibility import unlikely

SCALES = {"paired_lens": 0.08, "tdlmc": 0.08, "slacs": 0.05, "real_quasar": 0.04}
FOLDERS = [
    *(f"paired_lens/sim_lens_{kind}_ID{number}" for kind in ("AGN", "transient") for number in (1, 4, 10, 27)),
    *(f"slacs/{name}" for name in ("J0029-0055", "J1250+0523", "J1627-0053", "J2300+0022")),
    "tdlmc/rung0_seed3/drizzled_image",
    "tdlmc/rung2_seed119/drizzled_image",
    "real_quasar",
]
FILES = {
    "paired_lens": ("Drz_QSO_image.fits", "Drz_PSF.fits", "noise_map.fits"),
    "tdlmc": ("lens-image.fits", "psf.fits", "noise_map.fits"),
}


@pytest.mark.parametrize("name", FOLDERS)
def test_an_outside_image_is_no_doubt_a_lens(shared_data: Path, name: str) -> None:
    kind = name.partition("/")[0]
    image, psf, noise = (
        shared_data / name / file for file in FILES.get(kind, ("image.fits", "psf.fits", "noise.fits"))
    )
    how = {"noise": noise, "pixel_scale": SCALES[kind], "zero_point": 25.95, "recentre_psf": "pixel"}
    seen = read_external_observation(image, psf, normalise_psf=True, mend_psf=True, **how)  # type: ignore[arg-type]
    assert why_no_lens(seen) is None
    notes = (*seen.notes, *unlikely(seen))
    if kind == "real_quasar":
        # Its PSF is sampled three times as finely as the image, which no keyword says: its four AGN images do.
        assert [note.partition(" as finely")[0] for note in notes] == ["psf: is taken for sampled 3 times"]
        finer = read_external_observation(image, psf, psf_oversampling=3, normalise_psf=True, **how)  # type: ignore[arg-type]
        np.testing.assert_allclose(finer.psf, seen.psf)
        as_it_is = read_external_observation(image, psf, psf_oversampling=1, normalise_psf=True, **how)  # type: ignore[arg-type]
        assert [note.partition(" times as sharp")[0] for note in unlikely(as_it_is)] == [
            "psf: the image has a peak 3.7"
        ]
    else:
        assert notes == ()
