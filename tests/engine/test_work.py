"""What is computed is counted: the same for the same work, whoever does it, and no more than a scene needs."""

import contextlib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from engine import Host, PosteriorError, Realization, Work, analyse, measure_image, run
from engine.lensing.power_law import PowerLawLens
from engine.light import rendering
from engine.light.derivatives import LightDerivatives
from engine.light.sersic import SersicProfile
from engine.likelihood.evidence import invert, ln_evidences
from engine.likelihood.problem import prepare_problem
from engine.likelihood.strength import find_strength
from engine.parametric.fit import ParametricFit
from engine.simulation.scene import Scene
from engine.simulation.simulate import Simulation, simulate
from engine.source.regularisation import SourceModel
from engine.work import count, counted
from tests.engine.conftest import QUICK, cut
from tests.engine.true_fit import true_fit

LENS = PowerLawLens(1.2, 0.8, 0.3, 2.0)
PROFILE = SersicProfile(1.0, 0.3, 2.0, 0.7, 0.4, 0.05, 0.02)
AXIS = (np.arange(40) - 19.5) * 0.08


def test_a_rendering_counts_its_pixels_and_every_ray_that_it_traced(monkeypatch: pytest.MonkeyPatch) -> None:
    traced = []

    def tracing(x: np.ndarray, *rest: Any) -> None:
        traced.append(x.size)
        original(x, *rest)

    original = rendering.trace_rays
    monkeypatch.setattr(rendering, "trace_rays", tracing)
    with counted() as tally:
        rendering.render_sersic(PROFILE, AXIS, AXIS, 0.08, LENS)
    assert tally.work() == Work(pixels_rendered=1600, rays_traced=sum(traced))
    # One ray a pixel, a halo of two, and what is refined.
    assert sum(traced) > 44**2
    with counted() as direct:
        rendering.render_sersic(PROFILE, AXIS, AXIS, 0.08)
    assert direct.work() == Work(pixels_rendered=1600)


def test_derivatives_count_each_of_their_images_and_their_rays_once() -> None:
    with counted() as tally:
        LightDerivatives(PROFILE, LENS, shear=False).sampled(AXIS, AXIS, 0.08)
    assert tally.work() == Work(pixels_rendered=12 * 1600, rays_traced=1600)


def test_an_inversion_counts_rays_columns_and_evaluations(scene: Scene, simulation: Simulation) -> None:
    model, lenses = SourceModel((9, 10)), [scene.lens] * 3
    with counted() as layout:
        likelihood = prepare_problem(simulation.observation, true_fit(scene), QUICK).likelihood
    # Four AGN images, deflector and background.
    assert layout.work().columns_solved == 6
    with counted() as tally:
        ln_evidences(likelihood, lenses, [0.0] * 3, model)
    rays = likelihood.rays.x.size
    assert tally.work() == Work(rays_traced=3 * rays, columns_solved=3 * 90, evidence_evaluations=3)
    with counted() as tally:
        strength = find_strength(likelihood, scene.lens, model)
        invert(likelihood, scene.lens, strength.ln_lambda, model)
    number = strength.factorisations
    assert tally.work() == Work(
        rays_traced=2 * rays, columns_solved=(number + 1) * 90, evidence_evaluations=number
    )  # fmt: skip


def test_what_is_counted_within_counts_for_what_surrounds_it_also_where_it_fails() -> None:
    with counted() as outer:
        count("rays_traced", 1)
        with contextlib.suppress(PosteriorError), counted() as inner:
            count("rays_traced", 2)
            raise PosteriorError("no")
        count("columns_solved", 4)
    assert inner.work() == Work(rays_traced=2)
    assert outer.work() == Work(rays_traced=3, columns_solved=4)
    count("rays_traced", 5)
    assert outer.work() + inner.work() == Work(rays_traced=5, columns_solved=4)


def test_simulations_that_run_at_once_count_as_they_do_alone(scene: Scene) -> None:
    def work(one: Scene) -> Work:
        with counted() as tally:
            simulate(one, "author", np.random.default_rng(0))
        return tally.work()

    scenes = [scene, replace(scene, deflector=None), replace(scene, agn=()), scene]
    alone = [work(one) for one in scenes]
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(work, scenes)) == alone
    assert alone[0] == alone[3]
    assert alone[1].pixels_rendered < alone[0].pixels_rendered


def test_a_run_without_a_chain_evaluates_no_evidence_and_the_same_run_counts_the_same() -> None:
    host = Host(n=2.0, r_eff=0.39, magnitude=20.5)
    alone = Realization(system=cut(), l_eta=1.0, host=host, analysis=replace(QUICK, estimators=("image",)))
    first, second = run(alone), run(alone)
    assert first.work == second.work
    assert (first.work.parameters_sampled, first.work.evidence_evaluations) == (0, 0)
    # Amplitudes alone: six at most in every solve.
    assert 0 < first.work.columns_solved < 6 * 400
    assert first.work.pixels_rendered > 0 < first.work.rays_traced


def test_a_chain_counts_its_dimensions_and_evaluations_on_top_of_the_fit(
    simulation: Simulation, fit: ParametricFit
) -> None:
    found = analyse(simulation.observation, QUICK, np.random.default_rng(0), fit=fit)
    assert found.inversion is not None
    chain = found.inversion.chain.summary
    assert found.work.parameters_sampled == len(found.lens) == 7
    assert found.work.evidence_evaluations == chain.evaluations
    # Source pixels of each evaluation, of each draw and of the best, six amplitudes, and the grid of 17 x 17 nodes that
    # the error of the 12 x 12 is told by.
    assert found.work.columns_solved == (chain.evaluations + QUICK.draws + 1) * 144 + 6 + 17**2


def test_a_measurement_counts_its_fit_and_an_inversion_that_failed(
    simulation: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(*_: Any, **__: Any) -> None:
        count("evidence_evaluations", 17)
        raise PosteriorError("no way")

    monkeypatch.setattr("engine.reconstruction.find_optimum", failing)
    found = measure_image(simulation.observation, profile="draft", agn_images=4, shear=False)
    assert found.inversion is None
    assert found.work.evidence_evaluations > 17
    assert found.to_dict()["work"] == {
        "pixels_rendered": found.work.pixels_rendered,
        "rays_traced": found.work.rays_traced,
        "columns_solved": found.work.columns_solved,
        "parameters_sampled": 0,
        "evidence_evaluations": found.work.evidence_evaluations,
    }
