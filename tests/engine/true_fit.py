"""The truth of a scene in the form of a parametric fit, for tests of what comes after the fit."""

from dataclasses import replace

import numpy as np

from engine.lensing.power_law import PowerLawLens
from engine.light.sersic import SersicProfile
from engine.parametric.fit import ParametricFit
from engine.parametric.point_sources import Detection
from engine.simulation.scene import Scene


def bare_fit(lens: PowerLawLens, host: SersicProfile, shape: tuple[int, int]) -> ParametricFit:
    """A fit that found a lens and a host, and nothing else."""
    names = ("theta_E", "q", "phi", "slope", "x", "y")
    return ParametricFit(
        lens=lens,
        host=host,
        deflector=None,
        deflector_gaussians=(),
        agn=(),
        background=0.0,
        lens_names=names,
        lens_covariance=1e-6 * np.eye(len(names)),
        hosts={},
        stamp_error=1.0,
        arc_error=0.0,
        at_bound=(),
        model=np.zeros(shape),
        arc=np.zeros(shape),
        sigma=np.full(shape, np.inf),
        psf=np.ones((1, 1)),
        response=None,
        error=None,
        chi2=0.0,
        degrees_of_freedom=1,
    )


def true_fit(scene: Scene) -> ParametricFit:
    """The truth of a scene."""
    return replace(
        bare_fit(scene.lens, scene.host, (scene.system.exposures.field_pixels,) * 2),
        deflector=scene.deflector,
        agn=tuple(Detection(source.x, source.y, source.flux, 1e3) for source in scene.agn),
    )
