"""The PSF: how wide its stamp is, from how many wavelengths and on how fine a pupil it is made."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from engine.accuracy.curves import Curve, Knob
from engine.accuracy.subject import Subject
from engine.accuracy.timing import Measuring, cpu_of, least_cpu
from engine.conventions import FloatArray
from engine.imaging.convolution import convolve, point_source_image
from engine.imaging.cusps import place_cusps
from engine.imaging.drizzling import drizzle
from engine.imaging.exposures import expose
from engine.imaging.psf import PUPIL_PIXELS, STAMP_SIDE, detector_kernel, telescope_psf
from engine.light.rendering import render_sersic
from engine.spec.instrument import Camera

STAGE = "psf"
_QUANTITY = "largest error of a fitted pixel of the drizzled image, AGN included"
_UNIT = "sigma of its noise"
STAMP = Knob(
    stage=STAGE,
    name="PSF stamp",
    place="engine.imaging.psf.STAMP_SIDE",
    quantity=_QUANTITY,
    unit=_UNIT,
    work="all light of the scene blurred",
    reference="a stamp as wide as any two sub-pixels of the field are apart: nothing is cut off",
    why_off_front="One width for all fields: those of UVIS are so small that 8 arcsec hold as much, in HE0435 that "
    "would leave eight times the error.",
)
WAVELENGTHS = Knob(
    stage=STAGE,
    name="PSF wavelengths",
    place="Camera.wavelength_nm",
    quantity=_QUANTITY,
    unit=_UNIT,
    work="the PSF, once a process",
    reference="50 even wavelengths over the same band, the throughput interpolated",
)
PUPIL = Knob(
    stage=STAGE,
    name="PSF pupil grid",
    place="engine.imaging.psf.PUPIL_PIXELS",
    quantity=_QUANTITY,
    unit=_UNIT,
    work="the PSF, once a process",
    reference="1,024 pixels across the pupil",
)
_SIDES = (1.2, 2.4, 4.0, 6.0, 8.0, STAMP_SIDE, 14.0)
_MANY_WAVELENGTHS, _FINE_PUPIL = 50, 1024
_ROUNDING = 1e-9
"""Of the transforms, in units of the noise."""
_PART = 4.0
"""Side [arcsec] of the stamps that wavelengths and pupil are measured by: further out all of it is fainter."""


class _Lights:
    """All light of a scene on the sub-pixels of the small field, and the drizzled image of it by a PSF."""

    def __init__(self, subject: Subject) -> None:
        scene, self.subject = subject.scene, subject
        self.geometry = geometry = subject.small_geometry()
        self.kernel = detector_kernel(scene.camera)
        x, y = geometry.high_resolution_axes()
        light = render_sersic(scene.host_profile, x, y, geometry.subpixel_scale, scene.lens)
        self.extended = place_cusps(light, scene.host_profile, subject.cusps, geometry, scene.lens)
        if scene.deflector is not None:
            light = render_sersic(scene.deflector, x, y, geometry.subpixel_scale)
            centre = [(scene.deflector.x, scene.deflector.y)]
            self.extended = self.extended + place_cusps(light, scene.deflector, centre, geometry)
        self.positions = np.array([(source.x, source.y) for source in scene.agn])
        self.fluxes = np.array([source.flux for source in scene.agn])

    def blurred(self, psf: FloatArray) -> FloatArray:
        """On the sub-pixels."""
        return convolve(self.extended, psf) + point_source_image(self.positions, self.fluxes, psf, self.geometry)

    def error(self, blurred: FloatArray, exact: FloatArray) -> float:
        """In units of the noise."""
        image = drizzle(expose(blurred - exact, self.geometry, self.kernel), self.geometry)
        return self.subject.in_noise(self.subject.placed_in_field(image))


def with_wavelengths(camera: Camera, number: int) -> Camera:
    """The camera with so many even wavelengths, the throughput interpolated in its own table.

    A value of the table stands for half the way to its neighbours, the first and the last for as much outwards.
    """
    table = np.asarray(camera.wavelength_nm)
    low, high = 1.5 * table[0] - 0.5 * table[1], 1.5 * table[-1] - 0.5 * table[-2]
    edges = np.linspace(low, high, number + 1)
    centres = 0.5 * (edges[1:] + edges[:-1])
    throughput = np.interp(centres, table, np.asarray(camera.throughput))
    return replace(camera, wavelength_nm=tuple(centres.tolist()), throughput=tuple(throughput.tolist()))


def measure(subject: Subject) -> list[Curve]:
    """Stamp, wavelengths and pupil."""
    return [_stamp(subject), *_making(subject)]


def _stamp(subject: Subject) -> Curve:
    lights, camera = _Lights(subject), subject.scene.camera
    oversampling = lights.geometry.oversampling
    widest = 2.0 * max(lights.geometry.high_resolution_shape) * lights.geometry.subpixel_scale
    exact = lights.blurred(telescope_psf(camera, oversampling=oversampling, field_of_view=max(widest, _SIDES[-1])))
    found = Measuring(STAMP, floor=_ROUNDING)
    for side in _SIDES:

        def one(side: float = side) -> tuple[float, float]:
            psf = telescope_psf(camera, oversampling=oversampling, field_of_view=side)
            return least_cpu(lambda: lights.blurred(psf)), lights.error(lights.blurred(psf), exact)

        found.add(f"{side:g} arcsec", one, default=side == STAMP_SIDE)
    return found.curve()


def _making(subject: Subject) -> list[Curve]:
    lights, camera = _Lights(subject), subject.scene.camera

    def psf(camera: Camera, pupil_pixels: int = PUPIL_PIXELS) -> FloatArray:
        return telescope_psf(
            camera, oversampling=lights.geometry.oversampling, field_of_view=_PART, pupil_pixels=pupil_pixels
        )

    def one(exact: FloatArray, camera: Camera, use: str, pupil_pixels: int = PUPIL_PIXELS) -> tuple[float, float]:
        # Names that nothing has asked for, so that it is computed and not remembered.
        first, second = (replace(camera, name=f"{camera.name}-{use}-{k}") for k in range(2))
        cost = min(cpu_of(lambda: psf(first, pupil_pixels)), cpu_of(lambda: psf(second, pupil_pixels)))
        return cost, lights.error(lights.blurred(psf(second, pupil_pixels)), exact)

    exact = lights.blurred(psf(with_wavelengths(camera, _MANY_WAVELENGTHS)))
    wavelengths = Measuring(WAVELENGTHS)
    for number in (2, 3, 5, 9, 25):
        fewer = with_wavelengths(camera, number)
        wavelengths.add(f"{number} even", partial(one, exact, fewer, "even"))
    wavelengths.add("the catalogue's", partial(one, exact, camera, "table"), default=True)
    sharp = lights.blurred(psf(camera, _FINE_PUPIL))
    pupil = Measuring(PUPIL)
    for pixels in (64, 128, 256, PUPIL_PIXELS, 768):
        pupil.add(f"{pixels}", partial(one, sharp, camera, "pupil", pixels), default=pixels == PUPIL_PIXELS)
    return [wavelengths.curve(), pupil.curve()]
