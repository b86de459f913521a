"""From an observation and its parametric model to the linear problem: mask, noise, amplitude columns, rays."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.ndimage import distance_transform_edt

from engine.conventions import FloatArray, pixel_centres
from engine.errors import ObservationError
from engine.imaging.observation import Observation
from engine.lensing.lens_equation import makes_ring, solve_lens_equation
from engine.lensing.power_law import source_position
from engine.likelihood.amplitudes import LinearData, MarginalLikelihood, marginalise_amplitudes
from engine.parametric.fit import ParametricFit
from engine.source.envelope import Envelope
from engine.source.lensing_matrix import RayBundle, cast_rays, map_rays
from engine.spec.analysis import Analysis

CORE_BOOST = 1e3
"""Factor on the standard deviation of the pixels at the AGN cores: 'effectively infinite' (section 4.1)."""

_ENVELOPE_FLOOR = 0.01
"""Brightness, in units of the host's at its effective radius, that is expected where its profile is fainter."""

_PAPER_CODE_FACTOR = 0.01
"""The paper's scripts wrote sqrt(rms^2 + 0.01 |image|) as the noise map."""


@dataclass(frozen=True)
class Problem:
    """The linear problem of an observation.

    ``mask`` and ``core`` are (ny, nx): the fitted ring, and the pixels in it whose noise is boosted;
    ``amplitude_names`` are those of the amplitudes' columns and ``amplitude_images`` (k, ny, nx) their full images.
    """

    likelihood: MarginalLikelihood
    mask: NDArray[np.bool_]
    core: NDArray[np.bool_]
    amplitude_names: tuple[str, ...]
    amplitude_images: FloatArray


def ring_mask(
    shape: tuple[int, int], pixel_scale: float, centre: tuple[float, float], inner: float, outer: float
) -> NDArray[np.bool_]:
    """Pixels (ny, nx) whose centres lie between two radii [arcsec] of a centre [arcsec, image frame]."""
    y, x = np.meshgrid(*(pixel_centres(n, pixel_scale) for n in shape), indexing="ij")
    radius = np.hypot(x - centre[0], y - centre[1])
    return np.asarray((radius >= inner) & (radius <= outer))


def _amplitude_images(observation: Observation, fit: ParametricFit) -> tuple[tuple[str, ...], FloatArray]:
    names, images = [], []
    for k, agn in enumerate(fit.agn):
        names.append(f"agn{k + 1}")
        images.append(observation.point_source(agn.x, agn.y))
    if fit.deflector is not None:
        names.append("deflector")
        images.append(observation.optics.sersic_image(replace(fit.deflector, flux=1.0)))
    elif fit.deflector_gaussians:
        names.append("deflector")
        total = sum(one.flux for one in fit.deflector_gaussians)
        shown = np.stack([observation.optics.sersic_image(one) for one in fit.deflector_gaussians])
        images.append(shown.sum(axis=0) / total)
    names.append("background")
    images.append(np.ones(observation.shape))
    return tuple(names), np.stack(images)


def _precisions(names: tuple[str, ...], analysis: Analysis) -> FloatArray:
    """Precisions (k,) of the amplitudes' priors: all flat, but the background's where the sky is known."""
    sd = analysis.background_sd
    return np.array([0.0 if sd is None or name != "background" else sd**-2 for name in names])


def _noise(
    observation: Observation, fit: ParametricFit, analysis: Analysis, mask: NDArray[np.bool_], core: NDArray[np.bool_]
) -> FloatArray | sparse.csr_matrix:
    """Variances (M,) or covariance (M, M, sparse) of the data on the mask under the chosen treatment, cores boosted."""
    variance = observation.optics.data_variance(observation.noise[mask] ** 2, fit.sigma[mask] ** 2, fit.misfit)
    boost = np.where(core[mask], variance * CORE_BOOST**2, 0.0)
    if analysis.noise_treatment == "covariance":
        if observation.covariance is None:
            raise ObservationError(
                "noise_treatment: got 'covariance', but the observation has no covariance; "
                "allowed is 'diagonal' or 'paper_code'"
            )
        chosen = np.flatnonzero(mask)
        return sparse.csr_matrix(observation.covariance.tocsr()[chosen][:, chosen] + sparse.diags(boost))
    if analysis.noise_treatment == "paper_code":
        variance = variance + _PAPER_CODE_FACTOR * np.abs(observation.image[mask])
    return np.asarray(variance + boost)


