"""The PSF of a camera in a state of the telescope: focused or not, steady or not, on sub-pixels and drizzled."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy import ndimage

from engine.conventions import FloatArray
from engine.imaging.drizzled_psf import drizzled_psf
from engine.imaging.geometry import Geometry
from engine.imaging.psf import PUPIL_PIXELS, STAMP_SIDE, detector_kernel, telescope_psf
from engine.spec.instrument import NOMINAL_OPTICS, Camera, Optics

_QUICK_PUPIL, _QUICK_SIDE = 128, 3.0
"""Pupil pixels and side [arcsec] of PSFs that are only compared with each other."""
_RESIDUAL = 20172
"""The stream of random residuals."""
_SPECKLE = 0.42


@dataclass(frozen=True)
class TelescopeState:
    """How a telescope departs from its nominal PSF, as far as it is known.

    ``defocus_nm`` is the focus error [nm rms of wavefront], ``blur`` the variance [arcsec^2 an axis] of what broadens
    the PSF besides: jitter, charge diffusion; negative where the PSF is sharper than the nominal one. ``colour`` is how
    much bluer the sky is than the light that the PSF is taken for, as of :class:`~engine.spec.instrument.Optics`.
    """

    defocus_nm: float = 0.0
    blur: float = 0.0
    colour: float = 0.0


NOMINAL_STATE = TelescopeState()


def _coloured(camera: Camera, colour: float) -> Camera:
    """The camera with the throughput that light has for it whose photons go as wavelength^-colour."""
    if not colour:
        return camera
    middle = float(np.mean(camera.wavelength_nm))
    bluer = [(wavelength / middle) ** -colour for wavelength in camera.wavelength_nm]
    return replace(camera, throughput=tuple(t * b for t, b in zip(camera.throughput, bluer, strict=True)))


@lru_cache(maxsize=8)
def optical_psf(camera: Camera, oversampling: int, optics: Optics = NOMINAL_OPTICS) -> FloatArray:
    """PSF of a camera on sub-pixels, of the sky that ``optics`` spoil; computed once per process."""
    psf = telescope_psf(
        _coloured(camera, optics.colour),
        oversampling=oversampling,
        defocus_nm=optics.defocus_nm,
        jitter=optics.jitter,
    )
    if optics.residual:
        psf = with_residual(psf, camera, oversampling, optics.residual, optics.residual_seed)
    return psf


def with_residual(psf: FloatArray, camera: Camera, oversampling: int, rms: float, seed: int) -> FloatArray:
    """A PSF times one plus a smooth random field of that rms over its light, with the same sum.

    The field is a Gaussian process of the size of a speckle: its standard deviation is 0.42 lambda / D, that of a
    Gaussian with the width of the diffraction pattern.
    """
    middle = float(np.mean(camera.wavelength_nm)) * 1e-9
    speckle = math.degrees(middle / camera.pupil.primary_diameter_m) * 3600.0 * oversampling / camera.pixel_scale
    white = np.random.default_rng([_RESIDUAL, seed]).normal(size=psf.shape)
    field = ndimage.gaussian_filter(white, _SPECKLE * speckle / math.sqrt(2.0), mode="wrap")
    field -= float((psf * field).sum() / psf.sum())
    field *= rms / math.sqrt(float((psf * field**2).sum() / psf.sum()))
    spoilt = np.asarray(psf * (1.0 + field))
    spoilt.setflags(write=False)
    return spoilt


@lru_cache(maxsize=8)
def known_psf(camera: Camera, oversampling: int, coarse: int = 1) -> FloatArray:
    """The nominal PSF on sub-pixels as an analysis has it that knows its means over ``coarse`` sub-pixels a side."""
    psf = optical_psf(camera, oversampling)
    if coarse == 1:
        return psf
    # An even number of them has half of one at either end.
    window = np.ones(coarse) if coarse % 2 else np.concatenate([[0.5], np.ones(coarse - 1), [0.5]])
    means = psf
    for axis in (0, 1):
        means = ndimage.convolve1d(means, window / coarse, axis=axis, mode="constant")
    means = np.asarray(means * (psf.sum() / means.sum()))
    means.setflags(write=False)
    return means


def state_psf(
    camera: Camera, oversampling: int, state: TelescopeState, *, side: float = STAMP_SIDE, pupil: int = PUPIL_PIXELS
) -> FloatArray:
    """PSF of a camera on sub-pixels in a state of the telescope; what is sharper than nominal is so to first order."""

    def blurred(jitter: float) -> FloatArray:
        return telescope_psf(
            _coloured(camera, state.colour), oversampling=oversampling, field_of_view=side,
            defocus_nm=state.defocus_nm, jitter=jitter, pupil_pixels=pupil,
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
