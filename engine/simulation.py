"""The forward simulation: from a scene to a drizzled observation, each step a function of its own.

Scene -> noiseless high-resolution image -> dithered noisy exposures -> drizzled Observation
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from engine.catalogue import load_dither
from engine.conventions import FloatArray, rate_to_magnitude
from engine.imaging.blurring import convolve, point_source_image
from engine.imaging.cusps import place_cusps
from engine.imaging.drizzled_psf import DrizzledPsf, drizzled_psf
from engine.imaging.drizzling import drizzle, drizzle_weights, drizzled_covariance
from engine.imaging.exposures import expose
from engine.imaging.geometry import Geometry, exposure_geometry
from engine.imaging.noise import ExposureNoise, draw_noise, exposure_noise
from engine.imaging.observation import Observation
from engine.imaging.psf import detector_kernel, telescope_psf
from engine.imaging.response import PointResponse
from engine.lensing.lens_equation import solve_lens_equation
from engine.light.rendering import render_sersic
from engine.scene import Scene
from engine.spec import NOMINAL_OPTICS, Camera, NoiseLevel, Optics

_PSF_REACH = 5.0
"""Half-width [arcsec] of the drizzled PSF stamp at most; beyond it lies less than 2 % of a star."""
_PSF_FIELD_SHARE = 0.75


@dataclass(frozen=True)
class Exposures:
    """Simulated exposures: noiseless and noisy rates (dithers, ny, nx) [e-/s per native pixel], and their noise."""

    noiseless: FloatArray
    noisy: FloatArray
    noise: ExposureNoise
    geometry: Geometry


@dataclass(frozen=True)
class Simulation:
    """A simulated observation with what made it, and the truth that only the simulation knows.

    ``arc`` is the noiseless drizzled image of the lensed host alone; ``arc_magnitude`` its total AB magnitude.
    """

    observation: Observation
    exposures: Exposures
    arc: FloatArray
    arc_magnitude: float


def scene_geometry(scene: Scene) -> Geometry:
    """Sampling of a scene's exposures and drizzled image."""
    plan = scene.system.exposures
    return exposure_geometry(scene.camera, load_dither(plan.dither), (plan.field_pixels, plan.field_pixels))


def optical_psf(camera: Camera, oversampling: int, optics: Optics = NOMINAL_OPTICS) -> FloatArray:
    """PSF of a camera on sub-pixels, computed once per process."""
    return telescope_psf(camera, oversampling=oversampling, defocus_nm=optics.defocus_nm, jitter=optics.jitter)


@lru_cache(maxsize=8)
def image_psf(camera: Camera, geometry: Geometry) -> DrizzledPsf:
    """PSF of the drizzled image of a camera and geometry, computed once per process."""
    field = geometry.drizzled_shape[0] * geometry.drizzled_scale
    radius = math.floor(min(_PSF_REACH, _PSF_FIELD_SHARE * field) / geometry.drizzled_scale)
    psf = optical_psf(camera, geometry.oversampling)
    return drizzled_psf(psf, geometry, detector_kernel(camera), radius)


def high_resolution_host(scene: Scene, geometry: Geometry) -> FloatArray:
    """The lensed host on the high-resolution grid before the PSF [e-/s per sub-pixel]."""
    x, y = geometry.high_resolution_axes()
    return render_sersic(scene.host, x, y, geometry.subpixel_scale, scene.lens)


def blurred_host(scene: Scene, geometry: Geometry, host: FloatArray) -> FloatArray:
    """The lensed host after the PSF, on the high-resolution grid."""
    images = solve_lens_equation(scene.lens, scene.host.x, scene.host.y)
    placed = place_cusps(host, scene.host, [(image.x, image.y) for image in images], geometry, scene.lens)
    return convolve(placed, optical_psf(scene.camera, geometry.oversampling, scene.optics))


def high_resolution_image(scene: Scene, geometry: Geometry, arc: FloatArray) -> FloatArray:
    """Blurred host (``arc``), deflector and AGN on the high-resolution grid; what the scene lacks is not computed."""
    psf = optical_psf(scene.camera, geometry.oversampling, scene.optics)
    image = arc
    if scene.deflector is not None:
        x, y = geometry.high_resolution_axes()
        light = render_sersic(scene.deflector, x, y, geometry.subpixel_scale)
        cusp = (scene.deflector.x, scene.deflector.y)
        image = image + convolve(place_cusps(light, scene.deflector, [cusp], geometry), psf)
    if scene.agn:
        positions = np.array([(source.x, source.y) for source in scene.agn])
        fluxes = np.array([source.flux for source in scene.agn])
        image = image + point_source_image(positions, fluxes, psf, geometry)
    return image


def simulate_exposures(
    scene: Scene, geometry: Geometry, image: FloatArray, noise_level: NoiseLevel, rng: np.random.Generator
) -> Exposures:
    """Dithered exposures of a high-resolution image, with noise drawn from ``rng``."""
    noiseless = expose(image, geometry, detector_kernel(scene.camera))
    noise = exposure_noise(noiseless, scene.camera, scene.system.exposures, noise_level)
    return Exposures(noiseless, noiseless + draw_noise(noise, rng), noise, geometry)


def combine(scene: Scene, exposures: Exposures) -> Observation:
    """Drizzle exposures into an observation with noise map, covariance and the camera's nominal PSF."""
    geometry = exposures.geometry
    covariance = drizzled_covariance(exposures.noise.variance, geometry)
    # A saturated native pixel spoils every drizzled pixel that it has a share in.
    spoilt = drizzle_weights(geometry) @ exposures.noise.saturated.ravel()
    return Observation(
        image=drizzle(exposures.noisy, geometry),
        noise=np.sqrt(covariance.diagonal()).reshape(geometry.drizzled_shape),
        psf=image_psf(scene.camera, geometry).psf,
        pixel_scale=geometry.drizzled_scale,
        zero_point=scene.camera.zero_point,
        covariance=covariance,
        valid=(spoilt == 0).reshape(geometry.drizzled_shape),
        provenance={
            "SYSTEM": scene.system.name,
            "CAMERA": scene.camera.name,
            "NOISE": exposures.noise.level,
            "DITHER": scene.system.exposures.dither,
            "PIXFRAC": geometry.pixfrac,
            "KERNEL": geometry.kernel,
            "DEFOCUS": scene.optics.defocus_nm,
            "JITTER": scene.optics.jitter,
        },
        response=PointResponse(
            optical_psf(scene.camera, geometry.oversampling), geometry, detector_kernel(scene.camera)
        ),
    )


def simulate(scene: Scene, noise_level: NoiseLevel, rng: np.random.Generator) -> Simulation:
    """The whole forward simulation of a scene."""
    geometry = scene_geometry(scene)
    host = high_resolution_host(scene, geometry)
    arc = blurred_host(scene, geometry, host)
    image = high_resolution_image(scene, geometry, arc)
    exposures = simulate_exposures(scene, geometry, image, noise_level, rng)
    return Simulation(
        observation=combine(scene, exposures),
        exposures=exposures,
        arc=drizzle(expose(arc, geometry, detector_kernel(scene.camera)), geometry),
        arc_magnitude=rate_to_magnitude(float(host.sum()), scene.camera.zero_point),
    )
