"""From an image to quick fits: what is taken for AGN images, where fits begin, and which starts are worth more."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from engine.conventions import FloatArray
from engine.errors import ObservationError, PosteriorError
from engine.imaging.observation import Observation
from engine.parametric.model import ImageModel, weights_sigma, window_round
from engine.parametric.parameters import HOST_FLUX, ParameterSpace
from engine.parametric.point_sources import Detection, find_point_sources
from engine.parametric.solution import Solution, minimise
from engine.parametric.starts import (
    CENTRE_REACH,
    Start,
    agn_hypotheses,
    deflector_centre,
    filled_image,
    off_centre,
    ring_radii,
    starts_from_agn,
    starts_from_arc,
)
from engine.spec.priors import LensParameterName, ParameterPrior

_QUICK_WINDOW = 1.6
"""Half-width of the window of the quick fits in Einstein radii, to which a margin comes."""
_QUICK_MARGIN = 0.5
_QUICK_STEPS, _QUICK_TOLERANCE, _QUICK_SUBRAYS = 15, 1e-4, 1
_MOST_CANDIDATES, _ERRING_CANDIDATES = 6, 4
_TELLING_IMAGES = 3
"""AGN images that tell of a lens though no host shows."""
_AGN_NUMBERS = (4, 3, 2, 0)
_ARC_STARTS = 4


@dataclass(frozen=True)
class Acceptance:
    """How bad a fit may be: chi^2 per degree of freedom; farthest that an AGN image maps from the host [arcsec]."""

    chi2_per_dof: float = 4.0
    miss: float = 0.05


@dataclass(frozen=True, eq=False)
class Task:
    """What is fitted: an observation, what the model may have, and what is known.

    ``shear`` is None where the fit has to tell whether there is any; a ``dark_host`` may be one that the image does not
    show; the deflector is ``near`` a place [arcsec], or ``anywhere``, or near the middle.
    """

    observation: Observation
    deflector: bool
    shear: bool | None
    acceptance: Acceptance
    priors: Mapping[LensParameterName, ParameterPrior]
    dark_host: bool = False
    near: tuple[float, float] | None = None
    anywhere: bool = False

    @cached_property
    def image(self) -> FloatArray:
        """The image (ny, nx) with its gaps filled."""
        return filled_image(self.observation)

    @cached_property
    def noise(self) -> FloatArray:
        """The noise map (ny, nx) with its gaps filled."""
        valid, noise = self.observation.valid, self.observation.noise
        return np.where(valid, noise, float(np.median(noise[valid])))

    @cached_property
    def centre(self) -> tuple[float, float]:
        """Where the deflector shines [arcsec]; the middle, where its light shows nowhere near it."""
        scale, origin = self.observation.pixel_scale, self.near or (0.0, 0.0)
        if not self.deflector:
            return origin
        shining = deflector_centre(self.image, scale, origin)
        if self.anywhere and self.near is None:
            elsewhere = off_centre(self.image, self.noise, scale)
            if elsewhere is not None and math.hypot(*elsewhere) > CENTRE_REACH:
                return deflector_centre(self.image, scale, elsewhere) or elsewhere
        return origin if shining is None else shining

    @property
    def may_shear(self) -> bool:
        """Whether fits have shear until it proves absent."""
        return self.shear is not False

    def candidates(self, most: int) -> tuple[Detection, ...]:
        """At most that many point sources."""
        return find_point_sources(
            self.image, self.noise, self.observation.psf, self.observation.pixel_scale, most, self.centre
        )


def find_starts(
    task: Task, number: int | None, theta_E: float | None, positions: Sequence[tuple[float, float]] | None
) -> list[list[Start]]:
    """Starts of each hypothesis about the AGN images: their ``number``, or their rough ``positions`` [arcsec]."""
    if positions is not None:
        agn = tuple(Detection(float(x), float(y), _flux_at(task, x, y), math.inf) for x, y in positions)
        hypotheses = [agn]
    else:
        candidates = task.candidates(max(_MOST_CANDIDATES, number or 0))
        if number is not None and len(candidates) < number:
            raise ObservationError(f"agn: found {len(candidates)} point sources of {number}, at five sigma or more")
        hypotheses = agn_hypotheses(candidates, _AGN_NUMBERS if number is None else (number,), task.centre)
    groups = []
    for agn in hypotheses:
        if len(agn) >= 2:
            groups.append(starts_from_agn(agn, task.centre))
        else:
            rough = (theta_E,) if theta_E else ring_radii(task.image, task.observation.pixel_scale, task.centre)
            groups.append([start for radius in rough for start in starts_from_arc(radius, task.centre, agn)])
    return groups


def varied_starts(group: list[Start]) -> list[Start]:
    """More starts for where the first ones led nowhere: other slopes, a smaller and a larger host, shear."""
    seeds = group if len(group) <= _ARC_STARTS else group[:: max(1, len(group) // _ARC_STARTS)]
    return [
        replace(start, lens=start.lens.with_values(slope=slope, gamma1=0.01), host_radius=radius)
        for start in seeds
        for slope, radius in ((1.8, 0.3), (2.2, 0.3), (2.0, 0.1), (2.0, 0.6))
    ]


def quick_fits(task: Task, group: list[Start]) -> list[Solution]:
    """Quick fits from a group of starts, of which a long one is cut down by linear fits first."""
    observation, first = task.observation, group[0]
    reach = max(start.lens.theta_E for start in group)
    reach = max([reach, *(math.hypot(d.x - task.centre[0], d.y - task.centre[1]) for d in first.agn)])
    window = window_round(
        observation.shape, observation.pixel_scale, task.centre, _QUICK_WINDOW * reach + _QUICK_MARGIN
    )
    # Without it an arc that was sheared ends in one of several false minima, far from the true lens.
    space = ParameterSpace(
        len(first.agn), task.deflector, shear=task.may_shear or first.lens.gamma1 != 0.0, middle=task.near or (0.0, 0.0)
    )
    # One noise map for all hypotheses, or their chi^2 could not be compared.
    light = agn_light(observation, task.candidates(_ERRING_CANDIDATES))
    sigma = weights_sigma(observation, observation.optics.agn_variance(light))
    model = ImageModel(observation, space, sigma, window, subrays=_QUICK_SUBRAYS, exact=False)
    if len(group) > 2 * _ARC_STARTS:
        group = _best_linear(model, group)
    out = []
    for start in group:
        try:
            found = minimise(model, start, start.vector(space), _QUICK_STEPS, _QUICK_TOLERANCE)
        except PosteriorError:
            continue
        if found.host_flux > 0 or (task.dark_host and space.n_agn >= _TELLING_IMAGES):
            out.append(found)
    return out


def agn_light(observation: Observation, agn: Sequence[Detection]) -> FloatArray:
    """Image (ny, nx) [e-/s] of AGN images."""
    light = np.zeros(observation.shape)
    for found in agn:
        light += found.flux * observation.point_source(found.x, found.y)
    return light


def _flux_at(task: Task, x: float, y: float) -> float:
    star = task.observation.point_source(x, y)
    return max(float((star * task.image).sum() / (star * star).sum()), 0.0)


def _best_linear(model: ImageModel, group: list[Start]) -> list[Start]:
    """The best starts by the linear fit alone, no two of them of the same lens."""
    rated: list[tuple[float, int, Start]] = []
    for start in group:
        amplitudes, rest, _ = model.amplitudes(start.vector(model.space))
        if amplitudes[HOST_FLUX] > 0:
            rated.append((float(rest @ rest), len(rated), start))
    chosen: list[Start] = []
    for _, _, start in sorted(rated):
        if all(start.lens != other.lens for other in chosen):
            chosen.append(start)
        if len(chosen) == _ARC_STARTS:
            break
    return chosen
