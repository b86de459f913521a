"""The numerical error of the estimators on maps of the source, at the best state of a chain.

The map of highest posterior there is fitted once on the grid of the run and once on a finer one: that is the error of
the grid. Rendering and PSF: the image of the fitted host, made exactly, is compared with what the inversion's rays and
blurring matrix make of it. The difference dm moves the source by A^-1 G^T P dm (P marginalises the amplitudes), and the
profile that is fitted to it as the normal equations of each estimator say.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack
from scipy.signal import fftconvolve

from engine.conventions import FloatArray
from engine.estimators.draws import SourceDraw
from engine.estimators.error_budget import MAGNITUDES
from engine.estimators.refit import metric_of, refit_draws
from engine.estimators.sersic_fit import SersicFit
from engine.imaging.observation import Observation
from engine.lensing.power_law import PowerLawLens, source_position
from engine.light.cell_means import profile_on_grid
from engine.light.radial_table import brightness, tabulate, to_profile_axes
from engine.light.sersic import SersicProfile, sersic_constants, shape_of
from engine.likelihood.amplitudes import MarginalLikelihood
from engine.likelihood.evidence import Inversion, invert
from engine.likelihood.problem import Problem
from engine.result import IndexPrior
from engine.source.lensing_matrix import RayBundle
from engine.source.regularisation import SourceModel
from engine.spec.analysis import EstimatorName

Answer = tuple[EstimatorName, IndexPrior]
FINER = 1.4
"""Nodes of the finer grid along an axis, in units of the grid's: half the area of a cell."""
_MOST_NODES = 2000
"""Of the finer grid. Beyond them the grid is compared with a coarser one, whose error is twice its own."""
_STRENGTH_GROWTH = {"curvature": 1.5, "gradient": 0.35, "zeroth": -1.0}
"""Power of the nodes along an axis with which the lambda of most evidence grows (HE0435, 20 to 40 nodes: 1.1-1.9)."""


@dataclass(frozen=True)
class BestState:
    """The state of highest posterior of a chain and the inversion there."""

    lens: PowerLawLens
    ln_lambda: float
    inversion: Inversion


def source_shifts(
    observation: Observation,
    problem: Problem,
    model: SourceModel,
    best: BestState,
    psf_radius: int,
    estimators: Sequence[EstimatorName],
    fixed_index: float | None,
) -> dict[Answer, dict[str, FloatArray]]:
    """Shifts (3,) of magnitude, r_eff [arcsec] and n by the stages ``rendering``, ``psf`` and ``grid``.

    An estimator that cannot fit the map, on one grid or the other, has none.

    Raises
    ------
    InversionError
        The other grid's inversion cannot be trusted.
    LensEquationError
        The images of the fitted host are not found.
    """
    names: list[EstimatorName] = list(dict.fromkeys([*estimators, "projected"]))
    here, fits = mean_draw(best), fits_of_map(best, names, fixed_index)
    scale, other = _other_grid(model)
    ln_lambda = best.ln_lambda + _STRENGTH_GROWTH[model.regularisation] * np.log(other.shape[0] / model.shape[0])
    finer = BestState(best.lens, ln_lambda, invert(problem.likelihood, best.lens, ln_lambda, other))
    there = fits_of_map(finer, names, fixed_index)
    host = fits.get(("projected", "wide"))
    if host is None:
        return {}
    lacking = _lacking(observation, problem, best, psf_radius, host.profile)
    moved = {stage: _moved(problem.likelihood, best.inversion, here, dm) for stage, dm in lacking.items()}
    return {
        answer: {
            **{stage: _response(answer, draw, fit) for stage, draw in moved.items()},
            "grid": scale * (numbers(there[answer].profile) - numbers(fit.profile)),
        }
        for answer, fit in fits.items()
        if answer in there and answer[0] in estimators
    }


def _other_grid(model: SourceModel) -> tuple[float, SourceModel]:
    """Another grid, and what the difference of its answers is multiplied by to be the error of the first.

    That falls with the area of a cell, so that half of it is gone on the finer grid, and that of the coarser one is
    twice as large.
    """
    ny, nx = (round(FINER * nodes) for nodes in model.shape)
    if ny * nx <= _MOST_NODES:
        return 2.0, replace(model, shape=(ny, nx))
    ny, nx = (max(2, round(nodes / FINER)) for nodes in model.shape)
    return 1.0, replace(model, shape=(ny, nx))


def mean_draw(state: BestState) -> SourceDraw:
    """The map of highest posterior in the place of a drawn one."""
    inversion = state.inversion
    return SourceDraw(
        lens=state.lens,
        grid=inversion.grid,
        mean=inversion.source,
        drawn=inversion.source,
        precision_factor=inversion.factor,
        curvature=inversion.curvature,
        data_vector=inversion.data_vector,
    )


