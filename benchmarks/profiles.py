"""The profiles of the analysis on the same data: distance of `draft` and `standard` from `reference`, and their cost.

    python -m benchmarks.profiles [--systems HE0435 ...]

For the lens parameters and ln lambda the largest difference of means, in standard deviations of the reference, and the
largest departure of a ratio of widths from one. The table goes to docs/tables/profiles.md.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from engine import Analysis, Host, Realization, measure, simulate_realization
from engine.catalogue import system_names
from engine.run import Measurement
from engine.spec import ProfileName

TABLE = Path(__file__).resolve().parent.parent / "docs" / "tables" / "profiles.md"
PROFILES: tuple[ProfileName, ...] = ("reference", "standard", "draft")


def quantities(found: Measurement) -> np.ndarray:
    """Means and deviations (quantities, 2) of the lens."""
    return np.array([(p.value.mean, p.value.sd) for p in found.lens])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--systems", nargs="+", default=list(system_names()))
    given = parser.parse_args()
    lines = [
        "# Profiles",
        "",
        "Written by `python -m benchmarks.profiles`: one image of each system (n = 2, 20.5 mag, R_eff 0.39 arcsec)",
        "analysed with each profile, one core. Differences are in standard deviations of `reference`, of the lens",
        "parameters and ln lambda: the largest of means, and the largest departure of a ratio of widths from one.",
        "",
        "| system | profile | CPU s | evaluations | tau | N_eff | R-hat | acceptance | means | widths | `image` mag |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for system in given.systems:
        realization = Realization(system=system, l_eta=1.0, host=Host(n=2.0, r_eff=0.39, magnitude=20.5))
        simulation = simulate_realization(realization)
        lens = simulation.scene.lens
        reference: np.ndarray | None = None
        for profile in PROFILES:
            began = time.process_time()
            with threadpool_limits(1):
                found = measure(
                    simulation.observation,
                    Analysis(profile=profile),
                    np.random.default_rng(1),
                    agn_images=len(simulation.scene.agn),
                    shear=lens.gamma1 != 0.0 or lens.gamma2 != 0.0,
                )
            seconds = time.process_time() - began
            here = quantities(found)
            reference = here if reference is None else reference
            means = float(np.abs((here[:, 0] - reference[:, 0]) / reference[:, 1]).max())
            widths = float(np.abs(here[:, 1] / reference[:, 1] - 1.0).max())
            chain = found.chain.summary
            magnitude = next(e for e in found.estimates if (e.estimator, e.index_prior) == ("image", "wide")).magnitude
            lines.append(
                f"| {system} | {profile} | {seconds:.0f} | {chain.evaluations} | {chain.tau:.1f} | "
                f"{chain.effective_samples:.0f} | {chain.r_hat:.3f} | {chain.acceptance:.2f} | {means:.2f} | "
                f"{100 * widths:.0f} % | {magnitude.mean:.3f} ± {magnitude.sd:.3f} |"
            )
            print(lines[-1], flush=True)
    TABLE.parent.mkdir(parents=True, exist_ok=True)
    TABLE.write_text("\n".join([*lines, ""]))


if __name__ == "__main__":
    main()
