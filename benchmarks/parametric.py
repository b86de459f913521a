"""CPU time of the parametric fit, and its answers, against those of another checkout of the engine.

    python -m benchmarks.parametric                       this one alone
    python -m benchmarks.parametric --peer FOLDER         and another checkout, in turns

Each fit is run in a process of its own, so that both see the same machine; differences are in the standard deviations
that the other one states.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

SCENES = (("HE0435", 2.0), ("HE0435", 4.0), ("HE1104", 4.0), ("RXJ1131", 2.0), ("SDSS1206", 1.0))


def measured(system: str, n: float) -> dict[str, Any]:
    """CPU seconds of the second fit of a scene, and what it found."""
    # The engine is the one that this process was pointed at.
    from engine import Host, Realization, simulate_realization
    from engine.parametric.fit import fit_parametric

    host = Host(n=n, r_eff=0.39, magnitude=20.5)
    simulation = simulate_realization(Realization(system=system, l_eta=1.0, host=host))
    scene = simulation.scene
    sheared = scene.lens.gamma1 != 0.0 or scene.lens.gamma2 != 0.0
    for _ in range(2):
        began = time.thread_time()
        fit = fit_parametric(
            simulation.observation, agn_images=len(scene.agn), deflector=scene.deflector is not None, shear=sheared
        )
        cpu = time.thread_time() - began
    wide = fit.hosts["wide"]
    return {
        "cpu": cpu,
        "chi2": fit.chi2,
        "lens": [getattr(fit.lens, name) for name in fit.lens_names],
        "lens_sd": np.sqrt(np.diag(fit.lens_covariance)).tolist(),
        "host": wide.mean.tolist(),
        "host_sd": np.sqrt(np.diag(wide.covariance)).tolist(),
    }


def of_checkout(folder: Path, system: str, n: float) -> dict[str, Any]:
    """The same by the engine of a checkout."""
    threads = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "NUMBA")}
    done = subprocess.run(
        [sys.executable, __file__, "--measure", system, str(n)],
        env={**os.environ, **threads, "PYTHONPATH": str(folder)},
        check=True,
        capture_output=True,
        text=True,
    )
    return dict(json.loads(done.stdout))


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peer", type=Path, help="a checkout of another version")
    parser.add_argument("--measure", nargs=2, help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    if given.measure:
        print(json.dumps(measured(given.measure[0], float(given.measure[1]))))
        return 0
    here = Path(__file__).resolve().parent.parent
    print("CPU seconds of a fit; differences from the peer in its standard deviations (ln flux, ln r_eff, n, ...)")
    for system, n in SCENES:
        ours = of_checkout(here, system, n)
        line = f"{system:9} n = {n:g}  {ours['cpu']:6.2f} s  chi2 {ours['chi2']:10.2f}"
        if given.peer is not None:
            peer = of_checkout(given.peer.resolve(), system, n)
            lens, host = (
                float(np.max(np.abs(np.subtract(ours[part], peer[part])) / np.array(peer[f"{part}_sd"])))
                for part in ("lens", "host")
            )
            line += f"  peer {peer['cpu']:6.2f} s, ratio {peer['cpu'] / ours['cpu']:4.1f}"
            line += f"  chi2 {ours['chi2'] - peer['chi2']:+7.2f}  lens {lens:.3f}  host {host:.3f}"
        print(line, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
