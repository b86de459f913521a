"""Do the stated uncertainties cover the truth? Simulation-based calibration on 200 systems drawn from a prior.

    python -m benchmarks.coverage [--runs 200] [--profile draft] [--processes 2] [--results FILE]

HE0435's camera, exposures, deflector and AGN fluxes; lens, source position and host are drawn anew for each run, such
that the AGN has four images. For each estimator, n in 0.3-8, the place of the truth in its distribution is stored (for
those that fit drawn sources its rank among the fits, Talts et al. 2018), the share of truths within the 68 and 95 %
intervals is counted, and the places are compared with a flat histogram. The table goes to docs/tables/coverage.md.
"""

from __future__ import annotations

import argparse
import json
import math
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from engine import (
    Analysis,
    EngineError,
    Host,
    Quantity,
    Realization,
    analyse,
    compare,
    load_system,
    simulate_realization,
)
from engine.conventions import FloatArray, rate_to_magnitude
from engine.digest import engine_digest
from engine.lensing.lens_equation import solve_lens_equation
from engine.simulation.scene import power_law_lens
from engine.spec.sky import MassModel

ROOT = Path(__file__).resolve().parent.parent
TABLE = ROOT / "docs" / "tables" / "coverage.md"
RESULTS = ROOT / "var" / "coverage.jsonl"
QUANTITIES = ("magnitude", "r_eff", "n")
BINS = 10


def drawn_realization(seed: int, profile: str) -> Realization:
    """A system of the prior: uniform in everything, ln R_eff included, four AGN images."""
    rng = np.random.default_rng([20171, seed])
    base = load_system("HE0435")
    while True:
        mass = MassModel(
            theta_E=rng.uniform(1.1, 1.3),
            q=rng.uniform(0.65, 0.85),
            position_angle=rng.uniform(0.0, 180.0),
            slope=rng.uniform(1.85, 2.15),
            source_position=(rng.uniform(-0.05, 0.05), rng.uniform(-0.05, 0.05)),
        )
        images = solve_lens_equation(power_law_lens(mass), -mass.source_position[0], mass.source_position[1])
        if len(images) == 4 and min(abs(image.magnification) for image in images) > 0.5:
            break
    system = replace(base, name="DRAWN", mass_models={"recommended": {str(mass.slope - 1.0): mass}})
    host = Host(
        n=rng.uniform(1.0, 5.0),
        r_eff=math.exp(rng.uniform(math.log(0.2), math.log(0.6))),
        magnitude=rng.uniform(19.5, 22.0),
        q=rng.uniform(0.5, 0.95),
        position_angle=rng.uniform(0.0, 180.0),
    )
    analysis = Analysis(profile=profile)  # type: ignore[arg-type]  # refused by name where it is none
    return Realization(system=system, l_eta=mass.slope - 1.0, host=host, seed=seed, analysis=analysis)


def _values(fits: Any, zero_point: float) -> dict[str, FloatArray]:
    profiles = [fit.profile for fit in fits if fit is not None]
    return {
        "magnitude": np.array([rate_to_magnitude(p.flux, zero_point) for p in profiles]),
        "r_eff": np.array([p.r_eff for p in profiles]),
        "n": np.array([p.n for p in profiles]),
    }


def calibrate(seed: int, profile: str) -> dict[str, Any]:
    """One drawn system: for each quantity of each estimator mean, deviation, truth and rank."""
    realization = drawn_realization(seed, profile)
    record: dict[str, Any] = {"seed": seed, "engine": engine_digest(), "profile": profile}
    try:
        simulation = simulate_realization(realization)
        scene = simulation.scene
        rng = np.random.default_rng([20172, seed])
        found = analyse(simulation.observation, realization.analysis, rng, agn_images=len(scene.agn))
    except EngineError as error:
        return {**record, "error": str(error)}
    result = compare(found, realization, simulation)
    assert found.inversion is not None
    record["arc_magnitude"] = simulation.arc_magnitude
    record["status"] = found.inversion.chain.summary.status
    image = result.estimate("image", "wide")
    truth = {name: getattr(image, name).truth for name in QUANTITIES}
    for name in QUANTITIES:
        quantity = getattr(image, name)
        record[f"image_{name}"] = {
            "truth": truth[name], "mean": quantity.mean, "sd": quantity.sd, "place": _place(quantity), "draws": None
        }  # fmt: skip
    for refit in found.inversion.refits:
        if refit.index_prior != "wide":
            continue
        for name, values in _values(refit.fits, scene.camera.zero_point).items():
            record[f"{refit.estimator}_{name}"] = {
                "truth": truth[name],
                "mean": float(values.mean()),
                "sd": float(values.std(ddof=1)),
                "place": (float((values < truth[name]).sum()) + 0.5) / (values.size + 1.0),
                "draws": int(values.size),
            }
    record["lens"] = {p.name: [p.value.bias, p.value.sd] for p in result.lens if p.value.bias is not None}
    return record


