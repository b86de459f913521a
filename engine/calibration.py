"""A measurement calibrated by simulations like the image: its own lens, light, PSF, noise, and hosts that it allows.

Each simulation is measured as the image was, with the PSF that was given for it, seen through the one that its AGN
images ask for. The mean departure from the truth is taken off the answer, and its interval grows where the
departures scatter by more than their errors.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import cholesky_banded
from scipy.stats import t

from engine.conventions import FloatArray, rate_to_magnitude
from engine.errors import EngineError, SpecError
from engine.imaging.observation import Observation
from engine.light.sersic import SersicProfile, profile_of
from engine.measure import ImageMeasurement, measure_image
from engine.result import Quantity
from engine.stages import Progress

LEAST, MOST = 6, 1000
"""How many simulations there may be."""
_NORMAL_95 = 1.959963985
_TRIES = 1000
"""Draws of a host for one inside the bounds of the fit."""


@dataclass(frozen=True)
class Calibrated:
    """A quantity of the host, corrected.

    ``bias`` is the mean of measured less true in the simulations, with its error, ``pull_sd`` the scatter of that in
    units of the errors that each measurement gave; of a radius both are of its logarithm. ``covered95`` is how many
    simulations have their truth inside the interval, calibrated by the others.
    """

    measured: Quantity
    corrected: Quantity
    bias: float
    bias_error: float
    pull_sd: float
    covered95: int


@dataclass(frozen=True)
class Calibration:
    """The host's ``quantities`` by name, of ``simulations`` that were measured; ``failed`` says why others were not."""

    simulations: int
    failed: dict[str, int]
    quantities: dict[str, Calibrated]
    seed: int

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready form."""
        quantities = {
            name: {
                **asdict(found),
                "measured": _document(found.measured),
                "corrected": _document(found.corrected),
            }
            for name, found in self.quantities.items()
        }
        return {"simulations": self.simulations, "failed": self.failed, "seed": self.seed, "quantities": quantities}


def calibrate(
    found: ImageMeasurement, simulations: int = 16, seed: int = 0, progress: Progress | None = None
) -> Calibration:
    """Simulate images like that of a measurement, measure them, and correct the measurement by what comes out.

    Parameters
    ----------
    found : ImageMeasurement
        With the status ``ok`` or ``poor_fit``: of a host that is not there, or that a prior decides, there is nothing
        to simulate.
    simulations : int
        How many; each takes a fit of the image.
    seed : int
        Of hosts and noise.
    progress : callable, optional
        Told ``calibration`` and the part of the simulations that is done.

    Raises
    ------
    SpecError
        There is nothing to calibrate, or not that many simulations may be made.
    EngineError
        Fewer than :data:`LEAST` simulations could be measured.
    """
    if not LEAST <= simulations <= MOST:
        raise SpecError("calibrate", simulations, f"a number from {LEAST} to {MOST}")
    if found.status not in ("ok", "poor_fit"):
        raise SpecError("calibrate", found.status, "a host that is measured, with the status ok or poor_fit")
    pairs: list[tuple[ImageMeasurement, SersicProfile]] = []
    failed: Counter[str] = Counter()
    for k, sequence in enumerate(np.random.SeedSequence(seed).spawn(simulations)):
        host = _host_like(found, np.random.default_rng(sequence.spawn(1)[0]))
        image = _image_with(found, host, np.random.default_rng(sequence))
        try:
            again = measure_image(replace(found.observation, image=image), **_how(found))
            if again.status in ("not_detected", "prior_dominated"):
                failed[again.status] += 1
            else:
                pairs.append((again, host))
        except EngineError as error:
            failed[str(error)[:120]] += 1
        if progress is not None:
            progress("calibration", (k + 1) / simulations)
    if len(pairs) < LEAST:
        raise EngineError(f"calibrate: {len(pairs)} of {simulations} simulations could be measured, {LEAST} are needed")
    zero_point = found.observation.zero_point
    quantities = {
        "magnitude": _calibrated(
            found.host.magnitude, [(m.host.magnitude, rate_to_magnitude(true.flux, zero_point)) for m, true in pairs]
        ),
        "radius": _calibrated(found.host.r_eff, [(m.host.r_eff, true.r_eff) for m, true in pairs]),
        "n": _calibrated(found.host.n, [(m.host.n, true.n) for m, true in pairs]),
    }
    return Calibration(len(pairs), dict(failed), quantities, seed)


def _how(found: ImageMeasurement) -> dict[str, Any]:
    """What the image was measured with, and what was found in it: searches are not what is calibrated."""
    fit = found.fit
    return {
        "profile": found.profile,
        "agn_images": len(fit.agn),
        "positions": [(image.x, image.y) for image in fit.agn] or None,
        "deflector": fit.deflector is not None or bool(fit.deflector_gaussians),
        "shear": "gamma1" in fit.lens_names,
        "theta_E": fit.lens.theta_E,
        "centre": (fit.lens.x, fit.lens.y),
        "inversion": False,
        "trust_options": True,
    }


def _host_like(found: ImageMeasurement, rng: np.random.Generator) -> SersicProfile:
    """A host that the image allows: a draw of its posterior inside the bounds."""
    posterior = found.fit.hosts["wide"].inflated(max(1.0, found.noise_scale))
    for _ in range(_TRIES):
        drawn = rng.multivariate_normal(posterior.mean, posterior.covariance)
        if np.all((posterior.low <= drawn) & (drawn <= posterior.high)):
            return profile_of(drawn[1:], math.exp(drawn[0]))
    return posterior.profile


def _image_with(found: ImageMeasurement, host: SersicProfile, rng: np.random.Generator) -> FloatArray:
    """The image (ny, nx) with another host, and what the old one departs from its profile by, in noise of its own."""
    fit, observation = found.fit, found.observation
    seen = fit.seen_through(observation).optics
    departs = fit.arc - seen.sersic_image(fit.host, fit.lens)
    arc = seen.sersic_image(host, fit.lens) + host.flux / fit.host.flux * departs
    return fit.model - fit.arc + arc + found.noise_scale * _noise(observation, rng)


def _noise(observation: Observation, rng: np.random.Generator) -> FloatArray:
    """A draw (ny, nx) of the noise, with its covariance where that is known."""
    drawn = rng.standard_normal(observation.image.size)
    if observation.covariance is None:
        return np.where(observation.valid, observation.noise, 0.0) * drawn.reshape(observation.shape)
    entries = observation.covariance.tocoo()
    below = entries.row >= entries.col
    offset = entries.row[below] - entries.col[below]
    banded = np.zeros((int(offset.max()) + 1, drawn.size))
    banded[offset, entries.col[below]] = entries.data[below]
    # A pixel that may not be used has no variance; any will do.
    banded[0][banded[0] <= 0.0] = 1.0
    factor = cholesky_banded(banded, lower=True)
    out = np.zeros_like(drawn)
    for k, diagonal in enumerate(factor):
        out[k:] += diagonal[: drawn.size - k] * drawn[: drawn.size - k]
    return out.reshape(observation.shape)


def _calibrated(measured: Quantity, pairs: Sequence[tuple[Quantity, float]]) -> Calibrated:
    departures = np.array([_scaled(one)[0] - (math.log(true) if one.log_normal else true) for one, true in pairs])
    errors = np.array([_scaled(one)[1] for one, _ in pairs])
    bias, bias_error, pull_sd = _statistics(departures, errors)
    covered = 0
    for k in range(len(pairs)):
        others = np.arange(len(pairs)) != k
        shift, shift_error, pull = _statistics(departures[others], errors[others])
        reach = _NORMAL_95 * _widened(errors[k], shift_error, pull, len(pairs) - 1)
        covered += bool(abs(departures[k] - shift) <= reach)
    middle, sd = _scaled(measured)
    corrected = middle - bias, _widened(sd, bias_error, pull_sd, len(pairs))
    return Calibrated(measured, _unscaled(*corrected, measured), bias, bias_error, pull_sd, covered)


def _statistics(departures: FloatArray, errors: FloatArray) -> tuple[float, float, float]:
    """Mean departure, its error, and the scatter about it in units of the errors."""
    count, bias = departures.size, float(departures.mean())
    scatter = departures - bias
    pull = math.sqrt(float(np.sum((scatter / errors) ** 2)) / (count - 1))
    return bias, float(departures.std(ddof=1)) / math.sqrt(count), pull


def _widened(sd: float, bias_error: float, pull_sd: float, count: int) -> float:
    """Standard deviation with which 1.96 of them hold 95 %, scatter and bias known from ``count`` simulations.

    Never smaller than what was measured: the image may be unlike its simulations.
    """
    few = float(t.ppf(0.975, count - 1)) / _NORMAL_95
    return max(sd, few * math.hypot(max(1.0, pull_sd) * sd, bias_error))


def _scaled(value: Quantity) -> tuple[float, float]:
    """Mean and standard deviation, of the logarithm where that is normal."""
    if not value.log_normal:
        return value.mean, value.sd
    variance = math.log1p((value.sd / value.mean) ** 2)
    return math.log(value.mean) - 0.5 * variance, math.sqrt(variance)


def _unscaled(mean: float, sd: float, like: Quantity) -> Quantity:
    if not like.log_normal:
        return replace(like, mean=mean, sd=sd)
    middle = math.exp(mean + 0.5 * sd**2)
    return replace(like, mean=middle, sd=middle * math.sqrt(math.expm1(sd**2)))


def _document(value: Quantity) -> dict[str, Any]:
    return {"mean": value.mean, "sd": value.sd, "interval95": list(value.interval95)}
