"""The pixelised source: its grid, rays, regularisation and PSF, by what each leaves of an image without noise."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from engine.accuracy.curves import Curve, Knob
from engine.accuracy.subject import Subject
from engine.accuracy.timing import Measuring, least_cpu
from engine.conventions import FloatArray
from engine.lensing.power_law import PowerLawLens
from engine.likelihood.amplitudes import MarginalLikelihood
from engine.likelihood.evidence import invert, ln_evidence
from engine.likelihood.problem import Problem
from engine.likelihood.strength import find_strength
from engine.source.regularisation import SourceModel
from engine.spec.analysis import Analysis

STAGE = "source"
_QUANTITY = "what is left of two images without noise, the host as it is and with a clump, rms of the fitted pixels"
_UNIT = "sigma of their noise"
_WORK = "one evaluation of ln Z"
_REFERENCE = "the simulated images without noise, which no grid has made"
_CLUMP_SHARE, _CLUMP_SIZE, _CLUMP_PLACE = 0.1, 0.25, 1.0
"""Flux of a clump in units of the host's, its R_eff and its distance from the centre in units of the host's R_eff.

Of a host that is its profile the envelope knows nearly all, and few nodes are needed.
"""


def _knob(name: str, place: str, why_off_front: str = "") -> Knob:
    return Knob(STAGE, name, place, _QUANTITY, _UNIT, _WORK, _REFERENCE, why_off_front)


GRID = _knob(
    "source grid",
    "Analysis.source_pixels",
    "Where the grid is narrow, as in SDSS0246, 15 x 15 nodes leave as little; most systems need more, and one number "
    "serves all.",
)
SUBRAYS = _knob(
    "sub-rays",
    "Analysis.subrays",
    "Where the nodes cannot hold the clump the rays do not matter; where they can (HE0435) one ray leaves 6 % more.",
)
MARGIN = _knob(
    "ray margin",
    "Analysis.ray_margin",
    "Two pixels leave as much to 1 %, and cost a fifth less: a choice that may be made with `ray_margin`. Four is kept "
    "because results that are stored have it.",
)
PSF_RADIUS = _knob("PSF radius of the inversion", "Analysis.psf_radius")
REGULARISATION = _knob(
    "regularisation",
    "Analysis.regularisation, Analysis.source_envelope",
    "What leaves less of the image holds the source less: without the clump ln Z of `gradient` is 87 and 40 lower, "
    "that of `zeroth` 325 and 174 (HE0435, SDSS0246), and two to five times as many parameters are left to the data.",
)


def with_data(likelihood: MarginalLikelihood, data: FloatArray) -> MarginalLikelihood:
    """The likelihood of other data (M,) on the same mask with the same noise."""
    white = likelihood.whitened
    d = white.noise.whiten(data)
    q, _ = np.linalg.qr(white.columns)
    projected = d - q @ (q.T @ d)
    return replace(
        likelihood,
        wd=np.asarray(likelihood.blurring.T @ white.noise.whiten_transposed(projected)),
        dd=float(projected @ projected),
        whitened=replace(white, data=d),
    )


def clump(subject: Subject) -> FloatArray:
    """Drizzled image (ny, nx) of a clump beside the host's centre, along the host's major axis."""
    host = subject.scene.host_profile
    away = _CLUMP_PLACE * host.r_eff
    profile = replace(
        host,
        flux=_CLUMP_SHARE * host.flux,
        r_eff=_CLUMP_SIZE * host.r_eff,
        n=1.0,
        q=1.0,
        x=host.x + away * math.cos(host.phi),
        y=host.y + away * math.sin(host.phi),
    )
    return subject.simulation.observation.optics.sersic_image(profile, subject.scene.lens)


def residual(
    problem: Problem, data: FloatArray, clean: FloatArray, noise: FloatArray, lens: PowerLawLens, model: SourceModel
) -> tuple[float, float]:
    """What an inversion leaves of an image without noise, rms in units of the noise, and the ln lambda that it took.

    ``data`` are the image with noise, for which that lambda is best, ``clean`` the one without, ``noise`` its standard
    deviation, all (ny, nx).
    """
    mask = problem.mask
    strength = find_strength(with_data(problem.likelihood, data[mask]), lens, model).ln_lambda
    bare = with_data(problem.likelihood, clean[mask])
    inversion = invert(bare, lens, strength, model)
    arc = bare.blurring @ inversion.lensing.apply(inversion.source.ravel())
    image = arc + problem.amplitude_images[:, mask].T @ bare.fit_amplitudes(arc)
    left = ((clean[mask] - image) / noise[mask])[~problem.core[mask]]
    return float(np.sqrt(np.mean(left**2))), strength


def measure(subject: Subject) -> list[Curve]:
    """All knobs of the inversion, each about the defaults of the others."""
    usual = subject.analysis
    observation, lens, more = subject.simulation.observation, subject.scene.lens, clump(subject)

    def one(changes: Mapping[str, object], analysis: Analysis) -> tuple[float, float]:
        problem = subject.problem(**changes)
        model = SourceModel(analysis.source_pixels, analysis.regularisation)
        plain, clumpy = (
            residual(problem, observation.image + extra, subject.clean + extra, observation.noise, lens, model)
            for extra in (0.0, more)
        )
        cost = least_cpu(lambda: ln_evidence(problem.likelihood, lens, plain[1], model))
        return cost, math.hypot(plain[0], clumpy[0]) / math.sqrt(2.0)

    def varied(knob: Knob, field: str, settings: tuple[int, ...]) -> Curve:
        found, default = Measuring(knob), getattr(usual, field)
        for value in sorted({*settings, default}):
            change = {} if value == default else {field: value}
            found.add(f"{value}", partial(one, change, usual), default=value == default)
        return found.curve()

    grid = Measuring(GRID)
    for side in (10, 15, 20, 30):
        analysis = replace(usual, source_pixels=(side, side))
        default = analysis.source_pixels == usual.source_pixels
        grid.add(f"{side} x {side}", partial(one, {}, analysis), default=default)
    regularisation = Measuring(REGULARISATION)
    for name in ("zeroth", "gradient", "curvature"):
        for envelope in (True, False):
            analysis = replace(usual, regularisation=name)
            change = {} if envelope == usual.source_envelope else {"source_envelope": envelope}
            regularisation.add(
                f"{name}, {'envelope' if envelope else 'no envelope'}",
                partial(one, change, analysis),
                default=(name, envelope) == (usual.regularisation, usual.source_envelope),
            )
    return [
        grid.curve(),
        varied(SUBRAYS, "subrays", (1, 3, 4)),
        varied(MARGIN, "ray_margin", (0, 2, 8)),
        varied(PSF_RADIUS, "psf_radius", (5, 10, 20)),
        regularisation.curve(),
    ]