def _place(found: Quantity) -> float:
    """Probability of less than the truth."""
    assert found.truth is not None
    if not found.log_normal:
        return float(stats.norm.cdf(found.truth, found.mean, found.sd))
    low, high = map(math.log, found.interval95)
    return float(
        stats.norm.cdf(math.log(found.truth), 0.5 * (low + high), (high - low) / (2.0 * stats.norm.ppf(0.975)))
    )


def _row(records: list[dict[str, Any]], estimator: str, quantity: str) -> str:
    found = [r[f"{estimator}_{quantity}"] for r in records if f"{estimator}_{quantity}" in r]
    draws = found[0]["draws"]
    pulls = np.array([(f["truth"] - f["mean"]) / f["sd"] for f in found])
    expected, freedom = np.full(BINS, 1.0 / BINS), math.inf
    if draws is not None:
        # Mean and deviation of 30 draws are themselves uncertain: Student's t has the intervals.
        pulls, freedom = pulls / math.sqrt(1.0 + 1.0 / draws), draws - 1
        # Ranks 0 ... draws fall unevenly into the bins.
        expected, _ = np.histogram((np.arange(draws + 1) + 0.5) / (draws + 1.0), BINS, (0.0, 1.0))
    inside = [float(np.mean(np.abs(pulls) < stats.t.ppf(0.5 + 0.5 * level, freedom))) for level in (0.68, 0.95)]
    counts, _ = np.histogram([f["place"] for f in found], bins=BINS, range=(0.0, 1.0))
    flat = stats.chisquare(counts, expected / expected.sum() * counts.sum()).pvalue
    return (
        f"| {estimator} | {quantity} | {len(found)} | {100 * inside[0]:.0f} % | {100 * inside[1]:.0f} % | {flat:.3f} | "
        f"{pulls.mean():+.2f} | {pulls.std():.2f} | {' '.join(map(str, counts))} |"
    )


def _lens_row(records: list[dict[str, Any]], name: str) -> str:
    pulls = np.array([r["lens"][name][0] / r["lens"][name][1] for r in records])
    inside = [float(np.mean(np.abs(pulls) < stats.norm.ppf(0.5 + 0.5 * level))) for level in (0.68, 0.95)]
    return (
        f"| {name} | {len(pulls)} | {100 * inside[0]:.0f} % | {100 * inside[1]:.0f} % | "
        f"{np.median(pulls):+.2f} | {1.4826 * np.median(np.abs(pulls - np.median(pulls))):.2f} |"
    )


def table(records: list[dict[str, Any]], profile: str) -> str:
    """The table as Markdown."""
    good = [r for r in records if "error" not in r]
    lines = [
        "# Coverage",
        "",
        "Written by `python -m benchmarks.coverage`: systems like HE0435 with lens, source position and host",
        f"drawn from a prior (host 19.5-22 mag, R_eff 0.2-0.6 arcsec, n 1-5), profile `{profile}`, n free in 0.3-8.",
        f"{len(good)} of {len(records)} have a result; {sum(r['status'] != 'converged' for r in good)} chains did not "
        f"converge and are counted all the same. Engine `{records[0]['engine'][:12]}`.",
        "",
        "Share of truths in the 68 and 95 % intervals; p of a flat histogram of the places of the truths in their",
        "distributions; mean and deviation of the pulls (truth minus mean in stated deviations); the histogram of",
        "places, in tenths from below all to above all.",
        "",
        "| estimator | quantity | runs | 68 % | 95 % | p(flat) | mean pull | sd of pulls | places |",
        "|---|---|---|---|---|---|---|---|---|",
        *(_row(good, e, q) for e in ("image", "projected", "covariance", "paper") for q in QUANTITIES),
        "",
        "| lens | runs | 68 % | 95 % | median pull | spread of pulls (MAD) |",
        "|---|---|---|---|---|---|",
        *(_lens_row(good, name) for name in ("theta_E", "q", "phi", "slope", "x", "y")),
        "",
    ]
    lines += [f"- seed {r['seed']}: {r['error']}" for r in records if "error" in r]
    return "\n".join([*lines, ""])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--profile", default="draft")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--table", type=Path, default=TABLE)
    given = parser.parse_args()
    given.results.parent.mkdir(parents=True, exist_ok=True)
    done: dict[int, dict[str, Any]] = {}
    if given.results.exists():
        for line in given.results.read_text().splitlines():
            record = json.loads(line)
            if record["engine"] == engine_digest() and record["profile"] == given.profile:
                done[record["seed"]] = record
    missing = [seed for seed in range(given.runs) if seed not in done]
    with ProcessPoolExecutor(given.processes) as pool, given.results.open("a") as log:
        futures = [pool.submit(calibrate, seed, given.profile) for seed in missing]
        for count, future in enumerate(as_completed(futures), 1):
            record = future.result()
            done[record["seed"]] = record
            log.write(json.dumps(record) + "\n")
            log.flush()
            print(f"{count}/{len(missing)}", flush=True)
    given.table.parent.mkdir(parents=True, exist_ok=True)
    given.table.write_text(table([done[seed] for seed in range(given.runs)], given.profile))
    print(given.table.read_text())


if __name__ == "__main__":
    main()
