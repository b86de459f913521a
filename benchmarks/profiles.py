"""The profiles of the analysis on the same data: distance of `draft` and `standard` from `reference`, and their cost.

    python -m benchmarks.profiles [--systems HE0435 ...]

For the lens parameters and ln lambda the largest difference of means, in standard deviations of the reference, and the
largest departure of a ratio of widths from one. The table goes to docs/tables/profiles.md as each system ends; rows of
systems that are not run stay in it, each with the engine that it was made by.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from engine import Analysis, Host, Realization, Reconstruction, analyse, simulate_realization
from engine.catalogue import system_names
from engine.digest import engine_digest
from engine.spec.analysis import ProfileName

TABLE = Path(__file__).resolve().parent.parent / "docs" / "tables" / "profiles.md"
PROFILES: tuple[ProfileName, ...] = ("reference", "standard", "draft")


def quantities(found: Reconstruction) -> np.ndarray:
    """Means and deviations (quantities, 2) of the lens."""
    return np.array([(p.value.mean, p.value.sd) for p in found.lens])


HEAD = """# Profiles

Written by `python -m benchmarks.profiles`: one image of each system (n = 2, 20.5 mag, R_eff 0.39 arcsec)
analysed with each profile, one core. Differences are in standard deviations of `reference`, of the lens
parameters and ln lambda: the largest of means, and the largest departure of a ratio of widths from one.

| system | profile | engine | CPU s | evaluations | tau | N_eff | R-hat | acceptance | means | widths | `image` mag |
|---|---|---|---|---|---|---|---|---|---|---|---|
"""


def write(rows: dict[str, list[str]]) -> None:
    """The table of these systems' rows, and of those that it holds for others."""
    held: dict[str, list[str]] = {}
    for line in TABLE.read_text().splitlines() if TABLE.exists() else ():
        cells = [cell.strip() for cell in line.split("|")]
        if len(cells) > 2 and cells[2] in PROFILES:
            held.setdefault(cells[1], []).append(line)
    lines = [line for system in system_names() for line in (held | rows).get(system, [])]
    TABLE.write_text(HEAD + "\n".join([*lines, ""]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--systems", nargs="+", default=list(system_names()))
    given = parser.parse_args()
    rows: dict[str, list[str]] = {}
    for system in given.systems:
        realization = Realization(system=system, l_eta=1.0, host=Host(n=2.0, r_eff=0.39, magnitude=20.5))
        simulation = simulate_realization(realization)
        lens = simulation.scene.lens
        reference: np.ndarray | None = None
        for profile in PROFILES:
            began = time.process_time()
            found = analyse(
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
            assert found.inversion is not None
            chain = found.inversion.chain.summary
            magnitude = next(e for e in found.estimates if (e.estimator, e.index_prior) == ("image", "wide")).magnitude
            rows.setdefault(system, []).append(
                f"| {system} | {profile} | `{engine_digest()[:8]}` | {seconds:.0f} | {chain.evaluations} | "
                f"{chain.tau:.1f} | {chain.effective_samples:.0f} | {chain.r_hat:.3f} | {chain.acceptance:.2f} | "
                f"{means:.2f} | {100 * widths:.0f} % | {magnitude.mean:.3f} ± {magnitude.sd:.3f} |"
            )
            print(rows[system][-1], flush=True)
        write(rows)


if __name__ == "__main__":
    main()
