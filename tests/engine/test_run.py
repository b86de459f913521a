"""A whole run: what comes back. That it is the same bits in every process is test_end_to_end's, on real workers."""

import io
import math
from dataclasses import replace

import numpy as np
import pytest

from engine import (
    STAGES,
    Analysis,
    Host,
    Realization,
    RunResult,
    SpecError,
    analyse,
    compare,
    generator,
    realization_from_dict,
    run,
)
from engine.figures import run_figure
from engine.parametric.fit import ParametricFit
from engine.result import BUDGETED, ERROR_STAGES, INDEX_PRIORS
from engine.simulation.simulate import Simulation, simulate_realization
from engine.spec.analysis import ESTIMATORS
from tests.engine.conftest import HELD_INDEX, cut


@pytest.fixture(scope="module")
def stages_told() -> list[str]:
    """Stages as the run of this module tells them."""
    return []


@pytest.fixture(scope="module")
def result(realization: Realization, stages_told: list[str]) -> RunResult:
    def tell(stage: str, _: float) -> None:
        if stage not in stages_told:
            stages_told.append(stage)

    return run(realization, tell)


def test_a_run_reports_everything_finite(result: RunResult) -> None:
    answered = [(e.estimator, e.index_prior) for e in result.estimates]
    assert answered == [(estimator, prior) for estimator in ESTIMATORS for prior in INDEX_PRIORS]
    for estimate in result.estimates:
        for name in ("magnitude", "r_eff", "r_eff_galfit", "n", "q", "position_angle", "x", "y"):
            quantity = getattr(estimate, name)
            assert math.isfinite(quantity.mean)
            assert math.isfinite(quantity.sd)
            assert quantity.bias is not None
            assert quantity.truth is not None
    assert result.estimate("paper", "fixed").n.bias == 0.0
    assert [p.name for p in result.lens] == ["theta_E", "q", "phi", "slope", "x", "y", "ln_lambda"]
    assert [stage.stage for stage in result.stages] == list(STAGES)
    assert result.aperture is not None
    assert math.isfinite(result.aperture.magnitude.mean)
    assert (result.regularisation, result.noise_treatment, result.profile) == ("curvature", "covariance", "standard")
    assert result.ln_evidence is not None
    assert result.condition_number is not None
    for number in (result.ln_evidence, result.chi2, result.condition_number, result.arc_magnitude):
        assert math.isfinite(number)
    assert result.chain is not None
    assert result.chain.evaluations > 100
    assert len(result.engine_digest) == 64


def test_a_chain_too_short_is_said_to_be(result: RunResult) -> None:
    assert result.chain is not None
    assert result.chain.status == "not_converged"
    assert any("chain" in warning for warning in result.warnings)


def test_the_host_and_its_surroundings_are_as_the_paper_defines_them(result: RunResult) -> None:
    # The catalogue's magnification of this host is 2.64 mag, and the AGN's total is 18.26.
    assert result.arc_magnitude == pytest.approx(20.5 - 2.64, abs=0.03)
    assert result.agn_contrast == pytest.approx(18.26 - result.arc_magnitude, abs=0.02)
    assert result.surface_brightness == pytest.approx(20.5 + 2.5 * math.log10(2 * math.pi * 0.39**2), abs=1e-9)


def test_even_a_coarse_reconstruction_finds_the_host(result: RunResult) -> None:
    image = result.estimate("image", "wide")
    # No grid to be coarse: within 3.5 of its own deviations, and those are below 0.02 mag and 2 % at this brightness.
    for quantity, most in ((image.magnitude, 0.02), (image.r_eff, 0.02 * 0.39), (image.n, 0.1)):
        assert quantity.bias is not None
        assert quantity.sd < most
        assert abs(quantity.bias) < 3.5 * quantity.sd
    # 12 x 12 cells of 0.12 arcsec; four draws. Measured at 21.5 mag and brighter: 0.05 mag, and 0.3 for the paper's.
    assert result.estimate("projected", "free").magnitude.bias == pytest.approx(0.0, abs=0.1)
    assert result.estimate("paper", "free").magnitude.bias == pytest.approx(0.2, abs=0.15)