def fits_of_map(state: BestState, names: Sequence[EstimatorName], fixed_index: float | None) -> dict[Answer, SersicFit]:
    """Fits to the map of highest posterior, of those estimators and priors of n that have one."""
    refits = refit_draws([mean_draw(state)], names, fixed_index, None)
    return {(refit.estimator, refit.index_prior): refit.fits[0] for refit in refits if refit.fits[0] is not None}


def numbers(profile: SersicProfile) -> FloatArray:
    """Magnitude without zero point, r_eff [arcsec] and n (3,)."""
    return np.array([-MAGNITUDES * np.log(profile.flux), profile.r_eff, profile.n])


def _lacking(
    observation: Observation, problem: Problem, best: BestState, psf_radius: int, host: SersicProfile
) -> dict[str, FloatArray]:
    """What the inversion's image (M,) of a host lacks of the exact one, for the cut PSF and for all the rest."""
    likelihood, mask, rays = problem.likelihood, problem.mask, problem.likelihood.rays
    exact = observation.optics.sersic_image(host, best.lens)[mask]
    light, blurring = ray_light(rays, host, best.lens), likelihood.blurring
    wings = observation.psf.copy()
    middle = wings.shape[0] // 2
    inside = slice(max(0, middle - psf_radius), middle + psf_radius + 1)
    wings[inside, inside] = 0.0
    if rays.centre is None:
        return _parts(exact - blurring @ light, _blurred(light, wings, rays, mask))
    # The last column is what the image of the envelope lacks, and goes with the ratio of host and envelope.
    source = profile_on_grid(host, best.inversion.grid.x_edges, best.inversion.grid.y_edges).ravel()
    ratio = float(best.inversion.lensing.apply(source)[-1])
    cut = _blurred(light - ratio * rays.of_envelope(), wings, rays, mask)
    return _parts(exact - blurring @ np.append(light, ratio), cut)


def _parts(lacking: FloatArray, cut: FloatArray) -> dict[str, FloatArray]:
    return {"rendering": lacking - cut, "psf": cut}


def ray_light(rays: RayBundle, host: SersicProfile, lens: PowerLawLens) -> FloatArray:
    """Flux of each pixel (pixels,) [e-/s] by its rays for a host behind a lens."""
    bx, by = source_position(lens, rays.x, rays.y)
    at_rays = brightness(*to_profile_axes(bx, by, sersic_constants(host)), tabulate(host))
    return np.asarray(at_rays.reshape(rays.pixels, -1).mean(axis=1) * (host.flux * rays.pixel_area))


def _blurred(light: FloatArray, psf: FloatArray, rays: RayBundle, mask: NDArray[np.bool_]) -> FloatArray:
    """Light of the pixels with rays (pixels,) through a stamp, in the mask (M,)."""
    scale = np.sqrt(rays.pixel_area)
    mean = [values.reshape(rays.pixels, -1).mean(axis=1) / scale for values in (rays.x, rays.y)]
    columns, rows = (
        np.rint(middle + (n - 1) / 2.0).astype(int) for middle, n in zip(mean, mask.shape[::-1], strict=True)
    )
    image = np.zeros(mask.shape)
    image[rows, columns] = light
    return np.asarray(fftconvolve(image, psf, mode="same")[mask])


def _moved(likelihood: MarginalLikelihood, inversion: Inversion, here: SourceDraw, lacking: FloatArray) -> SourceDraw:
    """What more light (M,) in the data changes in the map and in the data vector, as a draw."""
    white = likelihood.whitened
    seen = white.noise.whiten(lacking)
    if white.columns.shape[1]:
        q, _ = np.linalg.qr(np.vstack([white.columns, white.priors]))
        q = q[: seen.size]
        seen = seen - q @ (q.T @ seen)
    data = inversion.lensing.transpose(np.asarray(likelihood.blurring.T @ white.noise.whiten_transposed(seen)))
    source, _ = lapack.dpotrs(inversion.factor, data, lower=0)
    return replace(here, data_vector=data, drawn=source.reshape(here.drawn.shape))


def _response(answer: Answer, moved: SourceDraw, fit: SersicFit) -> FloatArray:
    """Shift (3,) of the numbers of a fit where map and data vector move by those of ``moved``."""
    estimator, prior = answer
    profile = fit.profile
    shape = shape_of(profile)
    every = np.zeros(1, dtype=np.intp)
    found = metric_of(estimator, [moved]).normal_equations(every, shape[None])
    held = [0] * fit.r_eff_at_bound + [1] * (fit.n_at_bound or prior == "fixed")
    free = np.delete(np.arange(shape.size + 1), held)
    gram, right = found.gram[0][np.ix_(free, free)], found.right[0][free]
    size = np.sqrt(np.diag(gram))
    size[size == 0.0] = 1.0
    step = np.zeros(shape.size + 1)
    step[free] = np.linalg.pinv(gram / np.outer(size, size), rcond=1e-10, hermitian=True) @ (right / size) / size
    # The derivatives are those of a profile of unit flux.
    return np.array([-MAGNITUDES * step[-1], profile.r_eff * step[0], step[1]]) / profile.flux
