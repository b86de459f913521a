"""From an observation that anybody made to the host galaxy: the parametric fit, the inversion, and one answer.

Nothing of the truth is known here. The lens and the AGN images are found by
:func:`~engine.parametric.fit.fit_parametric`; :func:`~engine.run.measure` then samples the inversion from there.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from threadpoolctl import threadpool_limits

from engine.conventions import FloatArray, position_angle, rate_to_magnitude
from engine.digest import engine_digest, engine_versions
from engine.errors import InversionError, ObservationError, PosteriorError, SpecError
from engine.imaging.observation import Observation
from engine.parametric.fit import HOST_NAMES, ParametricFit, fit_parametric
from engine.parametric.residual_noise import noise_scale
from engine.parametric.search import Acceptance
from engine.result import Estimate, LensParameter
from engine.run import Measurement, measure
from engine.spec.analysis import PROFILES, Analysis

MeasurementStatus = Literal["ok", "poor_fit"]
POOR_FIT = 1.5
"""chi^2 per degree of freedom from which on the status says that the model does not describe the image."""
_ANY_LENS = Acceptance(chi2_per_dof=300.0, miss=0.3)
"""What is shown with the status ``poor_fit`` rather than refused: no model of a real lens is perfect."""
_NORMAL_95 = 1.959963985
_NOISE_AGREES = 0.1
_WRONG_STAMP = 2.0
"""Error of the PSF's stamp, in units of what is allowed for, from which on the result says so."""


def profile_analysis(profile: str, observation: Observation) -> Analysis:
    """The analysis that a profile stands for; a SpecError names the profiles that there are.

    Without a covariance of the pixels the noise is taken for independent.
    """
    if profile not in PROFILES:
        raise SpecError("profile", profile, f"one of {', '.join(PROFILES)}")
    if observation.covariance is None:
        return Analysis(profile=profile, noise_treatment="diagonal")  # type: ignore[arg-type]  # checked above
    return Analysis(profile=profile)  # type: ignore[arg-type]  # checked above


@dataclass(frozen=True)
class Measured:
    """A quantity: mean, standard deviation, and the interval that holds it with 95 %."""

    mean: float
    sd: float
    interval95: tuple[float, float]


@dataclass(frozen=True)
class HostEstimate:
    """One estimator's host: AB magnitude, half-light radius [arcsec, intermediate axis], index, q, PA [deg E of N]."""

    estimator: str
    magnitude: Measured
    radius: Measured
    n: Measured
    q: Measured
    position_angle: Measured


@dataclass(frozen=True)
class AgnPosition:
    """An AGN image: position [arcsec, image frame: x with the columns, from the middle of the image] and magnitude."""

    x: float
    y: float
    magnitude: float


