"""What the paper's own recipe does to its answer: noise inflated over the arc, even pixels, consecutive states.

The same images are inverted four ways; the host is fitted by ``paper`` with n in 1-4 and compared run by run. Each
chain is summarised twice: by 30 states far apart with sources drawn from their posterior, as this engine does, and by
30 consecutive states of one walker with their sources of highest posterior, as the paper did.

Writes docs/tables/recipe.md from --results, which keeps what has been computed.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from engine import Analysis, Grid, Realization, engine_digest, expand, simulate_realization
from engine.estimators.draws import SourceDraw, source_draw
from engine.estimators.refit import refit_draws
from engine.estimators.summaries import summarise_all
from engine.experiment import analysis_of
from engine.likelihood.problem import prepare_problem
from engine.parametric.fit import fit_parametric
from engine.posterior.chain import run_chain
from engine.posterior.optimum import find_optimum
from engine.posterior.start import find_start, prepare_target

TABLE = Path(__file__).parent.parent / "docs" / "tables" / "recipe.md"
SYSTEMS = ("HE0435", "WFI2033")
STATES = 30
CHAIN = {"walkers": 4, "chain_length": 30.0, "max_steps": 300}
"""That of ``draft``, for all of them."""
VARIANTS: dict[str, dict[str, Any]] = {
    "this engine": {},
    "its noise inflated": {"noise_treatment": "paper_code"},
    "even pixels": {"profile": "paper"},
    "even pixels, noise inflated": {"profile": "paper", "noise_treatment": "paper_code"},
}
SUMMARIES = ("far, drawn", "consecutive, MAP")
_TOLD = ("magnitude", "r_eff", "n")


def wanted(systems: Sequence[str]) -> list[Realization]:
    """Eight runs of each system: both indices and radii, two magnitudes, the isothermal slope."""
    runs: list[list[Realization]] = []
    for system in systems:
        mine = [one.realization for one in expand(Grid(preset=f"h0licow-vi/{system}", l_eta=(1.0,)))]
        bright = sorted({one.host.magnitude for one in mine})
        runs.append([one for one in mine if one.host.magnitude in (bright[0], bright[2])])
    # By turns: whoever has no time for all has some of each.
    return [one for turn in zip(*runs, strict=True) for one in turn]


def answers(realization: Realization, variants: Sequence[str]) -> list[dict[str, Any]]:
    """One image inverted in several ways: a record each, with bias and deviation of each quantity by each summary."""
    simulation = simulate_realization(realization)
    observation, scene = simulation.observation, simulation.scene
    shear = scene.lens.gamma1 != 0.0 or scene.lens.gamma2 != 0.0
    priors = analysis_of(realization).priors
    fit = fit_parametric(observation, agn_images=len(scene.agn), deflector=True, shear=shear, priors=priors)
    truth = {name: getattr(realization.host, name) for name in _TOLD}
    records = []
    for variant in variants:
        began = time.process_time()
        analysis = Analysis(**{**VARIANTS[variant], **CHAIN, "priors": priors, "estimators": ("paper",)})
        problem = prepare_problem(observation, fit, analysis)
        target = prepare_target(problem, fit, analysis)
        rng = np.random.default_rng(realization.seed)
        laplace = find_optimum(target, *find_start(target, fit))
        chain = run_chain(
            target, laplace, walkers=analysis.walkers, max_steps=analysis.max_steps, length=analysis.chain_length,
            rng=rng,
        )  # fmt: skip
        states = {SUMMARIES[0]: chain.thinned(STATES, rng), SUMMARIES[1]: chain.samples[-STATES:, 0]}
        found = {}
        for name, some in states.items():
            draws = [source_draw(target.invert(state), target.lens(state), rng) for state in some]
            if name == SUMMARIES[1]:
                draws = [replace(draw, drawn=draw.mean) for draw in draws]
            found[name] = _estimate(draws, observation.zero_point, truth, rng)
        records.append(
            {"digest": realization.digest, "engine": engine_digest(), "variant": variant, "found": found,
             "system": realization.system_name, "steps": chain.summary.steps, "tau": chain.summary.tau,
             "cpu_s": time.process_time() - began}
        )  # fmt: skip
    return records


def _estimate(
    draws: Sequence[SourceDraw], zero_point: float, truth: dict[str, float], rng: np.random.Generator
) -> dict[str, tuple[float, float]]:
    refits = list(refit_draws(draws, ["paper"], None, rng))
    one = next(e for e in summarise_all(draws, refits, zero_point).estimates if e.index_prior == "free")
    return {name: (getattr(one, name).mean - truth[name], getattr(one, name).sd) for name in _TOLD}


def table(records: list[dict[str, Any]]) -> str:
    """The table as a page."""
    engines = ", ".join(sorted({f"`{record['engine'][:12]}`" for record in records}))
    lines = [
        "# The paper's recipe",
        "",
        "Written by `python -m benchmarks.recipe`. The same images (n 2 and 4, both radii, two magnitudes, l_eta 1.0)",
        "inverted in several ways and fitted by `paper` with n in 1-4: recovered minus true, median over the runs, and",
        "the change against the first line, mean and its error over runs of the same image. Noise inflated is",
        "`paper_code`, 7-10 times the true noise over the arc; even pixels are profile `paper`, 30 x 30 nodes and",
        "noise without correlations. All chains are `draft`'s. Errors are those that a run states, by 30 states far",
        "apart with drawn sources (this engine), and by 30 consecutive states of one walker with sources of highest",
        f"posterior (MAP, the paper). Engine {engines}.",
        "",
    ]
    for quantity, unit in zip(_TOLD, (" [mag]", " [arcsec]", ""), strict=True):
        lines += [
            f"## {quantity}{unit}",
            "",
            "| system | runs | inversion | bias | change | stated error | stated by consecutive, MAP | ratio | bias by "
            "consecutive, MAP |",
            "|---|---|---|---|---|---|---|---|---|",
        ]
        for system in SYSTEMS:
            mine = [record for record in records if record["system"] == system]
            lines += [_row(mine, system, variant, quantity) for variant in VARIANTS if _of(mine, variant)]
        lines.append("")
    return "\n".join(lines)


def _of(records: list[dict[str, Any]], variant: str) -> dict[str, dict[str, Any]]:
    return {record["digest"]: record["found"] for record in records if record["variant"] == variant}


def _row(records: list[dict[str, Any]], system: str, variant: str, quantity: str) -> str:
    mine, first = _of(records, variant), _of(records, next(iter(VARIANTS)))
    far, near = (np.array([found[name][quantity] for found in mine.values()]) for name in SUMMARIES)
    moved = np.array(
        [found[SUMMARIES[0]][quantity][0] - first[digest][SUMMARIES[0]][quantity][0] for digest, found in mine.items()
         if digest in first]
    )  # fmt: skip
    first_of_all = variant == next(iter(VARIANTS)) or moved.size < 2
    change = "" if first_of_all else f"{moved.mean():+.3f} ± {moved.std(ddof=1) / np.sqrt(moved.size):.3f}"
    return (
        f"| {system} | {len(mine)} | {variant} | {np.median(far[:, 0]):+.3f} | {change} | {np.median(far[:, 1]):.3f} | "
        f"{np.median(near[:, 1]):.3f} | {np.median(near[:, 1] / far[:, 1]):.2f} | {np.median(near[:, 0]):+.3f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--results", type=Path, default=Path("var/recipe.jsonl"))
    parser.add_argument("--variants", nargs="+", default=list(VARIANTS), choices=list(VARIANTS))
    parser.add_argument("--stored", action="store_true", help="run nothing, write what the results file has")
    given = parser.parse_args()
    given.results.parent.mkdir(parents=True, exist_ok=True)
    given.results.touch()
    records = [json.loads(line) for line in given.results.read_text().splitlines()]
    done = {(record["digest"], record["variant"]) for record in records}
    for realization in [] if given.stored else wanted(SYSTEMS):
        left = [variant for variant in given.variants if (realization.digest, variant) not in done]
        if left:
            with threadpool_limits(1):
                new = answers(realization, left)
            records += new
            with given.results.open("a") as log:
                log.writelines(json.dumps(record) + "\n" for record in new)
            print(realization.system_name, realization.host, [f"{one['cpu_s']:.0f} s" for one in new], flush=True)
    TABLE.write_text(table(records))
    print(TABLE.read_text())


if __name__ == "__main__":
    main()
