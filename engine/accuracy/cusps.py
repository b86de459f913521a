"""Sub-pixels, and light placed within them round the cusps, against sub-pixels several times finer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from engine.accuracy.curves import Curve, Knob
from engine.accuracy.subject import Subject
from engine.accuracy.timing import Measuring, least_cpu
from engine.conventions import FloatArray
from engine.imaging.convolution import convolve
from engine.imaging.cusps import CuspGrid, place_cusps
from engine.imaging.drizzling import drizzle
from engine.imaging.exposures import expose
from engine.imaging.geometry import Geometry
from engine.imaging.psf import detector_kernel, telescope_psf
from engine.light.rendering import render_sersic

STAGE = "cusps"
_REFERENCE = "sub-pixels several times finer along a side, and no light moved within them"
_QUANTITY = "largest error of a fitted pixel of the host's drizzled image"
_UNIT = "sigma of its noise"
PLACEMENT = Knob(
    stage=STAGE,
    name="cusp placement",
    place="engine.imaging.cusps.CuspGrid",
    quantity=_QUANTITY,
    unit=_UNIT,
    work="the lensed host on the sub-pixels, and its cusps placed",
    reference=_REFERENCE,
    why_off_front="On sub-pixels of 0.01 arcsec (UVIS, ACS) hosts are smooth and the cusps could stay where they "
    "are; in F160W that would be 0.13 of the noise, and a part of a rendering is all that it costs.",
)
OVERSAMPLING = Knob(
    stage=STAGE,
    name="PSF oversampling",
    place="Camera.oversampling",
    quantity=_QUANTITY,
    unit=_UNIT,
    work="the host rendered, its cusps placed, blurred and exposed",
    reference=_REFERENCE,
    why_off_front="On the fine sub-pixels of UVIS cusps need not be placed, which is a seventh of the time; in F160W "
    "they are what keeps it at one.",
)
_STAMP, _FULL, _DARK = 4.2, 1.4, 2.0
"""Side of the PSF [arcsec], and the radii between which it fades: the same light is left out by all."""
_FINEST = 0.0037
"""Side of the reference's sub-pixels [arcsec], or the next one below."""


class _Field:
    """The host on sub-pixels ``finer`` times as fine as usual."""

    def __init__(self, subject: Subject, finer: int) -> None:
        self.subject = subject
        self.geometry: Geometry = subject.small_geometry(finer)
        camera = subject.scene.camera
        psf = telescope_psf(camera, oversampling=self.geometry.oversampling, field_of_view=_STAMP)
        self.psf = _faded(psf, self.geometry.subpixel_scale)
        self.kernel = detector_kernel(camera)

    def light(self, cells: CuspGrid | None) -> FloatArray:
        """Flux per sub-pixel, with or without its cusps placed."""
        scene, geometry = self.subject.scene, self.geometry
        light = render_sersic(scene.host_profile, *geometry.high_resolution_axes(), geometry.subpixel_scale, scene.lens)
        if cells is None:
            return light
        return place_cusps(light, scene.host_profile, self.subject.cusps, geometry, scene.lens, cells)

    def image(self, light: FloatArray) -> FloatArray:
        """Noiseless exposures of it."""
        return expose(convolve(light, self.psf), self.geometry, self.kernel)


def _faded(psf: FloatArray, scale: float) -> FloatArray:
    """A stamp that falls to zero smoothly before its edge: sides are whole sub-pixels, and an edge would be seen."""
    axis = (np.arange(psf.shape[0]) - psf.shape[0] // 2) * scale
    beyond = np.clip((np.hypot(axis, axis[:, None]) - _FULL) / (_DARK - _FULL), 0.0, 1.0)
    return np.asarray(psf * np.cos(0.5 * np.pi * beyond) ** 2)


def measure(subject: Subject) -> list[Curve]:
    """Placement of the cusps, and the number of sub-pixels."""
    usual, factor = _Field(subject, 1), int(np.ceil(subject.geometry.subpixel_scale / _FINEST))
    fine = _Field(subject, factor)
    exact = fine.image(fine.light(None))

    def error(exposures: FloatArray) -> float:
        return subject.in_noise(subject.placed_in_field(drizzle(exposures - exact, usual.geometry)))

    floor = error(fine.image(fine.light(CuspGrid())))
    placement = Measuring(PLACEMENT, floor)
    default = CuspGrid()
    for setting, cells in {
        "none": None,
        "2 cells": replace(default, fine=2),
        "3 cells": replace(default, fine=3),
        "5 cells, 12 sub-pixels, 8 nodes": default,
        "9 cells": replace(default, fine=9),
        "6 sub-pixels": replace(default, half=6),
        "20 sub-pixels": replace(default, half=20),
        "4 nodes": replace(default, nodes=4),
        "12 nodes": replace(default, nodes=12),
    }.items():

        def placed(cells: CuspGrid | None = cells) -> tuple[float, float]:
            return least_cpu(lambda: usual.light(cells)), error(usual.image(usual.light(cells)))

        placement.add(setting, placed, default=cells == default)
    oversampling = Measuring(OVERSAMPLING, floor)
    for finer in (1, 2, 3):
        for cells in (default, None):

            def sampled(finer: int = finer, cells: CuspGrid | None = cells) -> tuple[float, float]:
                field = _Field(subject, finer)
                cost = least_cpu(lambda: field.image(field.light(cells)))
                return cost, error(field.image(field.light(cells)))

            setting = f"{finer} x the camera's{'' if cells else ', cusps not placed'}"
            if finer < factor:
                oversampling.add(setting, sampled, default=finer == 1 and cells is not None)
    return [placement.curve(), oversampling.curve()]
