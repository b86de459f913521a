"""A first guess at the stamp of a PSF from the AGN images alone, before there is a model of the lens.

Where the stamp that was given is far off, host and deflector take up in a fit what it cannot explain, and what the
residuals then say of it is wrong as well. What several AGN images have in common, over a background that is smooth
within a few pixels, is a better beginning: :mod:`.model_error` goes on from there. The cusp of a host under the images
passes for the PSF's here, which is why it is no more than a beginning.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from engine.conventions import FloatArray
from engine.imaging.observation import Observation
from engine.imaging.optics.spline import place_spline, spline_coefficients
from engine.parametric.point_sources import Detection
from engine.parametric.psf_error import laid_modes, stamp_modes
from engine.parametric.shared_error import likeliest_errors

_RADIUS = 6
"""Pixels round an AGN image that are looked at."""
_PLACING, _LEARNING = 4, 5
"""Rounds in which the images are placed, and in which the stamp is learned from them as well."""
_STEP = 0.5
"""Farthest that an image moves in a round [pixels]."""
_FEWEST = 2


def stamp_of_images(observation: Observation, agn: Sequence[Detection]) -> FloatArray | None:
    """The stamp (n, n) that AGN images have in common; None of fewer than two, or if they see no error of the given."""
    if len(agn) < _FEWEST:
        return None
    ny, nx = observation.shape
    at = np.array(
        [(d.x / observation.pixel_scale + (nx - 1) / 2.0, d.y / observation.pixel_scale + (ny - 1) / 2.0) for d in agn]
    )
    flux = np.array([d.flux for d in agn])
    row, column = np.indices(observation.shape, dtype=np.float64)
    near = np.array([np.hypot(column - x, row - y) <= _RADIUS for x, y in at])
    counted = near.any(axis=0) & observation.valid
    noise = observation.noise[counted]
    given, modes = observation.psf, stamp_modes(observation.psf)
    correction = np.zeros_like(given)
    for turn in range(_PLACING + _LEARNING):
        spline = spline_coefficients(given + correction)
        known = np.stack([_columns(spline, place, near[k], row, column)[:, counted] for k, place in enumerate(at)])
        # Moving an image counts in pixels, as its flux counts in e-/s.
        known[:, 1:3] *= flux[:, None, None]
        moved = _moved_variance(observation, spline, at, flux)[counted]
        sigma = np.sqrt(noise**2 + moved)
        basis = known.reshape(-1, noise.size).T / sigma[:, None]
        size = np.linalg.norm(basis, axis=0)
        unknown, _ = np.linalg.qr(basis / size)
        data = observation.image[counted] / sigma
        target = data
        if turn >= _PLACING:
            places = [(x, y, f) for (x, y), f in zip(at, flux, strict=True)]
            laid = laid_modes(modes, places, observation.shape)[:, counted].T / sigma[:, None]
            done = laid_modes(correction[None], places, observation.shape)[0][counted] / sigma
            seen, rest = (v - unknown @ (unknown.T @ v) for v in (laid, data + done))
            found = likeliest_errors([seen], rest, [(1.0, np.ones(rest.size))])
            if not found.gain > 0:
                return None
            amplitudes = found.strengths[0] * found.amplitudes
            correction = np.tensordot(amplitudes, modes, axes=1)
            target = data + done - laid @ amplitudes
        best = (np.linalg.lstsq(basis / size, target, rcond=1e-10)[0] / size).reshape(len(agn), -1)
        shift = np.clip(best[:, 1:3], -_STEP, _STEP)
        # A shift of all of them is one of the stamp.
        at = at + (shift if turn < _PLACING else shift - shift.mean(axis=0))
        flux = best[:, 0]
        if not (flux > 0).all():
            return None
    return np.asarray(given + correction)


def _columns(
    spline: FloatArray, place: FloatArray, near: FloatArray, row: FloatArray, column: FloatArray
) -> FloatArray:
    """Images (9, ny, nx): a point source of unit flux, its derivatives, and a quadratic background near it."""
    shape = near.shape
    x, y = (column - place[0]) / _RADIUS, (row - place[1]) / _RADIUS
    stars = [place_spline(spline, shape, *place, along=along) for along in (None, "column", "row")]
    return np.stack([*stars, *(near * term for term in (np.ones(shape), x, y, x * x, x * y, y * y))])


def _moved_variance(observation: Observation, spline: FloatArray, at: FloatArray, flux: FloatArray) -> FloatArray:
    light = sum(f * place_spline(spline, observation.shape, x, y) for (x, y), f in zip(at, flux, strict=True))
    return observation.optics.agn_variance(np.asarray(light))
