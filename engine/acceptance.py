"""Whether a realization can be run at all: what is wrong with it as a whole, said before anything is computed."""

from __future__ import annotations

import math

from engine.catalogue import resolve_camera, resolve_dither, resolve_system
from engine.errors import SpecError
from engine.imaging.geometry import exposure_geometry
from engine.imaging.psf import coarsest_subpixel
from engine.posterior.target import wide_prior
from engine.simulation.scene import check_analysis, check_deflector, power_law_lens
from engine.spec.realization import Realization

_MOST_SUBPIXELS = 8192
"""Along a side of the high-resolution image or of the PSF: 0.5 GB an array."""
_PSF_FIELD = 10.4
"""Side of the PSF stamp [arcsec]."""


def check_realization(realization: Realization) -> None:
    """Refuse a realization that no run could end well with.

    Camera and dither pattern must sample the telescope's PSF and fit into memory, priors must leave something of each
    parameter, and the analysis must ask for nothing that the system has not. What its values are by themselves was
    checked when it was made, and a system of one's own by :func:`~engine.simulation.scene.check_system`.

    Raises
    ------
    SpecError
        It names the field within the realization, as ``system.camera.oversampling`` or ``analysis.priors.q``.
    """
    check_analysis(realization)
    check_deflector(realization)
    _check_sampling(realization)
    _check_priors(realization)


def _check_sampling(realization: Realization) -> None:
    camera, system = resolve_camera(realization), resolve_system(realization)
    where = "camera" if realization.camera is not None else "system.camera"
    side = system.exposures.field_pixels
    dither = resolve_dither(system)
    # Before the geometry is made, which has whole numbers of pixels.
    factor = dither.subpixels * math.ceil(camera.oversampling / dither.subpixels)
    if max(side * camera.drizzled_scale, _PSF_FIELD) / camera.pixel_scale * factor > _MOST_SUBPIXELS:
        raise SpecError(
            f"{where}.pixel_scale",
            camera.pixel_scale,
            f"at most {_MOST_SUBPIXELS} sub-pixels along the image of {side} pixels and along the PSF",
        )
    geometry = exposure_geometry(camera, dither, (side, side))
    nyquist = coarsest_subpixel(camera)
    if geometry.subpixel_scale > nyquist:
        raise SpecError(
            f"{where}.oversampling", camera.oversampling, f"sub-pixels below {nyquist:.4f} arcsec, lambda / 2D"
        )


def _check_priors(realization: Realization) -> None:
    system, own = resolve_system(realization), realization.analysis.priors
    mass = system.mass_model(realization.mass_model, realization.l_eta)
    # Round the true lens, which the fit that the run starts from is close to.
    widest = wide_prior(power_law_lens(mass), shear=any(mass.shear or ()))
    stated = {name: prior for name, prior in system.priors.items() if name not in own}
    for where, priors in (("system", stated), ("analysis", own)):
        try:
            widest.restricted(priors)
        except SpecError as error:
            raise SpecError(f"{where}.{error.field}", error.value, error.allowed) from error
