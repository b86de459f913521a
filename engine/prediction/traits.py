"""What a prediction is made from: the few numbers that say how hard a host is to measure."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np

from engine.biases import Configuration, configuration_of
from engine.catalogue import resolve_camera, resolve_dither, resolve_system
from engine.conventions import FloatArray, pixel_centres, rate_to_magnitude
from engine.errors import SpecError
from engine.imaging.noise import exposure_noise
from engine.light.galaxy import render_light
from engine.simulation.scene import build_scene
from engine.spec.instrument import NOMINAL_OPTICS, Camera, Dither, ExposurePlan, NoiseLevel
from engine.spec.realization import Realization

_ARCSEC = math.pi / 648_000.0
FAINT_AGN = 5.0
"""AGN contrast [mag] of a lens without AGN, or with one that is fainter still: it does no harm any more."""


@dataclass(frozen=True)
class LensTraits:
    """A lensed host before a camera, as far as a prediction knows it.

    ``resolution`` [arcsec] is that of :func:`resolution_of`; ``depth`` [AB mag] the flux of one sigma of empty sky in
    a square arcsec; ``arc_magnitude`` that of the lensed host, ``magnitude`` that of the host behind the lens;
    ``agn_contrast`` AGN minus arc, None without AGN; ``theta_E`` and ``r_eff`` [arcsec], ``n`` and ``l_eta`` of
    deflector and host;
    ``defocus_nm`` and ``jitter`` [arcsec] by how much the telescope departs from the PSF of the analysis.
    """

    camera: str
    resolution: float
    depth: float
    configuration: Configuration
    arc_magnitude: float
    magnitude: float
    agn_contrast: float | None
    theta_E: float
    r_eff: float
    n: float
    l_eta: float
    defocus_nm: float = 0.0
    jitter: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what is no lens."""
        if self.configuration not in get_args(Configuration):
            raise SpecError("configuration", self.configuration, f"one of {list(get_args(Configuration))}")
        for name, least, most in (
            ("resolution", 1e-3, 10.0), ("depth", 5.0, 60.0), ("arc_magnitude", 5.0, 40.0), ("magnitude", 5.0, 40.0),
            ("theta_E", 1e-3, 30.0), ("r_eff", 1e-4, 60.0), ("n", 0.3, 10.0), ("l_eta", 0.2, 1.8),
            ("agn_contrast", -40.0, 40.0), ("defocus_nm", -500.0, 500.0), ("jitter", 0.0, 0.5),
        ):  # fmt: skip
            value = getattr(self, name)
            if value is not None and not least <= value <= most:
                raise SpecError(name, value, f"a number from {least:g} to {most:g}")

    @property
    def arc_snr(self) -> float:
        """Signal to noise of half the arc's light over the sky of the area that it lies on.

        The area is that of the host's half-light ellipse times its magnification and that of a point in each image.
        """
        magnified = 10.0 ** (0.4 * (self.magnitude - self.arc_magnitude))
        images = 4 if self.configuration == "quad" else 2
        area = math.pi * (magnified * self.r_eff**2 + images * (0.5 * self.resolution) ** 2)
        signal: float = 0.5 * 10.0 ** (-0.4 * (self.arc_magnitude - self.depth))
        return signal / math.sqrt(area)

    def deeper(self, factor: float) -> LensTraits:
        """The same lens after ``factor`` times the exposures: the sky's noise falls with their root."""
        if not (math.isfinite(factor) and 0.0 < factor <= 1000.0):
            raise SpecError("depth", factor, "a factor above 0, 1000 at most")
        return replace(self, depth=self.depth + 1.25 * math.log10(factor))


def resolution_of(camera: Camera) -> float:
    """Width of a camera's PSF [arcsec]: lambda / D at the middle of its band, and a pixel, as if both were Gaussian."""
    light = np.asarray(camera.wavelength_nm) * 1e-9
    middle = float(np.average(light, weights=camera.throughput))
    return math.hypot(middle / camera.pupil.primary_diameter_m / _ARCSEC, camera.pixel_scale)


