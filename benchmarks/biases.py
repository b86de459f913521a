"""Bias and spread of every estimator on the paper's grid at l_eta = 1.0: 96 runs, as many at once as asked for.

    python -m benchmarks.biases [--systems HE0435 ...] [--profile draft] [--magnitudes 4] [--processes 2]

n of 2 and 4, both radii, the three brightest of the paper's four magnitudes, one seed each. Each run is appended to
the results file as it ends, and one that is there already (by the digest of its specification and of the engine) is
not repeated. The tables go to docs/tables/biases.md.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import numpy as np

from engine import Analysis, EngineError, Grid, Realization, expand, run
from engine.catalogue import load_system, system_names
from engine.digest import engine_digest
from engine.result import INDEX_RANGES

ROOT = Path(__file__).resolve().parent.parent
TABLE = ROOT / "docs" / "tables" / "biases.md"
RESULTS = ROOT / "var" / "biases.jsonl"
ESTIMATORS = ("paper", "covariance", "projected", "image")
SUMMARIES = (*((e, "wide") for e in ESTIMATORS), ("paper", "free"), ("image", "free"))
"""Estimators and priors of n that are summarised: the wide range, and for two of them the paper's own."""
BRIGHT_ARC = 20.0
"""AB magnitude of the lensed host from which on goals are set."""


def paper_runs(systems: Iterable[str], profile: str, magnitudes: int = 4) -> list[Realization]:
    """The realizations of the grid at l_eta = 1.0, with so many of the brightest hosts' magnitudes."""
    analysis = Analysis(profile=profile)  # type: ignore[arg-type]  # refused by name where it is none
    runs: list[Realization] = []
    for system in systems:
        grid = Grid(preset="h0licow-vi", systems=(system,), n=(2.0, 4.0), l_eta=(1.0,), analysis=analysis)
        mine = [one.realization for one in expand(grid)]
        bright = sorted({one.host.magnitude for one in mine})[:magnitudes]
        runs += [one for one in mine if one.host.magnitude in bright]
    return runs


def summary_of(realization: Realization) -> dict[str, Any]:
    """One run as plain numbers; a run without a result is one with an error."""
    host, began = realization.host, time.perf_counter()
    record: dict[str, Any] = {
        "digest": realization.digest,
        "engine": engine_digest(),
        "system": realization.system_name,
        "n": host.n,
        "r_eff": host.r_eff,
        "magnitude": host.magnitude,
    }
    try:
        result = run(realization)
        assert result.chain is not None
    except EngineError as error:
        return {**record, "error": str(error), "seconds": time.perf_counter() - began}
    estimates = {
        f"{found.estimator}_{found.index_prior}": {
            name: [quantity.bias, quantity.sd]
            for name, quantity in (("magnitude", found.magnitude), ("r_eff", found.r_eff), ("n", found.n))
        }
        for found in result.estimates
    }
    lens = {found.name: [found.value.bias, found.value.sd] for found in result.lens if found.value.bias is not None}
    return {
        **record,
        "estimates": estimates,
        "lens": lens,
        "arc_magnitude": result.arc_magnitude,
        "chi2_per_dof": result.chi2 / result.degrees_of_freedom,
        "status": result.chain.status,
        "tau": result.chain.tau,
        "evaluations": result.chain.evaluations,
        "seconds": time.perf_counter() - began,
        "cpu_seconds": sum(stage.cpu_s for stage in result.stages),
    }


def stored(path: Path) -> dict[tuple[str, str], dict[str, Any]]:
    """Results of earlier calls, by digest of the specification and of the engine."""
    if not path.exists():
        return {}
    records = [json.loads(line) for line in path.read_text().splitlines()]
    return {(record["digest"], record["engine"]): record for record in records}


def run_all(realizations: list[Realization], processes: int, path: Path) -> list[dict[str, Any]]:
    """All runs, those that are stored already read from the file."""
    done = stored(path)
    digest = engine_digest()
    missing = [one for one in realizations if (one.digest, digest) not in done]
    path.parent.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(processes) as pool, path.open("a") as log:
        for count, future in enumerate(as_completed([pool.submit(summary_of, one) for one in missing]), 1):
            record = future.result()
            log.write(json.dumps(record) + "\n")
            log.flush()
            done[record["digest"], digest] = record
            host = f"n {record['n']:g}, {record['r_eff']:g} arcsec, {record['magnitude']:g} mag"
            print(f"{count}/{len(missing)} {record['system']} {host}: {record['seconds']:.0f} s", flush=True)
    return [done[one.digest, digest] for one in realizations]


def _cell(pair: list[float] | None, digits: int = 2) -> str:
    return "-" if pair is None else f"{pair[0]:+.{digits}f} ± {pair[1]:.{digits}f}"


