"""What a Sersic profile may be wrong by as a host, and what that looks like behind the lens.

Real galaxies have arms, clumps and companions. A host's departure from its profile is taken for a Gaussian process in
proportion to the profile's light, smooth over a part of its radius, without what another Sersic profile would explain:
the host that is measured is the profile that fits the galaxy best. Traced through the lens its modes are columns of the
covariance of the pixels, as those of the PSF's error are (:mod:`.psf_error`).
"""

from __future__ import annotations

import math

import numpy as np
from scipy import linalg, ndimage

from engine.conventions import FloatArray
from engine.lensing.power_law import source_position
from engine.light.derivatives import LightDerivatives
from engine.light.sersic import SersicProfile, surface_brightness
from engine.parametric.model import ImageModel

_REACH, _NODES = 3.5, 28
"""Half-width of the square that may depart from the profile, in effective radii, and nodes along its side."""
_CORRELATION = 0.3
"""Effective radii over which a departure stays the same, as the standard deviation of a Gaussian."""
_WEAKEST_MODE = 0.03
"""Size of a mode, in that of the largest, below which it is left out."""


def profile_modes(profile: SersicProfile) -> FloatArray:
    """Departures (m, nodes, nodes) of a host from its profile, as fractions of its light; of strength one.

    Nodes are along the profile's axes, from -3.5 to 3.5 effective radii.
    """
    side = 2.0 * _REACH / _NODES
    axis = (np.arange(_NODES) + 0.5) * side - _REACH
    v, u = np.meshgrid(axis, axis, indexing="ij")
    x, y = _from_axes(profile, u, v)
    light = surface_brightness(profile, x, y)
    u, v, light = u.ravel(), v.ravel(), light.ravel()
    distance = (u[:, None] - u) ** 2 + (v[:, None] - v) ** 2
    prior = np.outer(light, light) * np.exp(-0.5 * distance / _CORRELATION**2)
    others = np.stack([light, *LightDerivatives(profile, None).at(x.ravel(), y.ravel())])
    basis, _ = np.linalg.qr((others / np.linalg.norm(others, axis=1)[:, None]).T)
    prior -= basis @ (basis.T @ prior)
    prior -= (prior @ basis) @ basis.T
    variance, vectors = linalg.eigh(prior)
    kept = np.flatnonzero(variance > _WEAKEST_MODE**2 * variance[-1])[::-1]
    modes = (np.sqrt(variance[kept]) * vectors[:, kept]).T / light
    return np.asarray(modes.reshape(-1, _NODES, _NODES))


def lensed_modes(model: ImageModel, values: FloatArray, flux: float) -> FloatArray:
    """Images (m, rows, columns) [e-/s] of the window of each departure of the host of a fit."""
    profile, lens = model.space.host(values, flux), model.space.lens(values)
    modes = profile_modes(profile)
    blur = model.host_blur
    x, y = np.meshgrid(blur.x, blur.y)
    bx, by = source_position(lens, x, y)
    light = surface_brightness(profile, bx, by) * blur.side**2
    u, v = _to_axes(profile, bx, by)
    side = 2.0 * _REACH / _NODES
    where = np.stack([(v + _REACH) / side - 0.5, (u + _REACH) / side - 0.5])
    out = np.empty((len(modes), *model.shape))
    for k, mode in enumerate(modes):
        relative = ndimage.map_coordinates(mode, where, order=1, mode="constant", cval=0.0)
        out[k] = blur(relative * light, integrated=False)
    return out


def _from_axes(profile: SersicProfile, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Positions [arcsec] of points at (u, v) effective radii along the axes of a profile."""
    along, across = u * profile.r_eff / math.sqrt(profile.q), v * profile.r_eff * math.sqrt(profile.q)
    c, s = math.cos(profile.phi), math.sin(profile.phi)
    return profile.x + c * along - s * across, profile.y + s * along + c * across


def _to_axes(profile: SersicProfile, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The reverse of :func:`_from_axes`."""
    c, s = math.cos(profile.phi), math.sin(profile.phi)
    along, across = c * (x - profile.x) + s * (y - profile.y), c * (y - profile.y) - s * (x - profile.x)
    return along * math.sqrt(profile.q) / profile.r_eff, across / (profile.r_eff * math.sqrt(profile.q))
