"""Derivatives of rays, of light and of the image model against differences of what they are derivatives of."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from engine.conventions import FloatArray
from engine.imaging.observation import Observation
from engine.lensing.power_law import source_position
from engine.lensing.ray_derivatives import LENS_DERIVATIVES, ray_constants, ray_derivatives
from engine.light.derivatives import LightDerivatives
from engine.light.rendering import render_sersic, rendered, sample_sersic
from engine.light.sersic import profile_of
from engine.parametric import model as image_model
from engine.parametric.model import ImageModel, weights_sigma
from engine.parametric.parameters import ParameterSpace, lens_of
from engine.simulation.simulate import Simulation

LENSES = {
    "sheared": [1.2, 0.08, 0.05, 2.1, 0.02, -0.03, 0.03, -0.02],
    "flat and shallow": [0.9, 0.4, -0.35, 1.7, 0.02, -0.03, 0.0, 0.01],
    "round and isothermal": [1.2, 0.0, 0.0, 2.0, 0.02, -0.03, 0.0, 0.0],
}
AXIS = (np.arange(100) - 49.5) * 0.05


def central(function: Callable[[FloatArray], FloatArray], values: FloatArray, k: int, step: float) -> FloatArray:
    ahead, behind = values.copy(), values.copy()
    ahead[k] += step
    behind[k] -= step
    return (function(ahead) - function(behind)) / (2.0 * step)


@pytest.mark.parametrize("name", LENSES)
def test_rays_move_with_the_lens_as_their_differences_say(name: str) -> None:
    values = np.array(LENSES[name])
    x, y = np.random.default_rng(1).uniform(-3, 3, (2, 2000))
    far = np.hypot(x - values[4], y - values[5]) > 0.02
    x, y = x[far], y[far]
    rays, constants = np.empty((x.size, 2, LENS_DERIVATIVES)), ray_constants(lens_of(values))
    beta = np.array([ray_derivatives(*at, constants, *out) for *at, out in zip(x, y, rays, strict=True)]).T
    found = rays.transpose(1, 2, 0)
    # A round lens is taken for one with e = 1e-6, the series end at 1e-9.
    assert np.allclose(beta, source_position(lens_of(values), x, y), rtol=0, atol=3e-6)
    for k in range(LENS_DERIVATIVES):
        # Differences over 1e-6: rounding of 1e-15 / 1e-6, and third derivatives near the centre.
        moved = central(lambda v: np.array(source_position(lens_of(v), x, y)), values, k, 1e-6)
        assert np.allclose(found[:, k], moved, rtol=3e-6, atol=3e-5), k


@pytest.mark.parametrize("n", [0.5, 2.0, 4.0])
@pytest.mark.parametrize("lensed", [True, False])
def test_light_changes_as_differences_of_finer_renderings_say(n: float, lensed: bool) -> None:
    shape = np.array([math.log(0.3), n, 0.1, 0.05, 0.11, 0.052])
    lens = np.array(LENSES["sheared"]) if lensed else np.empty(0)
    values, first = np.concatenate([lens, shape]), lens.size

    def light(v: FloatArray) -> FloatArray:
        behind = lens_of(v[:first]) if lensed else None
        return render_sersic(profile_of(v[first:]), AXIS, AXIS, 0.05, behind, 1e-6)

    behind = lens_of(lens) if lensed else None
    leaves = rendered(profile_of(shape), AXIS, AXIS, 0.05, behind, 1e-3).leaves
    found = LightDerivatives(profile_of(shape), behind).integrated(AXIS, AXIS, 0.05, leaves)
    assert found.shape[0] == values.size
    for k in range(values.size):
        moved = central(light, values, k, 1e-4)
        # The cells are those of a tolerance of 1e-3 of the peak; differences of renderings at that are off by 0.05.
        assert np.linalg.norm(found[k] - moved) < 6e-3 * np.linalg.norm(moved), k


@pytest.mark.parametrize("shear", [True, False])
def test_samples_change_as_their_differences_say(shear: bool) -> None:
    lens = np.array(LENSES["sheared"])[: 8 if shear else 6]
    values = np.concatenate([lens, [math.log(0.3), 1.3, 0.1, 0.05, 0.11, 0.052]])
    found = LightDerivatives(profile_of(values[-6:]), lens_of(lens), shear=shear).sampled(AXIS, AXIS[:40], 0.05)
    assert found.shape == (values.size, 40, 100)
    for k in range(values.size):
        moved = central(
            lambda v: sample_sersic(profile_of(v[-6:]), lens_of(v[:-6]), AXIS, AXIS[:40], 0.05), values, k, 1e-5
        )
        # Beside the cusp a difference over 1e-5 arcsec is not the derivative to better than 1e-4.
        assert np.linalg.norm(found[k] - moved) < 3e-4 * np.linalg.norm(moved), k


def test_a_jacobian_renders_nothing_again(simulation: Simulation, monkeypatch: pytest.MonkeyPatch) -> None:
    rendered_so_far: list[object] = []

    def counted(*given: object) -> object:
        rendered_so_far.append(given)
        return rendered(*given)  # type: ignore[arg-type]

    monkeypatch.setattr(image_model, "rendered", counted)
    model, values = _model_of(simulation.observation)
    model.residuals(values)
    assert len(rendered_so_far) == 2, "deflector and host"
    first = model.jacobian(values)
    monkeypatch.delattr(image_model, "LightDerivatives")
    # The search ends where the next one begins: its derivatives are those that were had there.
    assert np.array_equal(model.jacobian(values), first)
    assert len(rendered_so_far) == 2


def test_a_correction_begins_with_agn_images_where_they_stand(simulation: Simulation) -> None:
    observation = simulation.observation
    model, values = _model_of(observation)
    model.columns(values)
    moved = values.copy()
    moved[:2] += 3e-4
    exact = observation.point_source(*moved[:2].tolist()).ravel() * model.weight
    # As long as an image moves less than 5e-4 arcsec it keeps what the exposures make of it elsewhere.
    assert not np.allclose(model.columns(moved)[:, 0], exact, rtol=0, atol=1e-9 * exact.max())
    corrected = model.corrected(moved)
    assert np.allclose(corrected.columns(moved)[:, 0], exact, rtol=0, atol=1e-12 * exact.max())


def _model_of(observation: Observation) -> tuple[ImageModel, FloatArray]:
    """The image model of HE0435's observation with one AGN image, some way from its optimum."""
    space = ParameterSpace(1, deflector=True, shear=False)
    ny, nx = observation.shape
    whole = slice(0, ny), slice(0, nx)
    model = ImageModel(observation, space, weights_sigma(observation), whole, subrays=2, exact=True)
    lens = LENSES["sheared"][:6]
    return model, np.array([1.1, 0.4, 0.0, 4.0, 0.05, 0.02, 0.0, 0.0, *lens, -1.0, 2.0, 0.1, 0.05, 0.05, 0.02])
