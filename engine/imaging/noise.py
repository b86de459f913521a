"""Noise of the exposures: the paper's own levels and the instrument handbooks'."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.conventions import FloatArray
from engine.errors import ObservationError
from engine.spec.instrument import AuthorNoise, Camera, ExposurePlan, NoiseLevel


@dataclass(frozen=True, eq=False)
class ExposureNoise:
    """Noise of a set of exposures and how it came about; arrays have the shape of the exposures.

    Attributes
    ----------
    requested, level
        The noise level that was asked for and the one that was used. They differ where the camera has no
        ``author`` level: then it is ``handbook``.
    photon_rate
        Electrons per second that arrive one by one (sources; sky and dark current too where the level tells them
        apart from the detector's noise).
    seconds
        Exposure time over which they are counted.
    gaussian_variance
        Variance of all other noise, (e-/s)^2.
    short
        Pixels whose rate comes from the short exposure alone.
    saturated
        Pixels in which even the short exposure is beyond full well. Their variance is that of an unbounded
        detector.
    """

    requested: NoiseLevel
    level: NoiseLevel
    photon_rate: FloatArray
    seconds: FloatArray
    gaussian_variance: FloatArray
    short: NDArray[np.bool_]
    saturated: NDArray[np.bool_]

    @property
    def variance(self) -> FloatArray:
        """Variance of the count rate, (e-/s)^2 per native pixel and dither position."""
        return self.photon_rate / self.seconds + self.gaussian_variance


def exposure_noise(
    noiseless: FloatArray, camera: Camera, plan: ExposurePlan, level: NoiseLevel = "author"
) -> ExposureNoise:
    """Noise of each native pixel at each dither position.

    Parameters
    ----------
    noiseless
        Noiseless exposures of the sources [e-/s per native pixel], any shape; negative rates (ringing of the
        PSF's cut at the 1e-6 level) count as zero.
    camera
        Noise levels per native pixel.
    plan
        ``n_long`` exposures of ``long_s`` and one of ``short_s`` at each dither position.
    level
        ``author`` or ``handbook``; ``author`` falls back on ``handbook`` for a camera without it, and the
        result says so.
    """
    if not np.isfinite(noiseless).all():
        raise ObservationError("noiseless exposures: not finite everywhere")
    rate = np.maximum(noiseless, 0.0)
    background = camera.sky_e_s + camera.dark_e_s
    saturated = (rate + background) * plan.short_s > camera.full_well_e
    author = camera.noise_author if level == "author" else None
    if author is not None:
        short = rate > author.bright_threshold_e_s
        photons, seconds, gaussian = rate, *_author(short, author, plan)
    else:
        short = (rate + background) * plan.long_s > camera.full_well_e
        photons, seconds, gaussian = rate + background, *_handbook(short, camera, plan)
    return ExposureNoise(
        level, "handbook" if author is None else "author", photons, seconds, gaussian, short, saturated
    )


def _handbook(short: NDArray[np.bool_], camera: Camera, plan: ExposurePlan) -> tuple[FloatArray, FloatArray]:
    """Seconds and Gaussian variance: read noise once in every exposure that is used; the long ones, or the short."""
    seconds = np.where(short, plan.short_s, plan.n_long * plan.long_s)
    electrons = np.where(short, camera.read_noise_short_e**2, plan.n_long * camera.read_noise_e**2)
    return seconds, electrons / seconds**2


def _author(short: NDArray[np.bool_], noise: AuthorNoise, plan: ExposurePlan) -> tuple[FloatArray, FloatArray]:
    """Seconds and Gaussian variance in the paper's script (gl_pipe, addnois).

    There, for two long exposures of 599 s, faint pixels have rate / (2 * 599 + short) + (short / (2 * 599))^2 *
    0.265^2 + 2 * 0.016^2 / 4, here for any number and length of them; bright ones are taken from the short exposure
    alone. The background levels are per exposure and are not scaled with its length, as in the script.
    """
    long_s = plan.n_long * plan.long_s
    faint = (plan.short_s / long_s * noise.std_short_e_s) ** 2 + noise.std_long_e_s**2 / plan.n_long
    seconds = np.where(short, plan.short_s, long_s + plan.short_s)
    return seconds, np.where(short, noise.std_short_e_s**2, faint)


def draw_noise(noise: ExposureNoise, rng: np.random.Generator) -> FloatArray:
    """Noise [e-/s] of exposures: photons counted one by one, the rest normal; its variance is ``noise.variance``."""
    expected = noise.photon_rate * noise.seconds
    if not (np.isfinite(expected).all() and np.isfinite(noise.gaussian_variance).all()):
        raise ObservationError("noise: got photon counts or variances that are not finite")
    if (expected < 0).any() or (noise.gaussian_variance < 0).any():
        raise ObservationError("noise: got negative photon counts or variances, allowed is zero or more")
    counted = (rng.poisson(expected) - expected) / noise.seconds
    return np.asarray(counted + rng.standard_normal(expected.shape) * np.sqrt(noise.gaussian_variance))