@dataclass(frozen=True)
class ImageMeasurement:
    """What is found in one image.

    ``host`` is the parametric fit's, the first of ``estimates``; ``lens`` belongs to it. ``chi2_per_dof`` is that of
    the parametric model with the noise map times ``noise_scale``, the scatter of the residuals outside the lens in
    units of the map: a drizzled image has less noise in a pixel than its map says where the map allows for what
    neighbours share. ``chi2_per_dof_as_given`` takes the map as it is. ``status`` is ``poor_fit`` where chi2_per_dof
    exceeds :data:`POOR_FIT`. ``inversion`` is None where none was asked for, or where it failed, which ``warnings``
    then say.
    """

    host: HostEstimate
    estimates: tuple[HostEstimate, ...]
    lens: dict[str, Measured]
    lens_by_inversion: dict[str, Measured] | None
    agn: tuple[AgnPosition, ...]
    arc_magnitude: float
    chi2_per_dof: float
    chi2_per_dof_as_given: float
    noise_scale: float
    degrees_of_freedom: int
    status: MeasurementStatus
    profile: str
    seed: int
    seconds: float
    warnings: tuple[str, ...]
    versions: dict[str, str]
    engine_digest: str
    provenance: dict[str, str | float | int]
    observation: Observation
    fit: ParametricFit
    inversion: Measurement | None

    @property
    def estimator(self) -> str:
        """Name of the estimator whose answer ``host`` is."""
        return self.host.estimator

    @property
    def inversion_chi2_per_dof(self) -> float | None:
        """Of the inversion, with the noise of ``chi2_per_dof`` where the exposures are not known; None without one."""
        if self.inversion is None:
            return None
        chi2 = self.inversion.chi2
        if self.observation.optics.misfit_is_noise:
            # The inversion takes what the fit misses for noise, which must not make the two incomparable.
            residual = self.inversion.products.residual * self.observation.noise
            chi2 = _chi2(self.observation, self.fit, residual, self.noise_scale)
        return chi2 / self.inversion.degrees_of_freedom

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready form, without the arrays."""
        fit, chain = self.fit, None if self.inversion is None else self.inversion.chain.summary
        return {
            "status": self.status,
            "estimator": self.estimator,
            "host": asdict(self.host),
            "lens": {name: asdict(value) for name, value in self.lens.items()},
            "chi2_per_dof": self.chi2_per_dof,
            "chi2_per_dof_as_given": self.chi2_per_dof_as_given,
            "noise_scale": self.noise_scale,
            "degrees_of_freedom": self.degrees_of_freedom,
            "estimates": [asdict(estimate) for estimate in self.estimates],
            "lens_by_inversion": (
                None
                if self.lens_by_inversion is None
                else {name: asdict(value) for name, value in self.lens_by_inversion.items()}
            ),
            "chain": None if chain is None else asdict(chain),
            "inversion_chi2_per_dof": self.inversion_chi2_per_dof,
            "stamp_error": fit.stamp_error,
            "agn": [asdict(image) for image in self.agn],
            "arc_magnitude": self.arc_magnitude,
            "deflector": None if fit.deflector is None else asdict(fit.deflector),
            "background": fit.background,
            "profile": self.profile,
            "seed": self.seed,
            "seconds": self.seconds,
            "warnings": list(self.warnings),
            "versions": self.versions,
            "engine_digest": self.engine_digest,
            "provenance": self.provenance,
        }


def measured(mean: float, sd: float) -> Measured:
    """A quantity with a normal distribution."""
    return Measured(mean, sd, (mean - _NORMAL_95 * sd, mean + _NORMAL_95 * sd))


def _chi2(observation: Observation, fit: ParametricFit, residual: FloatArray, scale: float) -> float:
    """chi^2 of residuals (ny, nx) with the noise map times ``scale`` and the error of the AGN's light as it is."""
    used = np.isfinite(fit.sigma)
    variance = fit.sigma[used] ** 2 + (scale**2 - 1.0) * observation.noise[used] ** 2
    return float(np.sum(residual[used] ** 2 / variance))


def _parametric_estimate(fit: ParametricFit, zero_point: float, inflation: float) -> HostEstimate:
    """The parametric host with the errors of its Gaussian approximation, everything else free."""
    sd = dict(zip(HOST_NAMES, inflation * np.sqrt(np.diag(fit.host_covariance)), strict=True))
    host = fit.host
    magnitude = rate_to_magnitude(host.flux, zero_point)
    # Magnitude and radius are normal in the logarithm: an interval of a radius does not reach below zero.
    spread = float(sd["r_eff"]) / host.r_eff
    low, high = (host.r_eff * math.exp(sign * _NORMAL_95 * spread) for sign in (-1.0, 1.0))
    return HostEstimate(
        "parametric",
        measured(magnitude, 2.5 / math.log(10.0) * float(sd["flux"]) / host.flux),
        Measured(host.r_eff, float(sd["r_eff"]), (low, high)),
        measured(host.n, float(sd["n"])),
        measured(host.q, float(sd["q"])),
        measured(position_angle(host.phi), math.degrees(float(sd["phi"]))),
    )


def _host_estimate(found: Estimate) -> HostEstimate:
    return HostEstimate(
        found.estimator,
        *(
            measured(quantity.mean, quantity.sd)
            for quantity in (found.magnitude, found.r_eff, found.n, found.q, found.position_angle)
        ),
    )


def _lens_of_chain(parameters: Sequence[LensParameter]) -> dict[str, Measured]:
    return {found.name: measured(found.value.mean, found.value.sd) for found in parameters}


def _lens_of_fit(fit: ParametricFit, inflation: float) -> dict[str, Measured]:
    sd = inflation * np.sqrt(np.diag(fit.lens_covariance))
    return {
        name: measured(float(getattr(fit.lens, name)), float(error))
        for name, error in zip(fit.lens_names, sd, strict=True)
    }