def test_progress_names_the_stages_in_order(result: RunResult, stages_told: list[str]) -> None:
    assert stages_told == [stage.stage for stage in result.stages] == list(STAGES)


def test_an_analysis_is_blind_and_the_comparison_adds_the_truth_alone(
    simulation: Simulation, realization: Realization, fit: ParametricFit
) -> None:
    found = analyse(simulation.observation, realization.analysis, generator(realization, 1), fit=fit)
    answered = [(e.estimator, e.index_prior) for e in found.estimates]
    assert answered == [(estimator, prior) for estimator in ESTIMATORS for prior in ("wide", "free")]
    assert all(estimate.magnitude.bias is None for estimate in found.estimates)
    assert all(parameter.value.truth is None for parameter in found.lens)
    assert found.inversion is not None
    assert found.inversion.source_plane.source_truth is None
    told = compare(found, realization, simulation)
    assert [e.magnitude.mean for e in found.estimates] == [e.magnitude.mean for e in told.estimates]
    assert [p.value.sd for p in found.lens] == [p.value.sd for p in told.lens]
    for estimate in told.estimates:
        assert estimate.magnitude.bias == pytest.approx(estimate.magnitude.mean - 20.5)


def test_image_alone_needs_no_chain_and_says_the_same(realization: Realization, result: RunResult) -> None:
    seen: list[str] = []
    alone = replace(realization, analysis=replace(realization.analysis, estimators=("image",)))
    found = run(alone, lambda stage, _: seen.append(stage))
    assert [stage.stage for stage in found.stages] == seen == list(STAGES[:2])
    assert found.estimates == tuple(e for e in result.estimates if e.estimator == "image")
    assert (found.chain, found.ln_evidence, found.condition_number, found.aperture) == (None, None, None, None)
    # Of the parametric fit, whose noise map holds the errors of the PSF as well.
    assert found.chi2 / found.degrees_of_freedom == pytest.approx(1.0, abs=0.1)
    slope = next(parameter.value for parameter in found.lens if parameter.name == "slope")
    assert abs(slope.bias or 9.0) < 4.0 * slope.sd
    assert found.products is not None
    arrays = found.products.arrays()
    assert {"image", "model", "arc_model", "residual", "mask"} <= arrays.keys()
    assert not {"source", "chain"} & arrays.keys()
    figure = run_figure(found)
    assert len(figure.axes) == 6


def test_a_prior_of_n_that_no_fit_of_the_image_meets_is_missing_with_a_warning(
    simulation: Simulation, realization: Realization, fit: ParametricFit
) -> None:
    alone = replace(realization.analysis, estimators=("image",))
    rng = np.random.default_rng(0)
    whole = analyse(simulation.observation, alone, rng, fit=fit, fixed_index=HELD_INDEX)
    assert len(whole.estimates) == len(INDEX_PRIORS)
    lacking = replace(fit, hosts={"wide": fit.hosts["wide"]})
    found = analyse(simulation.observation, alone, rng, fit=lacking, fixed_index=HELD_INDEX)
    assert found.estimates == whole.estimates[:1]
    assert [warning.split(":")[0] for warning in found.warnings] == [
        "image estimator, n free",
        "image estimator, n fixed",
    ]


def test_a_system_of_ones_own_without_deflector_light_and_with_shear(realization: Realization) -> None:
    """And of one estimator: one that is not asked for has no answer."""
    own = replace(cut(), deflector=None)
    asked = replace(realization.analysis, estimators=("projected",))
    found = run(replace(realization, system=own, mass_model="epl_shear", analysis=asked))
    names = [parameter.name for parameter in found.lens]
    assert names == ["theta_E", "q", "phi", "slope", "x", "y", "gamma1", "gamma2", "ln_lambda"]
    shear = next(parameter for parameter in found.lens if parameter.name == "gamma1")
    # The catalogue's shear, found without having been told: within the coarse grid's model error.
    assert shear.value.mean == pytest.approx(0.040, abs=0.03)
    assert found.estimate("projected", "free").magnitude.bias == pytest.approx(0.0, abs=0.15)
    assert {estimate.estimator for estimate in found.estimates} == {"projected"}
    # The aperture lies where `paper` puts it.
    assert found.aperture is None
    assert not any("aperture" in warning for warning in found.warnings)


