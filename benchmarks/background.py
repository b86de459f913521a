"""What a free background takes from the host: every estimator with the sky free and with the sky known.

    python -m benchmarks.background [--systems HE0435 ...] [--sd 0.001]

The same image of each system (host of 20.5 mag, R_eff 0.39 arcsec, n of 2 and 4) analysed twice, profile `draft`. The
simulation's sky is taken off exactly. The table goes to docs/tables/background.md.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from engine import Analysis, Host, Realization, run
from engine.catalogue import system_names
from engine.digest import engine_digest
from engine.result import RunResult

TABLE = Path(__file__).resolve().parent.parent / "docs" / "tables" / "background.md"
ESTIMATORS = ("paper", "covariance", "projected", "image")


def _cells(result: RunResult) -> list[str]:
    found = {(e.estimator, e.index_prior): e for e in result.estimates}
    cells = []
    for name in ESTIMATORS:
        estimate = found.get((name, "wide"))
        if estimate is None:
            cells.append("-")
            continue
        cells.append(f"{estimate.magnitude.bias:+.2f} ± {estimate.magnitude.sd:.2f}, {estimate.n.bias:+.2f}")
    return [*cells, f"{result.chi2 / result.degrees_of_freedom:.3f}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--systems", nargs="+", default=list(system_names()))
    parser.add_argument("--sd", type=float, default=1e-3)
    given = parser.parse_args()
    lines = [
        "# The background, free and known",
        "",
        "Written by `python -m benchmarks.background`: hosts of 20.5 mag, R_eff 0.39 arcsec, profile `draft`; the same",
        f"image with the background free and known to {given.sd:g} e-/s in a pixel (`background_sd`). Bias of the",
        f"magnitude with its stated deviation, bias of n; n in 0.3-8. Engine `{engine_digest()[:12]}`.",
        "",
        "| system | n | background | " + " | ".join(f"`{name}`" for name in ESTIMATORS) + " | chi2/dof |",
        "|---" * 8 + "|",
    ]
    biases: dict[tuple[str, str], list[float]] = {}
    for system in given.systems:
        for n in (2.0, 4.0):
            for label, sd in (("free", None), ("known", given.sd)):
                analysis = Analysis(profile="draft", background_sd=sd)
                host = Host(n=n, r_eff=0.39, magnitude=20.5)
                result = run(Realization(system=system, l_eta=1.0, host=host, analysis=analysis))
                lines.append(f"| {system} | {n:g} | {label} | " + " | ".join(_cells(result)) + " |")
                print(lines[-1], flush=True)
                for estimate in result.estimates:
                    if estimate.index_prior == "wide" and estimate.magnitude.bias is not None:
                        biases.setdefault((estimate.estimator, label), []).append(estimate.magnitude.bias)
    for label in ("free", "known"):
        medians = [f"{np.median(np.abs(biases[name, label])):.2f}" for name in ESTIMATORS]
        lines.append(f"| median of the absolute bias | | {label} | " + " | ".join(medians) + " | |")
    TABLE.parent.mkdir(parents=True, exist_ok=True)
    TABLE.write_text("\n".join([*lines, ""]))


if __name__ == "__main__":
    main()
