"""From an observation that anybody made to the host galaxy: the analysis of a run, and one answer.

Nothing is known here of exposures, truth or errors of the noise map, so that the map is compared with the scatter, the
inversion may fail, and a fit that is poor is shown with a status that says so.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from engine.conventions import FloatArray, rate_to_magnitude
from engine.digest import engine_digest, engine_versions
from engine.errors import InversionError, ObservationError, PosteriorError, SpecError
from engine.estimators.image import image_estimate
from engine.imaging.observation import Observation
from engine.imaging.readings import readings
from engine.neighbours import without_lone_pixels, without_neighbours
from engine.on_sky import lens_on_sky, orientation_document, places_on_sky, turned
from engine.parametric.constraints import GALAXY, WIDE
from engine.parametric.fit import ParametricFit
from engine.parametric.poor_fit import POOR_FIT, widened
from engine.parametric.residual_noise import noise_scale
from engine.parametric.search import Acceptance
from engine.plausibility import require_hints, require_lens, unlikely
from engine.reconstruction import SampledInversion, analyse, lens_of_fit, of_model, poor_fit, undetected
from engine.result import Estimate, LensParameter, Quantity
from engine.several_psfs import PsfFit, averaged
from engine.spec.analysis import PROFILES, Analysis
from engine.stages import Progress
from engine.status import MeasurementStatus, magnitude_limit, not_detected, prior_dominated, status_of
from engine.work import Work, counted

_ANY_LENS = Acceptance(chi2_per_dof=300.0, miss=0.3)
"""What is shown with the status ``poor_fit`` rather than refused: no model of a real lens is perfect."""
_NAMES = {"image": "parametric"}
"""What documents call an estimator, where that is not its name: they did so before it had one."""
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
    neighbours share. ``chi2_per_dof_as_given`` takes the map as it is. ``status`` is that of
    :func:`~engine.status.status_of`; a host that is not detected is fainter than ``host_limit`` (95 %). ``inversion``
    is None where none was asked for, or where it failed, which ``warnings`` then say. ``work`` counts all that was
    computed, that of an inversion that failed included. ``by_psf`` is what each PSF came to where there are several.
    """

    host: Estimate
    estimates: tuple[Estimate, ...]
    lens: dict[str, Quantity]
    lens_by_inversion: dict[str, Quantity] | None
    agn: tuple[AgnPosition, ...]
    host_limit: float | None
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
    inversion: SampledInversion | None
    work: Work
    by_psf: tuple[PsfFit, ...] = ()

    @property
    def estimator(self) -> str:
        """What its documents call the estimator whose answer ``host`` is."""
        return _NAMES.get(self.host.estimator, self.host.estimator)

    @property
    def inversion_chi2_per_dof(self) -> float | None:
        """Of the inversion, with the noise of ``chi2_per_dof`` where the exposures are not known; None without one."""
        if self.inversion is None:
            return None
        chi2 = self.inversion.chi2
        if self.observation.optics.misfit_is_noise:
            # The inversion takes what the fit misses for noise, which must not make the two incomparable.
            residual = self.inversion.image_plane.residual * self.observation.noise
            chi2 = _chi2(self.observation, self.fit, residual, self.noise_scale)
        return chi2 / self.inversion.degrees_of_freedom

    @property
    def priors(self) -> dict[str, float]:
        """Of the lens in the parametric fit; its ellipticity is about none, or about that of Gaussians."""
        return (GALAXY if self.fit.deflector_gaussians else WIDE).told

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready form, without the arrays."""
        fit, chain = self.fit, None if self.inversion is None else self.inversion.chain.summary
        return {
            "status": self.status,
            "estimator": self.estimator,
            "host": _host_document(self.host),
            "host_limit": self.host_limit,
            "lens": {name: _document(value) for name, value in self.lens.items()},
            "chi2_per_dof": self.chi2_per_dof,
            "chi2_per_dof_as_given": self.chi2_per_dof_as_given,
            "noise_scale": self.noise_scale,
            "degrees_of_freedom": self.degrees_of_freedom,
            "estimates": [_host_document(estimate) for estimate in self.estimates],
            "lens_by_inversion": (
                None
                if self.lens_by_inversion is None
                else {name: _document(value) for name, value in self.lens_by_inversion.items()}
            ),
            "chain": None if chain is None else asdict(chain),
            "inversion_chi2_per_dof": self.inversion_chi2_per_dof,
            "stamp_error": fit.stamp_error,
            "model_error": _error_document(self),
            "agn": [asdict(image) for image in self.agn],
            "arc_magnitude": self.arc_magnitude,
            "deflector": _deflector_document(fit),
            "deflector_gaussians": [asdict(one) for one in fit.deflector_gaussians],
            "arc_error": fit.arc_error,
            "priors": self.priors,
            "decided_by_priors": list(prior_dominated(fit)),
            "background": fit.background,
            "psfs": [self._psf_document(one) for one in self.by_psf],
            "profile": self.profile,
            "seed": self.seed,
            "seconds": self.seconds,
            "work": asdict(self.work),
            "warnings": list(self.warnings),
            "versions": self.versions,
            "engine_digest": self.engine_digest,
            "provenance": self.provenance,
            "read": [asdict(reading) for reading in readings(self.observation)],
            "on_sky": self._on_sky(),
        }

    def _psf_document(self, found: PsfFit) -> dict[str, float]:
        """One PSF's part, and the magnitude of the host with it alone."""
        return {
            "psf": found.place + 1,
            "weight": found.weight,
            "chi2_per_dof": found.chi2_per_dof,
            "magnitude": rate_to_magnitude(found.flux, self.observation.zero_point),
            "sd": 2.5 / math.log(10.0) * found.flux_error / found.flux,
        }

    def _on_sky(self) -> dict[str, Any]:
        """Angles and positions East of North, however the image stands; the rest of the document has its frame."""
        orientation = self.observation.orientation
        return {
            "image": orientation_document(orientation),
            "lens": {name: _document(value) for name, value in lens_on_sky(self.lens, orientation).items()},
            "agn": places_on_sky([(image.x, image.y) for image in self.agn], self.observation),
        }