def _envelope(fit: ParametricFit, rays: RayBundle) -> Envelope:
    """The host of the parametric fit, placed by the AGN, on the scale of the source grid of its lens."""
    grid = map_rays(rays, fit.lens, (2, 2)).grid
    size = math.sqrt(float((grid.x[-1] - grid.x[0]) * (grid.y[-1] - grid.y[0])))
    x, y = 0.5 * (grid.x[0] + grid.x[-1]), 0.5 * (grid.y[0] + grid.y[-1])
    if rays.anchors.size:
        ax, ay = source_position(fit.lens, rays.anchors[:, 0], rays.anchors[:, 1])
        x, y = float(ax.mean()), float(ay.mean())
    profile = replace(fit.host, flux=1.0, x=fit.host.x - x, y=fit.host.y - y)
    return Envelope(profile, _ENVELOPE_FLOOR, size, fit.lens, (x, y))


def _defect(
    observation: Observation, mask: NDArray[np.bool_], rays: RayBundle, blurring: sparse.csr_matrix
) -> FloatArray:
    """What B L lacks (M,) of the image of the envelope itself, behind the lens of the parametric fit.

    Sub-rays, the sampling of the light by pixels, the cut of the PSF: all that is wrong with the image of a known
    source can be known. It hardly changes with the lens within its posterior, and goes with t at the host's centre.
    """
    if rays.envelope is None:
        raise ValueError("rays: got none with an envelope; without one there is no defect")
    exact = observation.optics.sersic_image(rays.envelope.host, rays.envelope.lens)[mask]
    return np.asarray(exact - blurring @ rays.of_envelope())


def _brightest_image(fit: ParametricFit) -> tuple[float, float]:
    """An image position [arcsec] that maps to the host's centre: of its images the brightest, of a ring any point."""
    if makes_ring(fit.lens, fit.host.x, fit.host.y):
        return fit.lens.x + fit.lens.theta_E, fit.lens.y
    image = solve_lens_equation(fit.lens, fit.host.x, fit.host.y)[0]
    return image.x, image.y


def prepare_problem(observation: Observation, fit: ParametricFit, analysis: Analysis) -> Problem:
    """Lay out the linear problem.

    The ring is centred on the fitted lens and scaled by its Einstein radius; it then stays fixed.

    Raises
    ------
    ObservationError
        The ring holds no valid pixel, or the covariance that is asked for is not there.
    """
    shape, scale = observation.image.shape, observation.pixel_scale
    theta_E = fit.lens.theta_E
    ring = ring_mask(
        shape, scale, (fit.lens.x, fit.lens.y), analysis.mask_inner * theta_E, analysis.mask_outer * theta_E
    )
    mask = ring & observation.valid
    if not mask.any():
        raise ObservationError(
            f"mask: a ring of {analysis.mask_inner * theta_E:.2f}-{analysis.mask_outer * theta_E:.2f} arcsec "
            "holds no valid pixel"
        )
    core = np.zeros(shape, dtype=np.bool_)
    for agn in fit.agn:
        core |= ring_mask(shape, scale, (agn.x, agn.y), 0.0, analysis.core_radius)
    core &= mask
    names, images = _amplitude_images(observation, fit)
    margin = distance_transform_edt(~mask) <= analysis.ray_margin
    x, y = pixel_centres(shape[1], scale), pixel_centres(shape[0], scale)
    anchors = np.array([(agn.x, agn.y) for agn in fit.agn])
    rays = cast_rays(mask, margin, x, y, scale, analysis.subrays, anchors)
    blurring = observation.optics.blurring_matrix(
        np.nonzero(mask), np.nonzero(mask | margin), analysis.subrays, analysis.psf_radius
    )
    if analysis.source_envelope:
        rays = replace(rays, envelope=_envelope(fit, rays))
        defect = _defect(observation, mask, rays, blurring)
        blurring = sparse.hstack([blurring, defect[:, None]], format="csr")
        rays = replace(rays, centre=_brightest_image(fit))
    linear = LinearData(
        data=observation.image[mask],
        covariance=_noise(observation, fit, analysis, mask, core),
        columns=np.ascontiguousarray(images[:, mask].T),
        precisions=_precisions(names, analysis),
    )
    likelihood = marginalise_amplitudes(linear, blurring, rays)
    return Problem(likelihood=likelihood, mask=mask, core=core, amplitude_names=names, amplitude_images=images)
