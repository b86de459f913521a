"""Noise of the exposures: the paper's own levels and the instrument handbooks'."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.conventions import FloatArray
from engine.errors import ObservationError
from engine.spec import AuthorNoise, Camera, ExposurePlan, NoiseLevel


@dataclass(frozen=True, eq=False)
class ExposureNoise:
    """Noise of a set of exposures and how it came about.

    Attributes
    ----------
    variance
        Variance of the count rate, shape of the exposures, (e-/s)^2 per native pixel and dither position.
    requested, level
        The noise level that was asked for and the one that was used. They differ where the camera has no
        ``author`` level: then it is ``handbook``.
    short
        Pixels whose rate comes from the short exposure alone.
    saturated
        Pixels in which even the short exposure is beyond full well. Their variance is that of an unbounded
        detector.
    """

    variance: FloatArray
    requested: NoiseLevel
    level: NoiseLevel
    short: NDArray[np.bool_]
    saturated: NDArray[np.bool_]


def exposure_variance(
    noiseless: FloatArray, camera: Camera, plan: ExposurePlan, level: NoiseLevel = "author"
) -> ExposureNoise:
    """Noise variance of each native pixel at each dither position.

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

    Returns
    -------
    ExposureNoise with the variance [(e-/s)^2].
    """
    if not np.isfinite(noiseless).all():
        raise ObservationError("noiseless exposures: not finite everywhere")
    rate = np.maximum(noiseless, 0.0)
    saturated = (rate + camera.sky_e_s + camera.dark_e_s) * plan.short_s > camera.full_well_e
    if level == "author" and camera.noise_author is not None:
        short = rate > camera.noise_author.bright_threshold_e_s
        variance = np.where(
            short,
            _author_short(rate, camera.noise_author, plan),
            _author_long(rate, camera.noise_author, plan),
        )
        return ExposureNoise(variance, level, "author", short, saturated)
    background = camera.sky_e_s + camera.dark_e_s
    short = (rate + background) * plan.long_s > camera.full_well_e
    # Counts of one exposure have variance (rate + sky + dark) t + read noise^2; the rate is their mean over
    # n, over t.
    long_variance = ((rate + background) * plan.long_s + camera.read_noise_e**2) / (plan.n_long * plan.long_s**2)
    short_variance = ((rate + background) * plan.short_s + camera.read_noise_short_e**2) / plan.short_s**2
    return ExposureNoise(np.where(short, short_variance, long_variance), level, "handbook", short, saturated)


def _author_long(rate: FloatArray, noise: AuthorNoise, plan: ExposurePlan) -> FloatArray:
    """Faint pixels in the paper's script (gl_pipe, addnois): all exposures share the Poisson noise.

    There, for two long exposures of 599 s: rate / (2 * 599 + short) + (short / (2 * 599))^2 * 0.265^2
    + 2 * 0.016^2 / 4; here for any number and length of them. The levels are per exposure and are not scaled
    with its length, as in the script.
    """
    long_s = plan.n_long * plan.long_s
    poisson = rate / (long_s + plan.short_s)
    background = (plan.short_s / long_s * noise.std_short_e_s) ** 2 + noise.std_long_e_s**2 / plan.n_long
    return np.asarray(poisson + background)


def _author_short(rate: FloatArray, noise: AuthorNoise, plan: ExposurePlan) -> FloatArray:
    """Bright pixels in the paper's script: the short exposure alone."""
    return np.asarray(rate / plan.short_s + noise.std_short_e_s**2)


def draw_noise(variance: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Noise with the given variance, one independent normal deviate for each pixel.

    Gaussian, as in the paper's scripts: a pixel has at least some hundred electrons of background and read
    noise in a dither position, and the noise map handed to the inversion is then exactly the square root of
    ``variance``.
    """
    if not np.isfinite(variance).all() or (variance < 0).any():
        raise ObservationError("variance: got negative or non-finite values, allowed is zero or more")
    return np.asarray(rng.standard_normal(variance.shape) * np.sqrt(variance))
