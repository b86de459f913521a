"""The traits of a lens that was measured in an image."""

from __future__ import annotations

import math

import numpy as np

from engine.biases import configuration_of
from engine.catalogue import camera_names, load_camera
from engine.conventions import rate_to_magnitude
from engine.errors import ObservationError
from engine.imaging.observation import Observation
from engine.measure import ImageMeasurement
from engine.prediction.traits import LensTraits, resolution_of
from engine.spec.instrument import Camera

_STAMP_WIDTH = 2.0 * math.sqrt(math.log(2.0) / (2.0 * math.pi))
"""FWHM of a Gaussian over the root of 1 / sum p^2, the area that its light fills."""
_WINGS = 1.55
"""That width of the catalogue's cameras over their :func:`~engine.prediction.traits.resolution_of`: 1.51 to 1.65, by
wings, pixels and drizzling."""


def traits_of_image(found: ImageMeasurement) -> LensTraits:
    """The traits of a measured lens: host, lens and AGN as they were found, resolution and depth of the observation.

    Raises
    ------
    ObservationError
        Too little of the image is empty for its depth to be known.
    """
    observation = found.observation
    light = sum(10.0 ** (-0.4 * image.magnitude) for image in found.agn)
    camera = _camera(observation)
    return LensTraits(
        camera="unknown" if camera is None else camera.name,
        resolution=_stamp_resolution(observation) if camera is None else resolution_of(camera),
        depth=_depth(found),
        configuration=configuration_of(len(found.agn)),
        arc_magnitude=found.arc_magnitude,
        magnitude=found.host.magnitude.mean,
        agn_contrast=-2.5 * math.log10(light) - found.arc_magnitude if light > 0 else None,
        theta_E=found.lens["theta_E"].mean,
        r_eff=found.host.r_eff.mean,
        n=found.host.n.mean,
        l_eta=found.lens["slope"].mean - 1.0,
    )


def _camera(observation: Observation) -> Camera | None:
    """That of the catalogue that the image says it was taken with."""
    name = observation.provenance.get("CAMERA")
    return load_camera(str(name)) if name in camera_names() else None


def _stamp_resolution(observation: Observation) -> float:
    """Width of the PSF's stamp [arcsec]: that of a Gaussian whose light fills as many pixels."""
    share = observation.psf / observation.psf.sum()
    return observation.pixel_scale * _STAMP_WIDTH / _WINGS / math.sqrt(float(np.sum(share**2)))


def _depth(found: ImageMeasurement) -> float:
    """AB magnitude of one sigma of empty sky in a square arcsec: where the noise is least."""
    observation = found.observation
    valid = observation.valid.ravel()
    if observation.covariance is None:
        variance = observation.noise.ravel() ** 2 * found.noise_scale**2
    else:
        # What a pixel shares with its neighbours counts in a sum over many of them.
        variance = np.asarray(observation.covariance.sum(axis=1)).ravel()
        inside = np.zeros(observation.shape, dtype=bool)
        inside[6:-6, 6:-6] = True
        valid = valid & inside.ravel()
    quiet = variance[valid & (variance > 0)]
    if quiet.size < 100:
        raise ObservationError(f"depth: got {quiet.size} pixels with a variance, allowed are 100 at least")
    pixel = math.sqrt(float(np.quantile(quiet, 0.05)))
    return rate_to_magnitude(pixel / observation.pixel_scale, observation.zero_point)
