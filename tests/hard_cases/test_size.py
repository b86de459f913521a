"""Problems that are large."""

import json
import subprocess
import sys
import textwrap

import pytest

GIB = 2**30

_PROBLEM = textwrap.dedent(
    """
    import json, resource, sys
    from dataclasses import replace
    import numpy as np
    from engine import Host, Realization, load_system, realization_from_dict
    from engine.likelihood.evidence import invert, ln_evidence
    from engine.likelihood.problem import prepare_problem
    from engine.likelihood.strength import find_strength
    from engine.simulation.scene import build_scene
    from engine.simulation.simulate import simulate
    from engine.source.regularisation import SourceModel
    from engine.spec.analysis import Analysis
    from tests.engine.true_fit import true_fit

    system = load_system("RXJ1131")
    mass = replace(system.mass_models["recommended"]["1.0"], theta_E=2.52, q=0.9)
    system = replace(
        system, agn=(), priors={}, mass_models={"recommended": {"1.0": mass}},
        exposures=replace(system.exposures, field_pixels=190),
    )
    scene = build_scene(Realization(system=system, l_eta=1.0, host=Host(n=2.0, r_eff=0.5, magnitude=20.0)))
    observation = simulate(scene, "handbook", np.random.default_rng(0)).observation
    problem = prepare_problem(observation, true_fit(scene), Analysis(noise_treatment=sys.argv[1]))
    model = SourceModel((20, 20))
    best = find_strength(problem.likelihood, scene.lens, model).ln_lambda
    found = invert(problem.likelihood, scene.lens, best, model)
    arc = problem.likelihood.blurring @ found.lensing.apply(found.source.ravel())
    freedom = int(problem.mask.sum()) - problem.likelihood.amplitudes - found.effective_parameters()
    chi2 = problem.likelihood.chi2(arc, problem.likelihood.fit_amplitudes(arc)) / freedom
    print(json.dumps({
        "pixels": int(problem.mask.sum()),
        "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
        "chi2": chi2,
    }))
    """
)


def assert_fits(noise_treatment: str) -> None:
    ended = subprocess.run(
        [sys.executable, "-c", _PROBLEM, noise_treatment], capture_output=True, text=True, timeout=800, check=False
    )
    assert ended.returncode == 0, ended.stderr
    found = json.loads(ended.stdout.splitlines()[-1])
    assert found["pixels"] > 20_000
    assert found["peak"] < 2 * GIB
    # 20,000 pixels: chi^2 per degree of freedom is known to 0.01; drizzled noise in a diagonal scatters twice as much.
    assert found["chi2"] == pytest.approx(1.0, abs=0.05)


@pytest.mark.long
def test_a_mask_of_twenty_thousand_pixels_fits_into_two_gibibytes() -> None:
    """A ring of 20,000 image pixels of 0.05 arcsec, with independent noise.

    Could go wrong: one dense matrix of mask x mask takes 3.2 GB. Holds: in a process of its own, simulation, layout,
    strength and inversion peak below 2 GiB of memory, and chi^2 per degree of freedom is one to 0.05.
    """
    assert_fits("diagonal")


@pytest.mark.long
def test_a_mask_of_twenty_thousand_pixels_with_correlated_noise_fits_into_two_gibibytes() -> None:
    """The same ring with the covariance of drizzled noise.

    Could go wrong: a dense covariance. Holds: as above, below 2 GiB.
    """
    assert_fits("covariance")