def _statistics(records: list[dict[str, Any]], estimator: str, quantity: str) -> str:
    pairs = [r["estimates"][estimator][quantity] for r in records if estimator in r.get("estimates", {})]
    if not pairs:
        return "-"
    bias, sd = np.array(pairs).T
    off = np.abs(bias)
    return (
        f"{np.median(bias):+.3f} | {np.median(off):.3f} | {off.max():.3f} | {np.median(sd):.3f} | "
        f"{np.mean(off <= sd):.2f} | {np.mean(off <= 1.96 * sd):.2f}"
    )


def table(records: list[dict[str, Any]], profile: str, wanted: int) -> str:
    """The tables as Markdown; ``wanted`` is how many runs the grid has."""
    good = [r for r in records if "error" not in r]
    images = {name: len(load_system(name).agn) for name in {r["system"] for r in records}}
    lines = [
        "# Biases on the paper's grid",
        "",
        "Written by `python -m benchmarks.biases`. Recovered minus true; ± is the standard deviation that the run",
        f"states. l_eta 1.0, profile `{profile}`, one noise realization each. n is free in 0.3-8 (`wide`), or in",
        "1-4 as in the paper (`free`), whose hosts of n = 4 lie on that bound.",
        f"{len(good)} of {len(records)} runs have a result; "
        f"{sum(r['status'] != 'converged' for r in good)} chains are shorter than was asked for; the grid has {wanted} "
        f"runs. CPU time of a run: median {np.median([r['cpu_seconds'] for r in good]):.0f} s, "
        f"longest {max(r['cpu_seconds'] for r in good):.0f} s. Engine `{records[0]['engine'][:12]}`.",
        "",
        "## Summary",
        "",
        f"Arcs brighter than {BRIGHT_ARC:g} mag in the image plane, and fainter ones. The last two columns are the "
        "share of runs whose truth lies within one and within 1.96 stated deviations.",
        "",
    ]
    for quantity, unit in (("magnitude", "mag"), ("r_eff", "arcsec"), ("n", "")):
        lines += [
            f"### {quantity}{f' [{unit}]' if unit else ''}",
            "",
            "| runs | estimator | median bias | median abs | worst abs | median sd | in 1 sd | in 1.96 sd |",
            "|---|---|---|---|---|---|---|---|",
        ]
        for name, quad in (("quads", True), ("doubles", False)):
            for bright in (True, False):
                some = [
                    r for r in good if (images[r["system"]] > 2) is quad and (r["arc_magnitude"] < BRIGHT_ARC) is bright
                ]
                label = f"{len(some)} {name}, arc {'brighter' if bright else 'fainter'}"
                if some:
                    lines += [
                        f"| {label} | {e}, n {'-'.join(f'{end:g}' for end in INDEX_RANGES[prior])} | "
                        f"{_statistics(some, f'{e}_{prior}', quantity)} |"
                        for e, prior in SUMMARIES
                    ]
        lines.append("")
    lines += ["## Runs", "", "Bias of the magnitude, and of n with `image`; n in 0.3-8.", ""]
    head = "| system | n | R_eff | mag | arc | " + " | ".join(ESTIMATORS) + " | n, `image` | slope | chi2/dof | s |"
    lines += [head, "|---" * (head.count("|") - 1) + "|"]
    for r in records:
        first = f"| {r['system']} | {r['n']:g} | {r['r_eff']:g} | {r['magnitude']:g} |"
        if "error" in r:
            lines.append(f"{first} no result: {r['error']} |" + " |" * (len(ESTIMATORS) + 4))
            continue
        found = r["estimates"]
        cells = [_cell(found.get(f"{e}_wide", {}).get("magnitude")) for e in ESTIMATORS]
        cells += [_cell(found.get("image_wide", {}).get("n")), _cell(r["lens"].get("slope"), 3)]
        state = "" if r["status"] == "converged" else " (short chain)"
        lines.append(
            f"{first} {r['arc_magnitude']:.2f} | {' | '.join(cells)} | {r['chi2_per_dof']:.2f}{state} | "
            f"{r['cpu_seconds']:.0f} |"
        )
    return "\n".join([*lines, ""])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--systems", nargs="+", default=list(system_names()))
    parser.add_argument("--profile", default="standard")
    parser.add_argument("--magnitudes", type=int, default=3)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--table", type=Path, default=TABLE)
    parser.add_argument("--stored", action="store_true", help="run nothing, show what the results file has")
    given = parser.parse_args()
    wanted = paper_runs(given.systems, given.profile, given.magnitudes)
    if given.stored:
        by_run = {digest: record for (digest, _), record in stored(given.results).items()}
        records = [by_run[one.digest] for one in wanted if one.digest in by_run]
    else:
        records = run_all(wanted, given.processes, given.results)
    given.table.parent.mkdir(parents=True, exist_ok=True)
    given.table.write_text(table(records, given.profile, len(wanted)))
    print(given.table.read_text())


if __name__ == "__main__":
    main()