def measure_image(
    observation: Observation,
    *,
    profile: str = "standard",
    agn_images: int | None = None,
    deflector: bool = True,
    shear: bool | None = None,
    theta_E: float | None = None,
    positions: Sequence[tuple[float, float]] | None = None,
    seed: int = 0,
    inversion: bool = True,
    progress: Callable[[str], None] | None = None,
) -> ImageMeasurement:
    """Measure the host galaxy in an observation.

    Parameters
    ----------
    observation : Observation
        Of any origin; see :func:`~engine.imaging.external_files.read_external_observation`.
    profile : str
        How the inversion is sampled: one of :data:`PROFILES`.
    agn_images : int, optional
        How many AGN images there are; found where None.
    deflector : bool
        Whether the deflector shines.
    shear : bool, optional
        Whether the lens has external shear; decided by the data where None.
    theta_E, positions
        A rough Einstein radius [arcsec]; rough AGN positions [arcsec, image frame].
    seed : int
        For the chain.
    inversion : bool
        Whether to sample the inversion as well; the parametric fit alone takes seconds.
    progress : callable, optional
        Told the name of each stage as it begins.

    Raises
    ------
    SpecError, ObservationError
        What was given cannot be used.
    PosteriorError
        No lens model fits.
    """
    began = time.perf_counter()
    analysis = profile_analysis(profile, observation)
    if not 0 <= seed < 2**63:
        raise SpecError("seed", seed, "a whole number from 0 to 2^63 - 1")
    warnings: list[str] = []
    found: Measurement | None = None
    tell = progress or (lambda _: None)
    with threadpool_limits(1):
        tell("parametric fit")
        fit = fit_parametric(
            observation, agn_images=agn_images, deflector=deflector, shear=shear, theta_E=theta_E, positions=positions,
            acceptance=_ANY_LENS,
        )  # fmt: skip
        if inversion:
            tell("inversion")
            try:
                found = measure(
                    observation,
                    analysis,
                    np.random.default_rng(seed),
                    agn_images=len(fit.agn),
                    deflector=deflector,
                    shear="gamma1" in fit.lens_names,
                    fit=fit,
                )
            except (PosteriorError, InversionError, ObservationError) as error:
                warnings.append(f"inversion: {error}")
    residual = observation.image - fit.model
    measured = noise_scale(observation, residual, fit.sigma, fit.lens)
    if measured is None:
        warnings.append("noise: too few pixels outside the lens to compare its map with the scatter, taken as it is")
    scale = 1.0 if measured is None else measured
    chi2 = _chi2(observation, fit, residual, scale) / fit.degrees_of_freedom
    if abs(scale - 1.0) > _NOISE_AGREES:
        warnings.append(f"noise: outside the lens the image scatters by {scale:.2f} of its noise map")
    # Where the map is too large the errors keep it: its excess stands for the noise that neighbouring pixels share.
    inflation = max(1.0, scale)
    estimates = [_parametric_estimate(fit, observation.zero_point, inflation)]
    lens = _lens_of_fit(fit, inflation)
    if found is not None:
        # "image" is draws of the parametric fit, which is there already.
        estimates += [
            _host_estimate(estimate)
            for estimate in found.estimates
            if estimate.index_prior == "wide" and estimate.estimator != "image"
        ]
        warnings += found.warnings
    if fit.stamp_error > _WRONG_STAMP:
        warnings.append(f"psf: residuals at the AGN images are {fit.stamp_error:.1f} times what is allowed for a stamp")
    warnings += [f"bound: {name} ended at a bound of the parametric fit" for name in fit.at_bound]
    status: MeasurementStatus = "ok"
    if chi2 > POOR_FIT:
        status = "poor_fit"
        warnings.append(f"model: chi2 per degree of freedom is {chi2:.2f}; the errors do not cover what it misses")
    by_inversion = None if found is None else _lens_of_chain(found.lens)
    return ImageMeasurement(
        host=estimates[0],
        estimates=tuple(estimates),
        lens=lens,
        lens_by_inversion=by_inversion,
        agn=tuple(
            AgnPosition(image.x, image.y, rate_to_magnitude(image.flux, observation.zero_point))
            for image in fit.agn
            if image.flux > 0
        ),
        arc_magnitude=rate_to_magnitude(float(fit.arc.sum()), observation.zero_point),
        chi2_per_dof=chi2,
        chi2_per_dof_as_given=fit.chi2 / fit.degrees_of_freedom,
        noise_scale=scale,
        degrees_of_freedom=fit.degrees_of_freedom,
        status=status,
        profile=profile,
        seed=seed,
        seconds=time.perf_counter() - began,
        warnings=tuple(warnings),
        versions=engine_versions(),
        engine_digest=engine_digest(),
        provenance=dict(observation.provenance),
        observation=observation,
        fit=fit,
        inversion=found,
    )