def test_a_slope_without_a_mass_model_is_refused_by_field() -> None:
    with pytest.raises(SpecError) as caught:
        run(Realization(system="HE0435", l_eta=0.9, host=Host(n=2.0, r_eff=0.39, magnitude=21.0)))
    assert caught.value.field == "l_eta"


def test_the_figure_shows_six_panels(result: RunResult) -> None:
    figure = run_figure(result)
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=60)
    assert data.getvalue().startswith(b"\x89PNG")
    # Six panels and their colour bars.
    assert len(figure.axes) == 12
    with pytest.raises(ValueError, match="products"):
        run_figure(replace(result, products=None))


def test_the_profile_paper_is_the_paper_where_it_states_its_settings() -> None:
    analysis = Analysis(profile="paper")
    assert analysis.source_pixels == (30, 30)
    assert analysis.regularisation == "curvature"
    assert analysis.draws == 30
    assert not analysis.source_envelope
    assert analysis.noise_treatment == "diagonal"


def test_what_is_given_beside_a_profile_counts() -> None:
    assert Analysis(profile="reference", walkers=20).walkers == 20
    assert Analysis(profile="reference").chain_length > Analysis().chain_length > Analysis(profile="draft").chain_length
    spec = {"profile": "draft", "max_steps": 77}
    read = realization_from_dict({**_HE0435, "analysis": spec}).analysis
    assert (read.profile, read.max_steps, read.walkers) == ("draft", 77, Analysis(profile="draft").walkers)
    with pytest.raises(SpecError, match="profile"):
        realization_from_dict({**_HE0435, "analysis": {"profile": "quick"}})


_HE0435 = {"system": "HE0435", "l_eta": 1.0, "host": {"n": 2.0, "r_eff": 0.39, "magnitude": 20.5}}


def test_the_noise_of_an_image_does_not_depend_on_how_it_is_analysed(realization: Realization) -> None:
    here = simulate_realization(realization)
    there = simulate_realization(replace(realization, analysis=Analysis(profile="draft")))
    other = simulate_realization(replace(realization, seed=realization.seed + 1))
    assert np.array_equal(here.observation.image, there.observation.image)
    assert not np.array_equal(here.observation.image, other.observation.image)


def test_each_estimate_carries_its_numerical_error_by_stage(result: RunResult) -> None:
    assert result.chain is not None
    for estimate in result.estimates:
        assert estimate.budget is not None
        for name in BUDGETED:
            parts = getattr(estimate.budget, name)
            stages = [getattr(parts, stage) for stage in ERROR_STAGES]
            assert all(math.isfinite(stage) and stage >= 0.0 for stage in stages)
            assert parts.total == pytest.approx(math.hypot(*stages))
            if estimate.estimator == "image":
                assert (parts.grid, parts.sampling, parts.draws) == (0.0, 0.0, 0.0)
                continue
            # The mean of k draws, whatever the chain's share of its variance is: k is below N here.
            fitted, samples = estimate.draws - estimate.failed, result.chain.effective_samples
            spread = getattr(estimate, name).sd
            assert parts.sampling == pytest.approx(spread / math.sqrt(samples))
            assert math.hypot(parts.sampling, parts.draws) == pytest.approx(spread / math.sqrt(min(fitted, samples)))
    # n is held: nothing moves it, while the map of a coarse grid moves the magnitude.
    held = result.estimate("paper", "fixed").budget
    assert held is not None
    assert held.n.total == 0.0
    assert held.magnitude.grid > 1e-4
