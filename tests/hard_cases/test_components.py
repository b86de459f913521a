"""Components of nothing: left out, or there with the value zero, they give the same numbers."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import sparse

from engine import Analysis, Host, Realization, analyse
from engine.likelihood.amplitudes import LinearData
from engine.likelihood.evidence import invert
from engine.likelihood.problem import prepare_problem
from engine.reconstruction import Reconstruction
from engine.simulation.scene import PointSource, Scene, build_scene
from engine.simulation.simulate import Simulation, simulate
from engine.source.regularisation import SourceModel
from engine.spec.instrument import Optics
from tests.engine.conftest import QUICK, cut
from tests.engine.explicit_inversion import LENS, Explicit, stamp, stamp_likelihood
from tests.engine.true_fit import true_fit

MODEL = SourceModel((11, 12))


def observed(scene: Scene) -> Simulation:
    return simulate(scene, "author", np.random.default_rng(4))


def assert_same_image(one: Simulation, other: Simulation) -> None:
    for name in ("image", "noise"):
        first, second = getattr(one.observation, name), getattr(other.observation, name)
        assert np.abs(first - second).max() <= 1e-12 * np.abs(first).max()


@pytest.mark.parametrize("component", ["agn", "deflector", "optics"])
def test_a_component_without_light_is_no_component_of_the_sky(scene: Scene, component: str) -> None:
    """AGN and a deflector of zero flux, and optics that spoil nothing, beside a scene without them.

    Could go wrong: another path through convolution, noise or random numbers. Holds: image and noise map, noise drawn
    and all, are the same to 1e-12 of the brightest pixel.
    """
    nothing: dict[str, tuple[Any, Any]] = {
        "agn": ((), tuple(PointSource(one.name, one.x, one.y, 0.0) for one in scene.agn)),
        "deflector": (None, None if scene.deflector is None else replace(scene.deflector, flux=0.0)),
        "optics": (scene.optics, Optics(defocus_nm=0.0, jitter=0.0)),
    }
    absent, zero = (replace(scene, **{component: value}) for value in nothing[component])
    assert_same_image(observed(absent), observed(zero))


def test_shear_of_zero_is_no_shear_from_the_sky_to_the_answer() -> None:
    """A mass model whose shear is stated as zero, and one that states none.

    Could go wrong: a shear that is there is sampled. Holds: image, posterior of the lens and the host are the same to
    1e-12, neither samples a shear, and both count the same work.
    """
    found: list[Reconstruction] = []
    host = Host(n=2.0, r_eff=0.39, magnitude=20.5)
    for shear in (None, (0.0, 0.0)):
        system = cut()
        mass = replace(system.mass_models["recommended"]["1.0"], shear=shear)
        system = replace(system, mass_models={"recommended": {"1.0": mass}})
        scene = build_scene(Realization(system=system, l_eta=1.0, host=host))
        assert (scene.lens.gamma1, scene.lens.gamma2) == (0.0, 0.0)
        analysis = replace(QUICK, estimators=("image",))
        found.append(analyse(observed(scene).observation, analysis, np.random.default_rng(0), agn_images=4))
    first, second = found
    assert first.work == second.work
    assert [parameter.name for parameter in first.lens] == ["theta_E", "q", "phi", "slope", "x", "y"]
    for one, other in zip(first.lens, second.lens, strict=True):
        assert other.value.mean == pytest.approx(one.value.mean, rel=1e-12)
    for a, b in zip(first.estimates, second.estimates, strict=True):
        for name in ("magnitude", "r_eff", "n"):
            assert getattr(b, name).mean == pytest.approx(getattr(a, name).mean, rel=1e-12)


@pytest.mark.parametrize("kept", [(), ("deflector", "background"), ("agn", "background"), ("agn",)])
def test_an_amplitude_that_is_known_to_be_zero_is_no_amplitude(kept: tuple[str, ...]) -> None:
    """A scene without AGN, deflector or background, each left out, or there with a prior of next to nothing round zero.

    Could go wrong: a component that is not there costs or changes something. Holds: ln Z and the source are the same
    to 1e-12.
    """
    scene = Explicit(columns=kept)
    full = Explicit(columns=(*kept, *(c for c in ("agn", "deflector", "background") if c not in kept)))
    free = scene.linear.columns.shape[1]
    held = np.arange(full.linear.columns.shape[1]) >= free
    # The engine bounds how far apart the columns' scales may be: a thousandth of the light of each, held to 1e-7.
    columns, precisions = full.linear.columns * np.where(held, 1e-3, 1.0), np.where(held, 1e14, 0.0)
    bound = stamp_likelihood(
        LinearData(scene.linear.data, scene.linear.covariance, columns, precisions),
        stamp(scene.psf), scene.likelihood().rays, np.nonzero(scene.chosen), np.nonzero(scene.rayed | scene.chosen),
    )  # fmt: skip
    without, known = (invert(likelihood, LENS, 0.0, MODEL) for likelihood in (scene.likelihood(), bound))
    assert known.ln_evidence == pytest.approx(without.ln_evidence, rel=1e-12)
    assert np.abs(known.source - without.source).max() < 1e-12 * np.abs(without.source).max()


def test_a_deflector_that_was_fitted_with_no_light_has_the_column_of_one_that_shines(
    scene: Scene, simulation: Simulation
) -> None:
    """A parametric fit that gives the deflector a flux of exactly zero.

    Could go wrong: its column is its image over its flux, 0/0. Holds: ln Z is the same to 1e-12.
    """
    fit, analysis = true_fit(scene), Analysis(noise_treatment="diagonal", source_pixels=(12, 12))
    assert fit.deflector is not None
    dark = replace(fit, deflector=replace(fit.deflector, flux=0.0))
    bright, found = (
        invert(prepare_problem(simulation.observation, one, analysis).likelihood, fit.lens, -9.0, SourceModel((12, 12)))
        for one in (fit, dark)
    )
    assert found.ln_evidence == pytest.approx(bright.ln_evidence, rel=1e-12)


def test_a_covariance_without_correlations_is_a_noise_map(scene: Scene, simulation: Simulation) -> None:
    """The covariance of an observation cut down to its diagonal, beside the noise map alone.

    Could go wrong: another factorisation, other numbers. Holds: ln Z and the source are the same to 1e-12, and so is
    the work.
    """
    observation, fit, model = simulation.observation, true_fit(scene), SourceModel((12, 12))
    assert observation.covariance is not None
    alone = replace(observation, covariance=sparse.diags(observation.noise.ravel() ** 2, format="csr"))
    found = [
        invert(
            prepare_problem(one, fit, Analysis(noise_treatment=treatment)).likelihood, fit.lens, -9.0, model
        )
        for one, treatment in ((observation, "diagonal"), (alone, "covariance"))
    ]  # fmt: skip
    assert found[1].ln_evidence == pytest.approx(found[0].ln_evidence, rel=1e-12)
    assert np.abs(found[1].source - found[0].source).max() < 1e-12 * np.abs(found[0].source).max()
