"""How light gets into pixels: the tolerance of the integration against a mesh graded towards the cusps."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from engine.accuracy import peers
from engine.accuracy.curves import Curve, Knob, Point
from engine.accuracy.light_reference import graded_fluxes
from engine.accuracy.subject import Subject
from engine.accuracy.timing import Measuring, least_cpu
from engine.codes.installed import installed
from engine.conventions import FloatArray
from engine.imaging.convolution import convolve
from engine.imaging.drizzling import drizzle
from engine.imaging.exposures import expose
from engine.imaging.geometry import Geometry
from engine.imaging.psf import detector_kernel
from engine.imaging.telescope import optical_psf
from engine.lensing.power_law import PowerLawLens
from engine.light.rendering import DEFAULT_TOLERANCE, render_sersic, sample_sersic
from engine.light.sersic import SersicProfile

STAGE = "rendering"
INTEGRATION = Knob(
    stage=STAGE,
    name="pixel integration",
    place="engine.light.rendering.DEFAULT_TOLERANCE",
    quantity="largest error of a fitted pixel of the drizzled image",
    unit="sigma of its noise",
    work="the lensed host on the sub-pixels of the ring",
    reference="Gauss-Legendre on a mesh graded towards the images of the cusp, then the same optics",
    why_off_front="The hosts of F160W need it; in UVIS a coarser one leaves less than a thousandth as well.",
)
_TOLERANCES = (1e-2, 1e-3, DEFAULT_TOLERANCE, 1e-5, 1e-6)
_UNIFORM = (1, 2, 4, 8)
PEER_SUBPIXELS = (1, 2, 4)
_ORDERS, _REACH = (8, 10), 3.0


def uniform(
    profile: SersicProfile, lens: PowerLawLens, x: FloatArray, y: FloatArray, scale: float, subpixels: int
) -> FloatArray:
    """Flux per pixel (ny, nx) by ``subpixels`` squared even rays a pixel, some rows at a time."""
    offsets = ((np.arange(subpixels) + 0.5) / subpixels - 0.5) * scale
    columns, image = np.add.outer(x, offsets).ravel(), []
    for part in np.array_split(y, max(1, subpixels * y.size // 200)):
        rays = sample_sersic(profile, lens, columns, np.add.outer(part, offsets).ravel(), scale / subpixels)
        image.append(rays.reshape(part.size, subpixels, x.size, subpixels).sum(axis=(1, 3)))
    return np.vstack(image)


def seen(subject: Subject, light: FloatArray, geometry: Geometry, psf: FloatArray) -> FloatArray:
    """The drizzled image of light (flux per sub-pixel) through a PSF, in the middle of the field's own."""
    exposures = expose(convolve(light, psf), geometry, detector_kernel(subject.scene.camera))
    return subject.placed_in_field(drizzle(exposures, geometry))


class HostImage:
    """The lensed host of a subject on sub-pixels centred at ``x``, ``y`` [arcsec], and the error of images of it."""

    def __init__(self, subject: Subject) -> None:
        scene, self.geometry, self.subject = subject.scene, subject.small_geometry(), subject
        self.host, self.lens, self.scale = scene.host_profile, scene.lens, self.geometry.subpixel_scale
        self.x, self.y = self.geometry.high_resolution_axes()
        self._psf = optical_psf(scene.camera, self.geometry.oversampling)
        self._other, self._exact = (
            graded_fluxes(self.host, self.x, self.y, self.scale, self.lens, reach=_REACH, order=order)
            for order in _ORDERS
        )

    def error(self, image: FloatArray) -> float:
        """Of the drizzled image, in units of the noise."""
        return self.subject.in_noise(seen(self.subject, image - self._exact, self.geometry, self._psf))

    @property
    def floor(self) -> float:
        """Error of a reference of lower order."""
        return self.error(self._other)


def measure(subject: Subject) -> list[Curve]:
    """The one knob of this stage."""
    image = HostImage(subject)
    host, lens, x, y, scale = image.host, image.lens, image.x, image.y, image.scale
    found = Measuring(INTEGRATION, floor=image.floor)

    def one(render: Callable[[], FloatArray]) -> tuple[float, float]:
        return least_cpu(render), image.error(render())

    for tolerance in _TOLERANCES:
        adaptive = partial(render_sersic, host, x, y, scale, lens, tolerance)
        found.add(f"{tolerance:.0e}", partial(one, adaptive), default=tolerance == DEFAULT_TOLERANCE)
    for subpixels in _UNIFORM:
        found.add(
            f"even rays {subpixels} x {subpixels}", partial(one, partial(uniform, host, lens, x, y, scale, subpixels))
        )
    if installed("lenstronomy"):
        for subpixels in PEER_SUBPIXELS:
            cost, error = one(peers.lenstronomy_image(host, lens, x, y, scale, subpixels))
            found.add_peers([Point(f"{subpixels} x {subpixels}", cost, error, peer="lenstronomy")])
    return [found.curve()]