def _document(value: Quantity) -> dict[str, Any]:
    return {"mean": value.mean, "sd": value.sd, "interval95": list(value.interval95)}


def _error_document(found: ImageMeasurement) -> dict[str, Any] | None:
    """What the model is wrong by, as far as the image shows it; the host with a model that is taken for exact."""
    error = found.fit.error
    if error is None:
        return None
    exact = rate_to_magnitude(error.flux_without, found.observation.zero_point) if error.flux_without > 0 else None
    return {"psf": error.psf, "host": error.host, "ln_evidence": error.gain, "magnitude_if_exact": exact}


def _host_document(found: Estimate) -> dict[str, Any]:
    values = {
        "magnitude": found.magnitude,
        "radius": found.r_eff,
        "n": found.n,
        "q": found.q,
        "position_angle": found.position_angle,
    }
    name = _NAMES.get(found.estimator, found.estimator)
    return {"estimator": name, **{key: _document(value) for key, value in values.items()}}


def _deflector_document(fit: ParametricFit) -> dict[str, Any] | None:
    """The profile, or of Gaussians what all of them have: their whole flux and their place."""
    if fit.deflector is not None or not fit.deflector_gaussians:
        return None if fit.deflector is None else asdict(fit.deflector)
    flux, first = sum(one.flux for one in fit.deflector_gaussians), fit.deflector_gaussians[0]
    return {"flux": flux, "r_eff": None, "n": None, "q": None, "phi": None, "x": first.x, "y": first.y}


def _chi2(observation: Observation, fit: ParametricFit, residual: FloatArray, scale: float) -> float:
    """chi^2 of residuals (ny, nx) with the noise map times ``scale`` and the error of the AGN's light as it is."""
    used = np.isfinite(fit.sigma)
    variance = fit.sigma[used] ** 2 + (scale**2 - 1.0) * observation.noise[used] ** 2
    return float(np.sum(residual[used] ** 2 / variance))


def _by_name(parameters: Sequence[LensParameter]) -> dict[str, Quantity]:
    return {found.name: found.value for found in parameters}


