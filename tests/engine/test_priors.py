"""What is known of a lens beforehand: priors of its parameters, and the positions of the AGN images."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from engine import (
    Analysis,
    Host,
    Realization,
    Reconstruction,
    Simulation,
    SpecError,
    analyse,
    check_analysis,
    compare,
    load_system,
)
from engine.catalogue import system_names
from engine.experiment import analysis_of
from engine.lensing.lens_equation import solve_lens_equation
from engine.lensing.power_law import PowerLawLens
from engine.likelihood.evidence import ln_evidence
from engine.parametric.fit import ParametricFit
from engine.posterior.agn_positions import AgnPositions
from engine.posterior.target import Target, wide_prior
from engine.source.regularisation import SourceModel
from engine.spec.priors import ParameterPrior
from engine.spec.realization import realization_from_dict
from tests.engine.conftest import QUICK
from tests.engine.dense_oracle import Case

LENS = PowerLawLens(1.2, 0.75, 0.6, 2.05, 0.01, -0.02, 0.0, 0.0)
SYSTEM = "HE0435"
HOST = Host(n=2.0, r_eff=0.39, magnitude=20.5)


def realization(**analysis: object) -> Realization:
    return Realization(system=SYSTEM, l_eta=1.0, host=HOST, analysis=Analysis(profile="draft", **analysis))  # type: ignore[arg-type]


def test_positions_have_the_probability_that_the_lens_equation_gives_them() -> None:
    """Against the integral over source positions, each with its images; what is of second order in 0.5 mas is 0.01."""
    rng, sd, source = np.random.default_rng(3), 0.0005, np.array([0.04, -0.03])

    def images(beta: np.ndarray) -> np.ndarray:
        found = solve_lens_equation(LENS, float(beta[0]), float(beta[1]))
        bright = [image for image in found if abs(image.magnification) > 1e-2]
        return np.array([(image.x, image.y) for image in bright])

    true = images(source)
    measured = true + sd * rng.standard_normal(true.shape)
    step = 0.25 * sd / math.sqrt(len(true))
    offsets = step * np.arange(-14, 15)
    total = 0.0
    for dx in offsets:
        for dy in offsets:
            at = images(source + np.array([dx, dy]))
            nearest = np.argmin(((measured[:, None] - at[None]) ** 2).sum(axis=2), axis=1)
            chi2 = float(((measured - at[nearest]) ** 2).sum()) / sd**2
            total += math.exp(-0.5 * chi2 - 2 * len(true) * math.log(sd) - len(true) * math.log(2 * math.pi)) * step**2
    assert AgnPositions(measured, sd).ln_likelihood(LENS) == pytest.approx(math.log(total), abs=0.02)


def test_positions_prefer_the_lens_that_made_them() -> None:
    images = solve_lens_equation(LENS, 0.04, -0.03)
    positions = np.array([(image.x, image.y) for image in images if abs(image.magnification) > 1e-2])
    likelihood = AgnPositions(positions, 0.003).ln_likelihood
    for change in ({"q": 0.73}, {"theta_E": 1.21}, {"phi": 0.63}, {"x": 0.02}):
        assert likelihood(LENS.with_values(**change)) < likelihood(LENS) - 1.0


def test_the_target_is_evidence_prior_and_positions() -> None:
    likelihood, source = Case(amplitudes=1).likelihood(), SourceModel((9, 9))
    prior = wide_prior(LENS, shear=False).restricted({"slope": ParameterPrior(mean=2.0, sd=0.1)})
    positions = AgnPositions(np.array([[1.0, 0.3], [-0.9, -0.2]]), 0.01)
    values = Target(likelihood, prior, source).vector(LENS, 0.5)
    bare = ln_evidence(likelihood, LENS, 0.5, source)
    assert Target(likelihood, prior, source)(values) == pytest.approx(bare - 0.5 * (0.05 / 0.1) ** 2)
    both = Target(likelihood, prior, source, positions)(values)
    assert both == pytest.approx(bare - 0.125 + positions.ln_likelihood(LENS))


def test_a_prior_replaces_bounds_and_an_angle_is_one_modulo_pi() -> None:
    wide = wide_prior(LENS, shear=False)
    narrow = wide.restricted(
        {"q": ParameterPrior(low=0.6), "phi": ParameterPrior(low=0.5 + 2 * math.pi, high=0.7 + 2 * math.pi)}
    )
    assert (narrow.low[1], narrow.high[1]) == (0.6, 1.0)
    assert (narrow.low[2], narrow.high[2]) == pytest.approx((0.5, 0.7))
    assert np.array_equal(np.delete(narrow.low, [1, 2]), np.delete(wide.low, [1, 2]))
    start = narrow.inside(np.array([1.2, 0.3, 0.6, 2.0, 0.0, 0.0, 0.0]))
    assert narrow.holds(start)
    assert (start[0], start[2]) == (1.2, 0.6)


@pytest.mark.parametrize(
    ("document", "field"),
    [
        ({"slope": {"low": 2.1, "high": 1.9}}, "low, high"),
        ({"slope": {"mean": 2.0}}, "mean, sd"),
        ({"slope": {}}, "low, high, mean, sd"),
        ({"slope": {"mean": 2.0, "sd": 0.0}}, "sd"),
        ({"eta": {"low": 2.0}}, "priors"),
        ({"slope": {"low": float("nan")}}, "low"),
    ],
)
def test_a_prior_that_says_nothing_or_nonsense_is_refused(document: dict[str, object], field: str) -> None:
    with pytest.raises(SpecError, match=field):
        realization_from_dict({**realization().to_dict(), "analysis": {"priors": document}})


def test_a_prior_of_what_the_model_has_not_is_refused() -> None:
    wide = wide_prior(LENS, shear=False)
    with pytest.raises(SpecError, match="gamma1"):
        wide.restricted({"gamma1": ParameterPrior(low=0.0)})
    with pytest.raises(SpecError, match=r"priors\.q"):
        wide.restricted({"q": ParameterPrior(low=1.2)})


def test_what_the_system_has_not_is_refused_before_anything_is_computed() -> None:
    with pytest.raises(SpecError, match=r"analysis\.priors.*gamma1.*no shear"):
        check_analysis(realization(priors={"gamma1": ParameterPrior(low=0.0)}))
    sheared = replace(realization(priors={"gamma1": ParameterPrior(low=0.0)}), system="RXJ1131")
    check_analysis(sheared)
    single = replace(load_system(SYSTEM), agn=())
    with pytest.raises(SpecError, match="agn_position_sd"):
        check_analysis(replace(realization(agn_position_sd=0.01), system=single))


def test_what_is_not_used_leaves_the_digest_alone() -> None:
    plain = realization()
    assert "priors" not in plain.to_dict()["analysis"]
    assert "agn_position_sd" not in plain.to_dict()["analysis"]
    assert "background_sd" not in plain.to_dict()["analysis"]
    with_prior = realization(priors={"slope": ParameterPrior(mean=2.0, sd=0.1)}, agn_position_sd=0.003)
    assert with_prior.digest != plain.digest
    assert with_prior.observation_digest == plain.observation_digest
    assert realization_from_dict(with_prior.to_dict()) == with_prior


@pytest.mark.parametrize("name", system_names())
def test_every_system_states_its_priors_and_they_hold_its_models(name: str) -> None:
    system = load_system(name)
    for by_slope in system.mass_models.values():
        for mass in by_slope.values():
            for parameter, prior in system.priors.items():
                value = getattr(mass, parameter)
                assert (prior.low or -math.inf) < value < (prior.high or math.inf)
    assert {"theta_E", "q", "slope"} <= set(system.priors)


def measured(simulation: Simulation, fit: ParametricFit, **asked: object) -> Reconstruction:
    return analyse(
        simulation.observation,
        replace(QUICK, draws=10, max_steps=30, estimators=("paper",), **asked),  # type: ignore[arg-type]
        np.random.default_rng(1),
        fit=fit,
    )


@pytest.fixture(scope="module")
def plain(simulation: Simulation, fit: ParametricFit) -> Reconstruction:
    """Without priors, positions or a known background."""
    return measured(simulation, fit)


def test_priors_and_positions_narrow_the_posterior(
    simulation: Simulation, plain: Reconstruction, fit: ParametricFit
) -> None:
    told = measured(simulation, fit, priors={"slope": ParameterPrior(mean=2.0, sd=0.002)}, agn_position_sd=0.002)
    without, sd = ({p.name: p.value.sd for p in found.lens} for found in (plain, told))
    assert sd["slope"] == pytest.approx(0.002, rel=0.4)
    assert sd["slope"] < 0.5 * without["slope"]
    assert sd["theta_E"] < without["theta_E"]


def test_a_run_takes_the_systems_priors_where_it_states_none() -> None:
    stated = analysis_of(realization(priors={"slope": ParameterPrior(mean=2.0, sd=0.1)}))
    assert stated.priors["slope"] == ParameterPrior(mean=2.0, sd=0.1)
    assert stated.priors["q"] == load_system(SYSTEM).priors["q"]
    assert analysis_of(realization()).priors == load_system(SYSTEM).priors


def test_a_known_background_is_held_and_gives_the_host_its_wings_back(
    simulation: Simulation, plain: Reconstruction, fit: ParametricFit
) -> None:
    """The simulation's sky is taken off exactly. A free background of the ring takes 0.3 mag of `paper`'s host."""
    bias = {}
    for name, found in (("free", plain), ("known", measured(simulation, fit, background_sd=1e-3))):
        bias[name] = compare(found, realization(), simulation).estimate("paper", "wide").magnitude.bias
    assert bias["free"] is not None
    assert bias["known"] is not None
    assert abs(bias["known"]) < 0.1 < bias["free"]
