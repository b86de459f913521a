"""The forward simulation: from a scene to a drizzled observation, each step a function of its own.

Scene -> noiseless high-resolution image -> dithered noisy exposures -> drizzled Observation
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from threadpoolctl import threadpool_limits

from engine.catalogue import resolve_dither
from engine.conventions import FloatArray, position_angle, rate_to_magnitude
from engine.digest import engine_digest, engine_versions
from engine.imaging.convolution import convolve, point_source_image
from engine.imaging.cusps import cusp_positions, place_cusps
from engine.imaging.drizzled_psf import drizzled_psf
from engine.imaging.drizzling import drizzle, drizzle_weights, drizzled_covariance
from engine.imaging.exposures import expose
from engine.imaging.geometry import Geometry, exposure_geometry
from engine.imaging.noise import ExposureNoise, draw_noise, exposure_noise
from engine.imaging.observation import Observation, Provenance
from engine.imaging.optics.exposed import ExposedOptics
from engine.imaging.psf import detector_kernel
from engine.imaging.telescope import known_psf, optical_psf
from engine.light.galaxy import profiles_of, render_light
from engine.simulation.scene import Scene, build_scene
from engine.simulation.seeds import sky_generator
from engine.spec.deflector import USUAL_DEFLECTOR
from engine.spec.instrument import Camera, NoiseLevel
from engine.spec.realization import Realization

_PSF_REACH = 5.0
"""Half-width [arcsec] of the drizzled PSF stamp at most; beyond it lies less than 2 % of a star."""
_PSF_FIELD_SHARE = 0.75
_SIMULATION = 0
"""The purpose of the random generator that draws the noise."""


@dataclass(frozen=True)
class Exposures:
    """Simulated exposures: noiseless and noisy rates (dithers, ny, nx) [e-/s per native pixel], and their noise."""

    noiseless: FloatArray
    noisy: FloatArray
    noise: ExposureNoise
    geometry: Geometry


@dataclass(frozen=True)
class Simulation:
    """A simulated observation with every step on the way to it, and the truth that only the simulation knows.

    ``high_resolution_arc`` is the lensed host before the PSF and ``high_resolution_image`` everything after it, both
    without noise [e-/s per sub-pixel]; ``arc`` is the noiseless drizzled image of the lensed host alone;
    ``arc_magnitude`` its total AB magnitude.
    """

    scene: Scene
    high_resolution_arc: FloatArray
    high_resolution_image: FloatArray
    exposures: Exposures
    observation: Observation
    arc: FloatArray
    arc_magnitude: float


def scene_geometry(scene: Scene) -> Geometry:
    """Sampling of a scene's exposures and drizzled image."""
    side = scene.system.exposures.field_pixels
    return exposure_geometry(scene.camera, resolve_dither(scene.system), (side, side))


@lru_cache(maxsize=8)
def image_psf(camera: Camera, geometry: Geometry, coarse: int = 1) -> FloatArray:
    """PSF of the drizzled image of a camera and geometry as it is :func:`known <known_psf>`, once per process."""
    field = geometry.drizzled_shape[0] * geometry.drizzled_scale
    radius = math.floor(min(_PSF_REACH, _PSF_FIELD_SHARE * field) / geometry.drizzled_scale)
    psf = known_psf(camera, geometry.oversampling, coarse)
    return drizzled_psf(psf, geometry, detector_kernel(camera), radius)


def high_resolution_host(scene: Scene, geometry: Geometry) -> FloatArray:
    """The lensed host on the high-resolution grid before the PSF [e-/s per sub-pixel]."""
    x, y = geometry.high_resolution_axes()
    return render_light(scene.host, x, y, geometry.subpixel_scale, scene.lens)


def blurred_host(scene: Scene, geometry: Geometry, host: FloatArray) -> FloatArray:
    """The lensed host after the PSF, on the high-resolution grid."""
    placed = host
    for profile in profiles_of(scene.host):
        placed = place_cusps(placed, profile, cusp_positions(profile, scene.lens, geometry), geometry, scene.lens)
    return convolve(placed, optical_psf(scene.camera, geometry.oversampling, scene.optics))


def high_resolution_image(scene: Scene, geometry: Geometry, arc: FloatArray) -> FloatArray:
    """Blurred host (``arc``), deflector and AGN on the high-resolution grid; what the scene lacks is not computed."""
    psf = optical_psf(scene.camera, geometry.oversampling, scene.optics)
    image = arc
    for profile in () if scene.deflector is None else (scene.deflector, *scene.deflector_more):
        x, y = geometry.high_resolution_axes()
        light = render_light(profile, x, y, geometry.subpixel_scale)
        cusps = cusp_positions(profile, None, geometry)
        image = image + convolve(place_cusps(light, profile, cusps, geometry), psf)
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