def depth_of(camera: Camera, plan: ExposurePlan, dither: Dither, level: NoiseLevel) -> float:
    """AB magnitude of one sigma of empty sky in a square arcsec of a simulated observation."""
    noise = exposure_noise(np.zeros(1), camera, plan, level)
    pixel = math.sqrt(float(noise.variance[0]) / len(dither.shifts))
    return rate_to_magnitude(pixel / camera.pixel_scale, camera.zero_point)


def traits_of(realization: Realization, arc_magnitude: float | None = None) -> LensTraits:
    """The traits of what a run simulates; ``arc_magnitude`` is rendered (10-50 ms) where it is not known.

    Raises
    ------
    SpecError
        The realization asks for something that is not there.
    """
    system, camera, host = resolve_system(realization), resolve_camera(realization), realization.host
    if host.n is None:
        raise SpecError("host", host.label, "a Sersic profile: predictions go by its index n")
    optics = realization.optics or NOMINAL_OPTICS
    arc = lensed_magnitude(realization) if arc_magnitude is None else arc_magnitude
    light = sum(10.0 ** (-0.4 * image.magnitude) for image in system.agn)
    return LensTraits(
        camera=camera.name,
        resolution=resolution_of(camera),
        depth=depth_of(camera, system.exposures, resolve_dither(system), realization.noise_level),
        configuration=configuration_of(len(system.agn)),
        arc_magnitude=arc,
        magnitude=host.magnitude,
        agn_contrast=-2.5 * math.log10(light) - arc if light > 0 else None,
        theta_E=system.mass_model(realization.mass_model, realization.l_eta).theta_E,
        r_eff=host.r_eff,
        n=host.n,
        l_eta=realization.l_eta,
        defocus_nm=optics.defocus_nm,
        jitter=optics.jitter,
    )


def lensed_magnitude(realization: Realization) -> float:
    """AB magnitude of the lensed host within the field of the realization's image."""
    scene = build_scene(realization)
    reach = 0.5 * scene.system.exposures.field_pixels * scene.camera.drizzled_scale
    cells = math.ceil(2.0 * reach / scene.camera.pixel_scale)
    axis = pixel_centres(cells, scene.camera.pixel_scale)
    light = render_light(scene.host, axis, axis, scene.camera.pixel_scale, scene.lens)
    return rate_to_magnitude(float(light.sum()), scene.camera.zero_point)


def features(traits: LensTraits) -> FloatArray:
    """What the model sees, (9,), each in units in which a difference of one is a large one (:data:`FEATURES`)."""
    contrast = FAINT_AGN if traits.agn_contrast is None else min(traits.agn_contrast, FAINT_AGN)
    spoilt = math.hypot(traits.defocus_nm / 5.0, traits.jitter / 0.003)
    return np.array(
        [
            {"double": 0.0, "quad": 1.0, "other": 0.5}[traits.configuration],
            2.0 * math.log10(traits.arc_snr),
            4.0 * math.log10(traits.r_eff / traits.resolution),
            4.0 * math.log10(traits.theta_E / traits.r_eff),
            0.8 * (traits.magnitude - traits.arc_magnitude),
            traits.n / 1.5,
            traits.l_eta / 0.3,
            contrast / 1.5,
            spoilt,
        ]
    )


FEATURES = ("configuration", "arc_snr", "r_eff", "theta_E", "magnification", "n", "l_eta", "agn_contrast", "psf")
"""Of which one unit is: two images or four; S/N by a factor 3.2; r_eff over resolution, and theta_E over r_eff, by 1.8;
magnification by 3.2; 1.5 in n; 0.3 in l_eta; 1.5 mag of contrast; 5 nm of defocus or 0.003 arcsec of jitter that the
analysis does not know."""
