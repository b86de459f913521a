"""The predicted numerical error of runs against the true one.

    python -m benchmarks.error_budget [--runs 60] [--seconds 3600] [--systems HE0435 ...]

Realizations of the eight systems are drawn with a fixed seed; each is analysed with `draft`, `standard` and
`reference`, every third with `paper` too. The true error of an estimate (n in 0.3-8) is its distance from a converged
one of the same image:

    estimate - mean of 400 draws of a `reference` chain          (sampling, draws)
    + fit on the run's grid - fit on one of twice the nodes       (grid)
    + fit with 2 rays along a pixel - fit with 4                  (rendering)
    + fit with the PSF cut as in the run - cut at twice the radius (PSF)

the last three of the map of highest posterior at the best state of that chain. What is converged for a run of `paper`
has the data, noise and regularisation of `paper` and the walk of `reference`. `image` is fitted again from where it
ended, its light integrated to 1e-6, to a relative change of 1e-12.

Rows go to docs/tables/error_budget.jsonl as each realization ends, and what is there is not computed again; the table
that is made of them is docs/tables/error_budget.md.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from engine import Analysis, Estimate, Host, Observation, Realization, analyse, generator, simulate_realization
from engine.catalogue import system_names
from engine.conventions import FloatArray
from engine.digest import engine_digest
from engine.estimators.draws import source_draw
from engine.estimators.image import image_estimate
from engine.estimators.numerical_error import BestState, fits_of_map, numbers
from engine.estimators.refit import refit_draws
from engine.estimators.summaries import summarise
from engine.experiment import analysis_of
from engine.imaging.optics.exposed import ExposedOptics
from engine.lensing.power_law import PowerLawLens
from engine.light.sersic import SersicProfile
from engine.likelihood.evidence import invert
from engine.likelihood.problem import prepare_problem
from engine.likelihood.strength import find_strength
from engine.parametric.fit import GOOD_START, ParametricFit, fit_of
from engine.parametric.refine import polished, ranked
from engine.parametric.search import Task, find_starts, quick_fits
from engine.parametric.solution import Solution, minimise
from engine.posterior.start import prepare_target
from engine.result import BUDGETED, ERROR_STAGES
from engine.spec.analysis import ESTIMATORS, PROFILES, EstimatorName, ProfileName

TABLES = Path(__file__).resolve().parent.parent / "docs" / "tables"
ROWS, TABLE = TABLES / "error_budget.jsonl", TABLES / "error_budget.md"
SEED = 16
ON_MAPS: tuple[EstimatorName, ...] = tuple(name for name in ESTIMATORS if name != "image")
DRAWS, BATCH = 400, 25


def realizations(runs: int) -> list[tuple[Realization, tuple[ProfileName, ...]]]:
    """As many as `runs` runs need, the systems in turn, each with the profiles that it is analysed with."""
    rng, planned = np.random.default_rng(SEED), 0
    out: list[tuple[Realization, tuple[ProfileName, ...]]] = []
    names = system_names()
    while planned < runs:
        host = Host(
            n=round(float(rng.uniform(1.0, 4.0)), 2),
            r_eff=round(float(rng.uniform(0.2, 0.6)), 3),
            magnitude=round(float(rng.uniform(20.0, 22.0)), 2),
        )
        seed = int(rng.integers(2**31))
        realization = Realization(system=names[len(out) % len(names)], l_eta=1.0, host=host, seed=seed)
        every: tuple[ProfileName, ...] = ("reference", "draft", "standard")
        profiles = (*every, "paper")[: runs - planned] if len(out) % 3 == 2 else every[: runs - planned]
        out.append((realization, profiles))
        planned += len(profiles)
    return out


class Fine(ExposedOptics):
    """The exposures, with light integrated a hundred times finer."""

    def sersic_image(
        self, profile: SersicProfile, lens: PowerLawLens | None = None, tolerance: float = 1e-6
    ) -> FloatArray:
        """The finer of the tolerance that is asked for and 1e-6."""
        return super().sersic_image(profile, lens, min(tolerance, 1e-6))


def numbers_of(estimate: Estimate) -> FloatArray:
    return np.array([getattr(estimate, name).mean for name in BUDGETED])


def refined(solution: Solution, observation: Observation) -> Solution:
    """A parametric fit that goes on with finer light to a minimum that is one to rounding."""
    assert observation.response is not None
    fine = Fine(observation.response.psf, observation.response.geometry, observation.response.detector_kernel)
    model = copy(solution.model)
    model.observation = replace(observation, response=fine)
    found = replace(solution, model=model)
    for _ in range(4):
        found = minimise(found.model.corrected(found.values), found.start, found.values, 40, 1e-12)
    return found


def many_draws(
    observation: Observation, fit: ParametricFit, analysis: Analysis, samples: FloatArray, rng: np.random.Generator
) -> dict[str, FloatArray]:
    """Means of the estimators on maps over the draws at chain states (k, d), in batches that memory holds."""
    target = prepare_target(prepare_problem(observation, fit, analysis), fit, analysis)
    sums: dict[str, list[FloatArray]] = {}
    for begin in range(0, len(samples), BATCH):
        states = samples[begin : begin + BATCH]
        draws = [source_draw(target.invert(state), target.lens(state), rng) for state in states]
        for refit in refit_draws(draws, ON_MAPS, None, rng):
            answer = summarise(refit, observation.zero_point)
            if refit.index_prior == "wide" and answer is not None:
                fitted = answer.draws - answer.failed
                sums.setdefault(refit.estimator, []).append(np.append(fitted * numbers_of(answer), fitted))
    totals = {name: np.sum(parts, axis=0) for name, parts in sums.items()}
    return {name: total[:-1] / total[-1] for name, total in totals.items()}


def map_shifts(
    observation: Observation, fit: ParametricFit, analysis: Analysis, at_best: FloatArray
) -> dict[str, dict[str, FloatArray]]:
    """By estimator and stage: the fit to the map as the analysis makes it, less that to a finer one."""
    problem = prepare_problem(observation, fit, analysis)
    target = prepare_target(problem, fit, analysis)
    lens, ln_lambda, model = target.lens(at_best), float(at_best[-1]), target.source
    ny, nx = model.shape
    finer = replace(model, shape=(2 * ny, 2 * nx))
    strengths = [find_strength(problem.likelihood, lens, one, low=-30.0, high=10.0).ln_lambda for one in (model, finer)]
    rays = prepare_problem(observation, fit, replace(analysis, subrays=2 * analysis.subrays))
    wide = prepare_problem(observation, fit, replace(analysis, psf_radius=2 * analysis.psf_radius))
    maps = {
        "here": invert(problem.likelihood, lens, ln_lambda, model),
        "grid": invert(problem.likelihood, lens, ln_lambda + strengths[1] - strengths[0], finer),
        "rendering": invert(rays.likelihood, lens, ln_lambda, model),
        "psf": invert(wide.likelihood, lens, ln_lambda, model),
    }
    found = {stage: fits_of_map(BestState(lens, ln_lambda, one), ON_MAPS, None) for stage, one in maps.items()}
    return {
        name: {
            stage: numbers(found["here"][name, "wide"].profile) - numbers(found[stage][name, "wide"].profile)
            for stage in ("rendering", "psf", "grid")
        }
        for name in ON_MAPS
        if all((name, "wide") in found[stage] for stage in maps)
    }


def measured(realization: Realization, profiles: Sequence[ProfileName]) -> list[dict[str, Any]]:
    """A row for each profile and estimator."""
    simulation = simulate_realization(realization)
    observation, scene = simulation.observation, simulation.scene
    shear = scene.lens.gamma1 != 0.0 or scene.lens.gamma2 != 0.0
    priors = analysis_of(realization).priors
    task = Task(observation, scene.deflector is not None, shear, GOOD_START, priors)
    starts = find_starts(task, len(scene.agn), None, None)
    solution = polished(task, ranked(task, [quick_fits(task, group) for group in starts])[0])
    fit = fit_of(task, solution)
    converged_fit = fit_of(task, refined(solution, observation))
    from_exact = numbers_of(image_of(fit, observation)) - numbers_of(image_of(converged_fit, observation))
    rows: list[dict[str, Any]] = []
    converged: dict[bool, tuple[dict[str, FloatArray], dict[str, dict[str, FloatArray]]]] = {}
    for profile in sorted(profiles, key=["reference", "draft", "standard", "paper"].index):
        asked = Analysis(profile=profile, priors=priors)
        began = time.process_time()
        found = analyse(observation, asked, generator(replace(realization, analysis=asked), 1), fit=fit)
        seconds = time.process_time() - began
        assert found.inversion is not None
        own = profile == "paper"
        # The first of them is of `reference`, whose chain all but `paper` are compared with.
        if own not in converged:
            walk = {name: PROFILES["reference"][name] for name in ("walkers", "chain_length", "max_steps")}
            long, answer = Analysis(profile=profile, priors=priors, **walk), found.inversion
            if own:
                rng = generator(replace(realization, analysis=long), 1)
                again = analyse(observation, long, rng, fit=fit).inversion
                assert again is not None
                answer = again
            chain, rng = answer.chain, np.random.default_rng(realization.seed)
            at_best = chain.flat()[int(np.argmax(chain.ln_posterior.ravel()))]
            draws = many_draws(observation, fit, long, chain.thinned(DRAWS, rng), rng)
            converged[own] = draws, map_shifts(observation, fit, long, at_best)
        draws, shifts = converged[own]
        chain_summary = found.inversion.chain.summary
        for estimate in found.estimates:
            name = estimate.estimator
            if estimate.index_prior != "wide" or estimate.budget is None or (name != "image" and name not in shifts):
                continue
            budget = {q: {s: getattr(getattr(estimate.budget, q), s) for s in ERROR_STAGES} for q in BUDGETED}
            by_stage = {"image": from_exact} if name == "image" else shifts[name]
            chance = np.zeros(3) if name == "image" else numbers_of(estimate) - draws[name]
            rows.append(
                {
                    "digest": realization.digest,
                    "engine": engine_digest(),
                    "system": realization.system,
                    "profile": profile,
                    "estimator": name,
                    "n": scene.host.n,
                    "cpu_s": round(seconds, 2),
                    "effective_samples": round(chain_summary.effective_samples),
                    "sd": [getattr(estimate, q).sd for q in BUDGETED],
                    "predicted": budget,
                    "chance": chance.tolist(),
                    "shifts": {stage: shift.tolist() for stage, shift in by_stage.items()},
                }
            )
            print(summary_line(rows[-1]), flush=True)
    return rows


def image_of(fit: ParametricFit, observation: Observation) -> Estimate:
    return image_estimate(fit.hosts["wide"], "wide", observation.zero_point)


def ratios(rows: Sequence[dict[str, Any]]) -> FloatArray:
    """True by predicted errors (rows, quantities)."""
    true = np.array([np.sum([row["chance"], *row["shifts"].values()], axis=0) for row in rows])
    predicted = np.array(
        [[np.sqrt(sum(part**2 for part in row["predicted"][q].values())) for q in BUDGETED] for row in rows]
    )
    return np.asarray(true / predicted)


def summary_line(row: dict[str, Any]) -> str:
    found = " ".join(f"{value:+.2f}" for value in ratios([row])[0])
    return f"{row['system']} {row['profile']} {row['estimator']}: true by predicted {found} (magnitude, r_eff, n)"


HEAD = """# Predicted numerical errors