def measure_image(
    observation: Observation,
    *,
    profile: str = "standard",
    agn_images: int | None = None,
    deflector: bool = True,
    shear: bool | None = None,
    theta_E: float | None = None,
    positions: Sequence[tuple[float, float]] | None = None,
    centre: tuple[float, float] | None = None,
    seed: int = 0,
    inversion: bool = True,
    trust_options: bool = False,
    progress: Progress | None = None,
    other_psfs: Sequence[FloatArray] = (),
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
    centre : (x, y), optional
        Where the deflector is, to half an arcsec [arcsec, image frame]; found where None.
    seed : int
        For the chain.
    inversion : bool
        Whether to sample the inversion as well; the parametric fit alone takes seconds.
    trust_options : bool
        Go on, with a warning, where the observation cannot be one of a lens (:mod:`engine.plausibility`).
    progress : callable, optional
        Told each stage, and how far it is.
    other_psfs : sequence of arrays
        Stamps that the PSF may as well be: the answer is that of all of them (:mod:`engine.several_psfs`).

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
    require_hints(observation, theta_E, positions, centre)
    warnings = [*observation.notes, *unlikely(observation, trusting=trust_options)]
    observation, masked = without_lone_pixels(observation)
    warnings += [*masked, *require_lens(observation, trusting=trust_options)]
    rng = np.random.default_rng(seed)
    with counted() as tally:
        how: dict[str, Any] = {
            "agn_images": agn_images, "deflector": deflector, "shear": shear, "theta_E": theta_E,
            "positions": positions, "acceptance": _ANY_LENS, "real_galaxy": True, "centre": centre,
            "progress": progress,
        }  # fmt: skip
        image_alone = replace(analysis, estimators=("image",))
        found = analyse(observation, image_alone, rng, **how)
        cleaned, told = without_neighbours(observation, found.fit)
        if told:
            warnings += told
            observation = cleaned
            found = analyse(observation, image_alone, rng, **how)
        observation, fit, by_psf, refused = _by_each_psf(observation, found.fit, other_psfs, image_alone, rng, how)
        warnings += refused
        orientation = observation.orientation
        if inversion:
            try:
                found = analyse(observation, analysis, rng, fit=fit, progress=progress)
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
    posterior = fit.hosts["wide"].inflated(inflation)
    if chi2 > POOR_FIT:
        posterior = widened(observation, fit, posterior)
    host = turned(image_estimate(posterior, "wide", observation.zero_point), orientation)
    drawn = () if found.inversion is None else found.inversion.estimates
    warnings += [] if found.inversion is None else found.inversion.warnings
    if fit.stamp_error > _WRONG_STAMP:
        warnings.append(f"psf: residuals at the AGN images are {fit.stamp_error:.1f} times what is allowed for a stamp")
    warnings += of_model(fit)
    warnings += [f"bound: {name} ended at a bound of the parametric fit" for name in fit.at_bound]
    status = status_of(fit, host, chi2)
    warnings += filter(None, (poor_fit(chi2), undetected(host) if not_detected(fit, host) else ""))
    return ImageMeasurement(
        host=host,
        estimates=(host, *(turned(one, orientation) for one in drawn if one.index_prior == "wide")),
        lens=_by_name(lens_of_fit(fit, inflation)),
        lens_by_inversion=None if found.inversion is None else _by_name(found.inversion.lens),
        host_limit=magnitude_limit(fit, host),
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
        inversion=found.inversion,
        work=tally.work(),
        by_psf=by_psf,
    )


def _by_each_psf(
    observation: Observation,
    first: ParametricFit,
    others: Sequence[FloatArray],
    analysis: Analysis,
    rng: np.random.Generator,
    how: dict[str, Any],
) -> tuple[Observation, ParametricFit, tuple[PsfFit, ...], list[str]]:
    """The observation with the best PSF, its fit with the uncertainty of all, each PSF's, and what was refused.

    What the first fit found in the image is where the others begin.
    """
    if not others:
        return observation, first, (), []
    if observation.response is not None:
        raise SpecError("psf", f"{1 + len(others)} stamps", "one, where the exposures behind the image are known")
    known = how | {
        "agn_images": len(first.agn),
        "positions": [(image.x, image.y) for image in first.agn] or None,
        "theta_E": first.lens.theta_E,
    }
    fits, refused = [(0, first)], []
    seen = [observation, *(replace(observation, psf=stamp) for stamp in others)]
    for place, one in enumerate(seen[1:], start=1):
        try:
            fits.append((place, analyse(one, analysis, rng, **known).fit))
        except (PosteriorError, ObservationError) as error:
            refused.append(f"psf {place + 1}: no fit: {error}")
    best, fit, told = averaged(observation, fits)
    return seen[best], fit, told, refused