def combine(scene: Scene, exposures: Exposures, provenance: Provenance | None = None) -> Observation:
    """Drizzle exposures into an observation with noise map, covariance and the camera's nominal PSF.

    ``provenance`` is added to the observation's own.
    """
    geometry = exposures.geometry
    covariance = drizzled_covariance(exposures.noise.variance, geometry)
    # A saturated native pixel spoils every drizzled pixel that it has a share in.
    spoilt = drizzle_weights(geometry) @ exposures.noise.saturated.ravel()
    return Observation(
        image=drizzle(exposures.noisy, geometry),
        noise=np.sqrt(covariance.diagonal()).reshape(geometry.drizzled_shape),
        psf=image_psf(scene.camera, geometry, scene.optics.coarse),
        pixel_scale=geometry.drizzled_scale,
        zero_point=scene.camera.zero_point,
        covariance=covariance,
        valid=(spoilt == 0).reshape(geometry.drizzled_shape),
        provenance={**_exposure_record(scene, exposures), **(provenance or {})},
        centre=scene.system.coordinates,
        response=ExposedOptics(
            known_psf(scene.camera, geometry.oversampling, scene.optics.coarse),
            geometry,
            detector_kernel(scene.camera),
            camera=scene.camera,
        ),
    )


def _exposure_record(scene: Scene, exposures: Exposures) -> dict[str, str | float | int]:
    """How an observation was taken, as its provenance has it."""
    geometry, plan, noise = exposures.geometry, scene.system.exposures, exposures.noise
    return {
        "SYSTEM": scene.system.name,
        "CAMERA": scene.camera.name,
        "NOISE": noise.level,
        "NOISEREQ": noise.requested,
        "DITHER": resolve_dither(scene.system).name,
        "N_DITHER": geometry.n_dither,
        "N_LONG": plan.n_long,
        "LONG_S": plan.long_s,
        "SHORT_S": plan.short_s,
        "EXPTIME": geometry.n_dither * (plan.n_long * plan.long_s + plan.short_s),
        "PIXFRAC": geometry.pixfrac,
        "KERNEL": geometry.kernel,
        "N_SHORT": int(np.count_nonzero(noise.short)),
        "N_SATUR": int(np.count_nonzero(noise.saturated)),
        "DEFOCUS": scene.optics.defocus_nm,
        "JITTER": scene.optics.jitter,
        "COLOUR": scene.optics.colour,
        "RESIDUAL": scene.optics.residual,
        "RES_SEED": scene.optics.residual_seed,
        "COARSE": scene.optics.coarse,
    }


def simulate(
    scene: Scene, noise_level: NoiseLevel, rng: np.random.Generator, provenance: Provenance | None = None
) -> Simulation:
    """The whole forward simulation of a scene."""
    geometry = scene_geometry(scene)
    host = high_resolution_host(scene, geometry)
    arc = blurred_host(scene, geometry, host)
    image = high_resolution_image(scene, geometry, arc)
    exposures = simulate_exposures(scene, geometry, image, noise_level, rng)
    return Simulation(
        scene=scene,
        high_resolution_arc=host,
        high_resolution_image=image,
        exposures=exposures,
        observation=combine(scene, exposures, provenance),
        arc=drizzle(expose(arc, geometry, detector_kernel(scene.camera)), geometry),
        arc_magnitude=rate_to_magnitude(float(host.sum()), scene.camera.zero_point),
    )


def simulate_realization(realization: Realization) -> Simulation:
    """The forward simulation that a run of this realization starts with: same realization, same bits.

    The provenance of the observation holds the whole specification, its digest, the digest of the engine and the
    versions of what its numbers depend on.

    Raises
    ------
    SpecError
        The realization asks for something that is not there.
    """
    scene = build_scene(realization)
    # One thread: sums in a fixed order give the same bits everywhere.
    with threadpool_limits(1):
        return simulate(
            scene,
            realization.noise_level,
            sky_generator(realization, _SIMULATION),
            realization_record(scene, realization),
        )


def realization_record(scene: Scene, realization: Realization) -> dict[str, str | float | int]:
    """What was asked for and by what it was computed, as the provenance of an observation has it."""
    host, deflector = scene.host, realization.deflector
    return {
        "MASSMOD": realization.mass_model,
        "L_ETA": realization.l_eta,
        "HOST_MAG": realization.host.magnitude,
        "HOST_RE": host.r_eff,
        **({} if host.n is None else {"HOST_N": host.n}),
        "HOST": realization.host.label,
        "DEFLECT": USUAL_DEFLECTOR if deflector is None else deflector.label,
        "HOST_Q": host.q,
        "HOST_PA": position_angle(host.phi),
        "SEED": realization.seed,
        "SPECDIG": realization.digest,
        "ENGDIG": engine_digest(),
        "VERSIONS": json.dumps(engine_versions(), sort_keys=True),
        "SPEC": json.dumps(realization.to_dict(), sort_keys=True, separators=(",", ":")),
    }
