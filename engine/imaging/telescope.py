"""The PSF of a camera in a state of the telescope: focused or not, steady or not, on sub-pixels and drizzled."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

from engine.conventions import FloatArray
from engine.imaging.drizzled_psf import drizzled_psf
from engine.imaging.geometry import Geometry
from engine.imaging.psf import PUPIL_PIXELS, STAMP_SIDE, detector_kernel, telescope_psf
from engine.spec.instrument import NOMINAL_OPTICS, Camera, Optics

_QUICK_PUPIL, _QUICK_SIDE = 128, 3.0
"""Pupil pixels and side [arcsec] of PSFs that are only compared with each other."""


@dataclass(frozen=True)
class TelescopeState:
    """How a telescope departs from its nominal PSF, as far as it is known.

    ``defocus_nm`` is the focus error [nm rms of wavefront], ``blur`` the variance [arcsec^2 an axis] of what broadens
    the PSF besides: jitter, charge diffusion; negative where the PSF is sharper than the nominal one.
    """

    defocus_nm: float = 0.0
    blur: float = 0.0


NOMINAL_STATE = TelescopeState()


def optical_psf(camera: Camera, oversampling: int, optics: Optics = NOMINAL_OPTICS) -> FloatArray:
    """PSF of a camera on sub-pixels, computed once per process."""
    return telescope_psf(camera, oversampling=oversampling, defocus_nm=optics.defocus_nm, jitter=optics.jitter)


def state_psf(
    camera: Camera, oversampling: int, state: TelescopeState, *, side: float = STAMP_SIDE, pupil: int = PUPIL_PIXELS
) -> FloatArray:
    """PSF of a camera on sub-pixels in a state of the telescope; what is sharper than nominal is so to first order."""

    def blurred(jitter: float) -> FloatArray:
        return telescope_psf(
            camera, oversampling=oversampling, field_of_view=side, defocus_nm=state.defocus_nm, jitter=jitter,
            pupil_pixels=pupil,
        )  # fmt: skip

    broad = blurred(math.sqrt(abs(state.blur)))
    return broad if state.blur >= 0.0 else 2.0 * blurred(0.0) - broad


@lru_cache(maxsize=64)
def quick_stamp(camera: Camera, geometry: Geometry, state: TelescopeState) -> FloatArray:
    """Drizzled PSF of a state, 3 arcsec wide: its differences from that of another state are good to a few per cent."""
    psf = state_psf(camera, geometry.oversampling, state, side=_QUICK_SIDE, pupil=_QUICK_PUPIL)
    radius = math.floor(0.5 * _QUICK_SIDE / geometry.drizzled_scale)
    stamp = drizzled_psf(psf, geometry, detector_kernel(camera), radius, phases=1)
    stamp.setflags(write=False)
    return stamp
