"""The drizzle: what its kernel and weights do to a star's flux, and what the size of the droplets loses."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from functools import partial

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from engine.accuracy.curves import Curve, Knob
from engine.accuracy.subject import Subject
from engine.accuracy.timing import Measuring, least_cpu
from engine.catalogue import resolve_dither
from engine.errors import ObservationError
from engine.imaging.convolution import point_source_image
from engine.imaging.drizzling import drizzle, drizzle_weights, drizzled_covariance
from engine.imaging.exposures import expose
from engine.imaging.geometry import Geometry, exposure_geometry
from engine.imaging.noise import exposure_noise
from engine.imaging.psf import detector_kernel, telescope_psf
from engine.simulation.simulate import blurred_host, high_resolution_host, high_resolution_image

STAGE = "drizzle"
KERNEL = Knob(
    stage=STAGE,
    name="drizzle kernel and weights",
    place="Camera.drizzle_kernel, engine.imaging.drizzling.even_weights",
    quantity="largest error of a star's flux, over its place between the pixels",
    unit="mag",
    work="the exposures drizzled",
    reference="the star's light that is in the exposures",
    why_off_front="Where all dithers fall evenly on the drizzled pixels (UVIS, ACS) no weights are needed; in F160W "
    "they are, and a drizzle takes a millisecond.",
)
PIXFRAC = Knob(
    stage=STAGE,
    name="drizzle pixfrac",
    place="Camera.pixfrac",
    quantity="excess of the arc's flux error, all else known, over what the undrizzled exposures give",
    unit="relative",
    work="the covariance of the drizzled pixels",
    reference="the exposures themselves, whose pixels are independent",
    why_off_front="It is the paper's: 0.6 would state an error that is 0.01 % smaller, from weights that are made once "
    "a process.",
)
_STARS, _STAR_FIELD, _SIDE = 12, 2.0, 41
_KERNELS = ("turbo", "point", "gaussian", "lanczos3")
_SINGLE = 1e-5
"""Magnitudes that sums of single precision, in which the package works, may be off by."""
_PIXFRACS = (0.4, 0.5, 0.6, 0.8, 0.9, 1.0)


def measure(subject: Subject) -> list[Curve]:
    """Kernel with weights, and pixfrac."""
    return [_kernels(subject), _pixfracs(subject)]


def _kernels(subject: Subject) -> Curve:
    camera = subject.scene.camera
    geometry = exposure_geometry(camera, resolve_dither(subject.scene.system), (_SIDE, _SIDE))
    # All of it stays on the image wherever it stands.
    field = min(_STAR_FIELD, 0.7 * _SIDE * camera.drizzled_scale)
    star = telescope_psf(camera, oversampling=geometry.oversampling, field_of_view=field)
    places = np.random.default_rng(1).uniform(-0.1, 0.1, (_STARS, 2))
    exposures = [
        expose(point_source_image(place[None], np.ones(1), star, geometry), geometry, detector_kernel(camera))
        for place in places
    ]
    found = Measuring(KERNEL, floor=_SINGLE)

    def one(kernel: str, *, balanced: bool) -> tuple[float, float]:
        other = replace(geometry, kernel=kernel)
        fluxes = [drizzle(taken, other, balanced=balanced).sum() for taken in exposures]
        if not np.isfinite(fluxes).all():
            raise ObservationError(f"kernel {kernel}: some drizzled pixels lie under no droplet")
        wanted = [taken.sum() / geometry.n_dither for taken in exposures]
        cost = least_cpu(lambda: drizzle(exposures[0], other, balanced=balanced))
        return cost, float(np.abs(2.5 * np.log10(np.array(fluxes) / wanted)).max())

    found.add("square, balanced", partial(one, "square", balanced=True), default=True)
    found.add("square, equal weights", partial(one, "square", balanced=False))
    with warnings.catch_warnings():
        # The package warns that some do not keep the flux: that is what is measured.
        warnings.simplefilter("ignore")
        for kernel in _KERNELS:
            found.add(f"{kernel}, equal weights", partial(one, kernel, balanced=False))
    return found.curve()


def _pixfracs(subject: Subject) -> Curve:
    scene, geometry = subject.scene, subject.small_geometry()
    kernel = detector_kernel(scene.camera)
    arc = blurred_host(scene, geometry, high_resolution_host(scene, geometry))
    template = expose(arc, geometry, kernel)
    noiseless = expose(high_resolution_image(scene, geometry, arc), geometry, kernel)
    noise = exposure_noise(noiseless, scene.camera, scene.system.exposures, subject.realization.noise_level)
    variance = noise.variance
    # The template ends where the drizzled image does: light beyond it is in neither.
    inside = np.zeros(template.shape)
    for index in range(geometry.n_dither):
        x, y = geometry.native_axes(index)
        inside[index] = (np.hypot(x[None, :], y[:, None]) < subject.reach).astype(float)
    template = template * inside
    best = float(np.sum(template**2 / variance)) ** -0.5
    found = Measuring(PIXFRAC)
    for pixfrac in (*_PIXFRACS, geometry.pixfrac):

        def one(pixfrac: float = pixfrac) -> tuple[float, float]:
            other = replace(geometry, pixfrac=pixfrac)
            return least_cpu(lambda: drizzled_covariance(variance, other)), _flux_error(other) / best - 1.0

        def _flux_error(other: Geometry) -> float:
            image = drizzle_weights(other) @ template.ravel()
            covariance = sparse.csc_matrix(drizzled_covariance(variance, other))
            try:
                solved = splu(covariance).solve(image)
            except RuntimeError as error:
                raise ObservationError(f"pixfrac {other.pixfrac:g}: covariance of the pixels: {error}") from error
            return 1.0 / math.sqrt(float(image @ solved))

        found.add(f"{pixfrac:g}", one, default=pixfrac == geometry.pixfrac)
    return found.curve()