Written by `python -m benchmarks.error_budget` from its rows in error_budget.jsonl: the true numerical error of runs
beside the predicted one, of estimates with n in 0.3-8. `below 2` is the share of runs whose true error is less than
twice the predicted, `median` and `rms` are those of true by predicted (0.67 and 1 where errors are normal and the
prediction is right). Sizes are medians.
"""


def write(rows: Sequence[dict[str, Any]]) -> None:
    """The table of all rows."""
    runs = sorted({(row["digest"], row["profile"]) for row in rows})
    systems = sorted({row["system"] for row in rows})
    engines = ", ".join(f"`{digest[:8]}`" for digest in sorted({row["engine"] for row in rows}))
    lines = [HEAD, f"{len(runs)} runs of {len(systems)} systems ({', '.join(systems)}), engine {engines}.", ""]
    lines += ["| estimator | profile | runs | quantity | predicted | true | sd | below 2 | median | rms |"]
    lines += ["|---|---|---|---|---|---|---|---|---|---|"]
    for name in (*ESTIMATORS, "all but image"):
        for profile in ("all", *PROFILES):
            chosen = [
                row
                for row in rows
                if (row["estimator"] == name or (name == "all but image" and row["estimator"] != "image"))
                and profile in ("all", row["profile"])
            ]
            for place, quantity in enumerate(BUDGETED):
                if chosen and (quantity == "magnitude" or profile == "all"):
                    lines.append(_line(name, profile, quantity, place, chosen))
    lines += ["", "By stage, magnitude, all profiles: median of the predicted, and of the true by the predicted.", ""]
    lines += [
        "| estimator | rendering | | psf | | grid | | sampling and draws | |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    lines += [_stages(name, [row for row in rows if row["estimator"] == name]) for name in ON_MAPS]
    TABLE.write_text("\n".join([*lines, ""]))


def _line(name: str, profile: str, quantity: str, place: int, rows: Sequence[dict[str, Any]]) -> str:
    found = np.abs(ratios(rows)[:, place])
    true = [abs(np.sum([row["chance"], *row["shifts"].values()], axis=0)[place]) for row in rows]
    predicted = np.array(true) / found
    spread = [row["sd"][place] for row in rows]
    sizes = " | ".join(f"{np.median(values):.1e}" for values in (predicted, true, spread))
    below = f"{(found < 2.0).mean():.2f} | {np.median(found):.2f} | {np.sqrt((found**2).mean()):.2f}"
    return f"| `{name}` | {profile} | {len(rows)} | {quantity} | {sizes} | {below} |".replace(
        "`all but image`", "all but `image`"
    )


def _stages(name: str, rows: Sequence[dict[str, Any]]) -> str:
    cells = []
    for stage in ("rendering", "psf", "grid"):
        predicted = np.array([row["predicted"]["magnitude"][stage] for row in rows])
        true = np.abs([row["shifts"][stage][0] for row in rows])
        cells += [f"{np.median(predicted):.1e}", f"{np.median(true / predicted):.2f}"]
    chance = np.array([np.hypot(*(row["predicted"]["magnitude"][s] for s in ("sampling", "draws"))) for row in rows])
    true = np.abs([row["chance"][0] for row in rows])
    cells += [f"{np.median(chance):.1e}", f"{np.median(true / chance):.2f}"]
    return f"| `{name}` | {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--runs", type=int, default=60)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="begin no realization after so many")
    parser.add_argument("--systems", nargs="+", default=list(system_names()), help="those alone of the realizations")
    given = parser.parse_args()
    began = time.monotonic()
    rows = [json.loads(line) for line in ROWS.read_text().splitlines()] if ROWS.exists() else []
    known = {(row["digest"], row["engine"]) for row in rows}
    for realization, profiles in realizations(given.runs):
        if (realization.digest, engine_digest()) in known or realization.system_name not in given.systems:
            continue
        if time.monotonic() - began > given.seconds:
            break
        with threadpool_limits(1):
            found = measured(realization, profiles)
        with ROWS.open("a") as file:
            file.writelines(json.dumps(row) + "\n" for row in found)
        rows += found
        write(rows)


if __name__ == "__main__":
    main()
