"""Does `image` hold where the PSF of the sky is not the one that the analysis is given? Fixed seeds.

    python -m benchmarks.model_errors [--runs 40] [--systems HE0435 ...] [--processes 2]

Runs of the paper's grid, the systems in turn, point and seed drawn, each with a PSF that is wrong by what HST's varies:
defocus normal with 15 nm, jitter the modulus of a normal of 4 milliarcsec, colour of the sky beside the star's normal
with 0.7, and a smooth random residual of up to 1 % of the PSF's light. Each run is appended to the results file as it
ends, and one that is there already (by the digests of specification and engine) is not repeated. The table goes to
docs/tables/model_errors.md.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from engine import Analysis, EngineError, Grid, Optics, Quantity, Realization, expand, run
from engine.catalogue import load_system, system_names
from engine.digest import engine_digest

ROOT = Path(__file__).resolve().parent.parent
TABLE = ROOT / "docs" / "tables" / "model_errors.md"
RESULTS = ROOT / "var" / "model_errors.jsonl"
QUANTITIES = ("magnitude", "r_eff", "n", "slope")
LEVELS = (0.68, 0.95)
POOR = 1.5


def drawn_realization(number: int, names: Sequence[str]) -> Realization:
    """One run of the paper's with a PSF that is wrong."""
    rng = np.random.default_rng([20173, number])
    name = names[number % len(names)]
    points = expand(Grid(preset=f"h0licow-vi/{name}", analysis=Analysis(estimators=("image",))))
    optics = Optics(
        defocus_nm=round(float(rng.normal(0.0, 15.0)), 2),
        jitter=round(float(abs(rng.normal(0.0, 0.004))), 5),
        colour=round(float(rng.normal(0.0, 0.7)), 3),
        residual=round(float(rng.uniform(0.0, 0.01)), 4),
        residual_seed=number,
    )
    return replace(points[int(rng.integers(len(points)))].realization, seed=number, optics=optics)


def judge(number: int, names: Sequence[str]) -> dict[str, Any]:
    """What one run finds: bias, deviation and whether the intervals hold the truth, of each quantity."""
    realization = drawn_realization(number, names)
    record: dict[str, Any] = {
        "number": number, "digest": realization.digest, "engine": engine_digest(), "system": realization.system_name,
        "images": len(load_system(realization.system_name).agn),
    }  # fmt: skip
    began = time.process_time()
    try:
        result = run(realization)
    except EngineError as error:
        return {**record, "error": str(error), "cpu_s": time.process_time() - began}
    record |= {"cpu_s": time.process_time() - began, "chi2": result.chi2 / result.degrees_of_freedom}
    estimate = result.estimate("image", "wide")
    (slope,) = (parameter.value for parameter in result.lens if parameter.name == "slope")
    for name in QUANTITIES:
        found: Quantity = slope if name == "slope" else getattr(estimate, name)
        assert found.bias is not None
        record[name] = [found.bias, found.sd]
    return record


def _shares(records: list[dict[str, Any]], name: str) -> str:
    pulls = np.abs([bias / sd for bias, sd in (record[name] for record in records)])
    held = [int(np.sum(pulls < stats.norm.ppf(0.5 + 0.5 * level))) for level in LEVELS]
    return " | ".join(f"{inside / len(pulls):.0%} ({inside} of {len(pulls)})" for inside in held)


def table(records: list[dict[str, Any]]) -> str:
    """The table as Markdown."""
    found = [record for record in records if "error" not in record]
    lines = [
        "# A PSF that is not the sky's",
        "",
        "Written by `python -m benchmarks.model_errors`: runs of the paper's grid with the PSF wrong by what HST's",
        "varies, analysed with the nominal one; `image` alone, n in 0.3-8.",
        f"{len(found)} of {len(records)} runs have a result, {sum(r['chi2'] > POOR for r in found)} of them a chi2 per",
        f"degree of freedom above {POOR:g}. {np.mean([r['cpu_s'] for r in records]):.0f} CPU s a run. Engine "
        f"`{records[0]['engine'][:12]}`.",
        "",
        "| lenses | quantity | runs | median abs. bias | median stated sd | inside 68 % | inside 95 % |",
        "|---|---|---|---|---|---|---|",
    ]
    kinds = (("quads", lambda r: r["images"] == 4), ("doubles", lambda r: r["images"] == 2), ("all", lambda _: True))
    for title, belongs in kinds:
        some = [record for record in found if belongs(record)]
        for name in QUANTITIES if some else ():
            bias, sd = np.abs([record[name] for record in some]).T
            middle = f"{np.median(bias):.3f} | {np.median(sd):.3f}"
            lines.append(f"| {title} | {name} | {len(some)} | {middle} | {_shares(some, name)} |")
    lines += ["", *(f"- run {r['number']}, {r['system']}: {r['error']}" for r in records if "error" in r)]
    return "\n".join([*lines, ""])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--systems", nargs="+", default=list(system_names()))
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--results", type=Path, default=RESULTS)
    given = parser.parse_args()
    given.results.parent.mkdir(parents=True, exist_ok=True)
    done: dict[int, dict[str, Any]] = {}
    for line in given.results.read_text().splitlines() if given.results.exists() else ():
        record = json.loads(line)
        if record["engine"] == engine_digest():
            done[record["number"]] = record
    wanted = {k: drawn_realization(k, given.systems).digest for k in range(given.runs)}
    done = {k: record for k, record in done.items() if wanted.get(k) == record["digest"]}
    with ProcessPoolExecutor(given.processes) as pool, given.results.open("a") as log:
        futures = [pool.submit(judge, k, given.systems) for k in wanted if k not in done]
        for count, future in enumerate(as_completed(futures), 1):
            record = future.result()
            done[record["number"]] = record
            log.write(json.dumps(record) + "\n")
            log.flush()
            print(
                f"{count}/{len(futures)} {record['system']} {record.get('error', record.get('magnitude'))}", flush=True
            )
    TABLE.write_text(table([done[k] for k in sorted(done)]))
    print(TABLE.read_text())


if __name__ == "__main__":
    main()
