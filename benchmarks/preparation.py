"""CPU time of what comes between parametric fit and chain, and its answers, against another checkout of the engine.

    python -m benchmarks.preparation                       this one alone
    python -m benchmarks.preparation --peer FOLDER         and another checkout, in turns

Of each scene the linear problem is laid out (``prepare``), ln Z evaluated for four lenses together, and the maximum of
the posterior looked for. Both checkouts get the same image and the same parametric fit, each in a process of its own;
ln Z has to be the same to 1e-9, and the maximum to a tenth of its ln.
"""

from __future__ import annotations

import argparse
import json
import os
import pickle
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

SCENES = (("HE0435", 4.0), ("HE1104", 4.0), ("HE0047", 4.0), ("RXJ1131", 2.0))
RELATIVE, OF_MAXIMUM = 1e-9, 0.1
LN_LAMBDA = -4.0


def write_scene(system: str, n: float, path: Path) -> None:
    """An image and its parametric fit, for both."""
    from engine import Host, Realization, simulate_realization
    from engine.parametric.fit import fit_parametric

    simulation = simulate_realization(Realization(system=system, l_eta=1.0, host=Host(n=n, r_eff=0.39, magnitude=20.5)))
    scene = simulation.scene
    sheared = scene.lens.gamma1 != 0.0 or scene.lens.gamma2 != 0.0
    fit = fit_parametric(
        simulation.observation, agn_images=len(scene.agn), deflector=scene.deflector is not None, shear=sheared
    )
    path.write_bytes(pickle.dumps((simulation.observation, fit)))


def measured(path: Path) -> dict[str, Any]:
    """CPU seconds and answers of a scene."""
    # The engine is the one that this process was pointed at.
    from engine import Analysis
    from engine.likelihood.evidence import ln_evidences
    from engine.likelihood.problem import prepare_problem
    from engine.posterior.optimum import find_optimum
    from engine.posterior.start import find_start, prepare_target

    observation, fit = pickle.loads(path.read_bytes())  # noqa: S301 - of our own making
    analysis, clock = Analysis(), time.thread_time
    times: dict[str, float] = {}
    for _ in range(2):
        began = clock()
        problem = prepare_problem(observation, fit, analysis)
        times["prepare"] = clock() - began
    target = prepare_target(problem, fit, analysis)
    lenses = [fit.lens.with_values(theta_E=fit.lens.theta_E * (1.0 + 1e-4 * k)) for k in range(4)]
    times["four"] = float("inf")
    for _ in range(8):
        began = clock()
        found = ln_evidences(problem.likelihood, lenses, [LN_LAMBDA] * len(lenses), target.source)
        times["four"] = min(times["four"], clock() - began)
    start = find_start(target, fit)
    before, began = target.evaluations, clock()
    optimum = find_optimum(target, *start)
    times["optimum"] = clock() - began
    evaluations = target.evaluations - before
    return {"times": times, "ln_z": found, "maximum": optimum.ln_posterior, "evaluations": evaluations}


def of_checkout(folder: Path, scene: Path) -> dict[str, Any]:
    """The same by the engine of a checkout."""
    threads = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "NUMBA")}
    done = subprocess.run(
        [sys.executable, __file__, "--measure", str(scene)],
        env={**os.environ, **threads, "PYTHONPATH": str(folder)},
        check=True,
        capture_output=True,
        text=True,
    )
    return dict(json.loads(done.stdout))


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peer", type=Path, help="a checkout of another version")
    parser.add_argument("--measure", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    if given.measure:
        print(json.dumps(measured(given.measure)))
        return 0
    here = Path(__file__).resolve().parent.parent
    print("CPU: prepare s, four evaluations ms, optimum s (evaluations); ratios are ours over the peer's")
    for system, n in SCENES:
        with tempfile.TemporaryDirectory() as folder:
            scene = Path(folder) / "scene.pickle"
            write_scene(system, n, scene)
            ours = of_checkout(here, scene)
            theirs = None if given.peer is None else of_checkout(given.peer.resolve(), scene)
        line = f"{system:9} n = {n:g} "
        for name, scale in (("prepare", 1.0), ("four", 1e3), ("optimum", 1.0)):
            line += f"  {name} {ours['times'][name] * scale:.2f}"
            if theirs is not None:
                line += f" / {theirs['times'][name] * scale:.2f} = {ours['times'][name] / theirs['times'][name]:.2f}"
        line += f" ({ours['evaluations']}"
        if theirs is not None:
            off = max(abs(a - b) / abs(b) for a, b in zip(ours["ln_z"], theirs["ln_z"], strict=True))
            higher = ours["maximum"] - theirs["maximum"]
            line += f", {theirs['evaluations']}); ln Z off by {off:.0e}, maximum by {higher:+.3f}"
            print(line, flush=True)
            assert off < RELATIVE
            assert higher > -OF_MAXIMUM
        else:
            print(line + ")", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
