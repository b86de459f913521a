"""What is measured in images of other people: one table, with the truth where there is one.

    python -m benchmarks.outside_images --data FOLDER [--kinds slacs tdlmc] [--figures FOLDER] [--results FILE]

FOLDER has paired_lens, tdlmc, slacs, real_quasar and rxj1131 in it, each optional. Measured are all images without the
inversion; seconds are those of the processor. An image fails that ends in an error, or whose theta_E is 10 % off.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.outside import Case, cases
from engine import EngineError, ImageMeasurement, measure_image

_FAILED = 0.1
"""Relative error of theta_E of a lens that was not found."""


def measured(case: Case, figures: Path | None = None) -> dict[str, Any]:
    """What was found in an image, beside the truth."""
    record: dict[str, Any] = {"name": case.name, "kind": case.kind, "truth": case.truth}
    began = time.process_time()
    try:
        found = measure_image(case.observation, inversion=False, **case.options)
    except EngineError as error:
        return record | {"cpu_s": time.process_time() - began, "error": str(error)}
    record |= {"cpu_s": time.process_time() - began} | summary_of(found)
    if figures is not None:
        from engine.figures import measurement_figure

        figures.mkdir(parents=True, exist_ok=True)
        measurement_figure(found).savefig(figures / f"{case.kind}_{case.name}.png", dpi=90)
    return record


def summary_of(found: ImageMeasurement) -> dict[str, Any]:
    """What the tables tell of a measurement."""
    host, theta_E = found.host, found.lens["theta_E"]
    return {
        "status": found.status,
        "magnitude": [host.magnitude.mean, host.magnitude.sd, *host.magnitude.interval95],
        "radius": host.r_eff.mean,
        "n": host.n.mean,
        "theta_E": [theta_E.mean, theta_E.sd],
        "q": found.lens["q"].mean,
        "arc": found.arc_magnitude,
        "agn": len(found.agn),
        "chi2_per_dof": found.chi2_per_dof,
        "warnings": list(found.warnings),
    }


def failed(record: dict[str, Any]) -> bool:
    """Whether no lens was found, or another one."""
    if "error" in record:
        return True
    true = record["truth"].get("theta_E")
    return true is not None and abs(record["theta_E"][0] / true - 1.0) > _FAILED


def line(record: dict[str, Any]) -> str:
    """One line of the table."""
    text = f"{record['kind']:11s} {record['name']:16s} {record['cpu_s']:5.0f} s "
    if "error" in record:
        return f"{text} {record['error']}"
    truth = record["truth"]
    mean, sd, *_ = record["magnitude"]
    off = f" ({mean - truth['magnitude']:+.2f})" if "magnitude" in truth else ""
    text += f"{record['status']:15s} {record['agn']} AGN  host {mean:.2f} ± {sd:.2f}{off} R {record['radius']:.2f}"
    off = f" ({record['arc'] - truth['arc']:+.2f})" if "arc" in truth else ""
    text += f" n {record['n']:.1f}  arc {record['arc']:.2f}{off}  theta_E {record['theta_E'][0]:.3f}"
    off = f" ({100 * (record['theta_E'][0] / truth['theta_E'] - 1):+.1f} %)" if "theta_E" in truth else ""
    return f"{text}{off} q {record['q']:.2f}  chi2 {record['chi2_per_dof']:.2f}"


def summary(records: list[dict[str, Any]]) -> list[str]:
    """For each kind: medians, coverage, failures, seconds."""
    out = []
    for kind in dict.fromkeys(record["kind"] for record in records):
        chosen = [record for record in records if record["kind"] == kind]
        good = [record for record in chosen if "error" not in record]
        text = f"{kind}: {len(chosen)} images, {sum(map(failed, chosen))} failed"
        radii = [abs(r["theta_E"][0] / r["truth"]["theta_E"] - 1.0) for r in good if "theta_E" in r["truth"]]
        if radii:
            text += f"; theta_E median |off| {100 * np.median(radii):.1f} %, largest {100 * max(radii):.1f} %"
        hosts = [r for r in good if "magnitude" in r["truth"]]
        if hosts:
            off = [abs(r["magnitude"][0] - r["truth"]["magnitude"]) for r in hosts]
            inside = sum(r["magnitude"][2] <= r["truth"]["magnitude"] <= r["magnitude"][3] for r in hosts)
            text += f"; host median |off| {np.median(off):.3f} mag, {inside} of {len(hosts)} inside 95 %"
        counted = sum(r["agn"] == r["truth"]["agn"] for r in good if "agn" in r["truth"])
        text += f"; AGN images right in {counted}; median {np.median([r['cpu_s'] for r in chosen]):.0f} s"
        out.append(text)
    return out


def main(arguments: list[str] | None = None) -> int:
    """Print the table; the exit code is the number of images that failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--kinds", nargs="*", default=[])
    parser.add_argument("--figures", type=Path, help="where to draw each")
    parser.add_argument("--results", type=Path, help="where to append a line of JSON for each")
    given = parser.parse_args(arguments)
    records = []
    for case in cases(given.data, tuple(given.kinds)):
        records.append(measured(case, given.figures))
        print(line(records[-1]), flush=True)
        if given.results is not None:
            with given.results.open("a") as log:
                log.write(json.dumps(records[-1]) + "\n")
    print("\n".join(summary(records)))
    return sum(map(failed, records))


if __name__ == "__main__":
    sys.exit(main())
