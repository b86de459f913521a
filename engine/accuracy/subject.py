"""The scene that a report is measured on: one realization and what is made of it, each once."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from engine.acceptance import check_realization
from engine.accuracy.importance import WeightedPosterior, importance_sample
from engine.catalogue import resolve_dither
from engine.conventions import FloatArray
from engine.experiment import analysis_of
from engine.grid import Grid, expand
from engine.imaging.cusps import cusp_positions
from engine.imaging.drizzling import drizzle
from engine.imaging.geometry import Geometry, exposure_geometry
from engine.likelihood.problem import Problem, prepare_problem, ring_mask
from engine.parametric.fit import ParametricFit, fit_parametric
from engine.posterior.optimum import find_optimum
from engine.posterior.start import find_start, prepare_target
from engine.simulation.scene import Scene, build_scene
from engine.simulation.simulate import Simulation, scene_geometry, simulate_realization
from engine.spec.analysis import Analysis
from engine.spec.host import Host
from engine.spec.realization import Realization

INDEX = 4.0
"""The concentrated host of the paper's grid: the cusp is what pixels find hardest."""
_BEYOND = 0.6
"""Of the ring [arcsec], as far as a field is cut down to where all of it is wanted on finer sub-pixels."""


def hardest_realization(system: str) -> Realization:
    """A host of n = 4 with the smaller radius and the second brightest magnitude of the paper, at l_eta = 1."""
    hosts = [run.realization.host for run in expand(Grid(preset=f"h0licow-vi/{system}"))]
    magnitude = sorted({host.magnitude for host in hosts})[1]
    return Realization(
        system=system,
        l_eta=1.0,
        host=Host(n=INDEX, r_eff=min(host.r_eff for host in hosts), magnitude=magnitude),
    )


class Subject:
    """A realization, and the simulation, parametric fit and linear problem that stages look at; made when asked for."""

    def __init__(self, realization: Realization) -> None:
        check_realization(realization)
        self.realization = realization
        self.scene: Scene = build_scene(realization)

    @property
    def told(self) -> str:
        """The scene in a line."""
        host, camera = self.realization.host, self.scene.camera
        return (
            f"{self.realization.system_name}, {camera.name}, l_eta {self.realization.l_eta:g}; host of "
            f"{host.magnitude:g} mag, R_eff {host.r_eff:g} arcsec, n = {host.n:g}; seed {self.realization.seed}"
        )

    @property
    def analysis(self) -> Analysis:
        """That of the realization, with the priors of its system."""
        return analysis_of(self.realization)

    @cached_property
    def geometry(self) -> Geometry:
        """Sampling of the whole field."""
        return scene_geometry(self.scene)

    @cached_property
    def simulation(self) -> Simulation:
        """The simulated observation."""
        return simulate_realization(self.realization)

    @cached_property
    def clean(self) -> FloatArray:
        """The drizzled image without noise (ny, nx)."""
        exposures = self.simulation.exposures
        return drizzle(exposures.noiseless, exposures.geometry)

    @cached_property
    def cusps(self) -> list[tuple[float, float]]:
        """Image positions [arcsec] of the host's centre."""
        return cusp_positions(self.scene.host_profile, self.scene.lens, self.geometry)

    @property
    def reach(self) -> float:
        """Outer radius of the fitted ring about the lens [arcsec], at the true lens."""
        return self.analysis.mask_outer * self.scene.lens.theta_E

    @cached_property
    def fitted(self) -> NDArray[np.bool_]:
        """Pixels (ny, nx) of the fitted ring at the true lens, outside the AGN cores."""
        observation, lens, analysis = self.simulation.observation, self.scene.lens, self.analysis
        shape, scale, theta_E = observation.shape, observation.pixel_scale, lens.theta_E
        inner, outer = analysis.mask_inner * theta_E, analysis.mask_outer * theta_E
        ring = ring_mask(shape, scale, (lens.x, lens.y), inner, outer) & observation.valid
        for agn in self.scene.agn:
            ring &= ~ring_mask(shape, scale, (agn.x, agn.y), 0.0, analysis.core_radius)
        return ring

    def in_noise(self, image: FloatArray) -> float:
        """The largest absolute value of an image (ny, nx) among the fitted pixels, in units of their noise."""
        return float(np.abs(image / self.simulation.observation.noise)[self.fitted].max())

    def small_geometry(self, finer: int = 1) -> Geometry:
        """Sampling of a field that holds little more than the ring, ``finer`` times as many sub-pixels along a side."""
        camera, whole = self.scene.camera, self.geometry
        most = whole.drizzled_shape[0]
        side = min(math.ceil(2.0 * (self.reach + _BEYOND) / whole.drizzled_scale), most)
        side += (most - side) % 2
        return exposure_geometry(
            camera, resolve_dither(self.scene.system), (side, side), oversampling=finer * whole.oversampling
        )

    def placed_in_field(self, small: FloatArray) -> FloatArray:
        """A small field's drizzled image in the middle of an empty whole one."""
        image = np.zeros(self.geometry.drizzled_shape)
        edge = (image.shape[0] - small.shape[0]) // 2
        image[edge : edge + small.shape[0], edge : edge + small.shape[1]] = small
        return image

    @cached_property
    def fit(self) -> ParametricFit:
        """The parametric fit of the observation."""
        scene = self.scene
        return fit_parametric(
            self.simulation.observation,
            agn_images=len(scene.agn),
            deflector=scene.deflector is not None,
            shear=scene.lens.gamma1 != 0.0 or scene.lens.gamma2 != 0.0,
            priors=self.analysis.priors,
        )

    def problem(self, **changes: object) -> Problem:
        """The linear problem under the analysis with some of its settings changed; that of no change made once."""
        if not changes:
            return self._problem
        return prepare_problem(self.simulation.observation, self.fit, replace(self.analysis, **changes))  # type: ignore[arg-type]

    @cached_property
    def _problem(self) -> Problem:
        return prepare_problem(self.simulation.observation, self.fit, self.analysis)

    @cached_property
    def posterior(self) -> WeightedPosterior:
        """Target, its optimum, and weighted states of it that no chain has made."""
        target = prepare_target(self.problem(), self.fit, self.analysis)
        return importance_sample(target, find_optimum(target, *find_start(target, self.fit)))
