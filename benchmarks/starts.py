"""How far the parametric start lands from the truth: all systems, all slopes, n of 2 and 4, bright and faint hosts.

    python -m benchmarks.starts                 the eight systems, 96 runs
    python -m benchmarks.starts HE0435 HE1104   some of them

The start is told what an observer sees: that there is an AGN, whether the deflector shines, whether the model has
shear. ``--blind`` keeps the number of AGN images and the shear from it as well. A failed start is a line of the table.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from engine import EngineError, Grid, Realization, expand, simulate_realization, system_names
from engine.conventions import rate_to_magnitude
from engine.parametric.fit import ParametricFit, fit_parametric
from engine.simulation.scene import Scene

_CLOSE = (0.02, 0.1, 0.2, 0.5)
"""What counts as close in the last line: relative theta_E, q, slope and host magnitude."""


@dataclass(frozen=True)
class Landing:
    """One fit against the truth; the errors are None where it failed."""

    realization: Realization
    seconds: float
    errors: tuple[float, float, float, float] | None
    note: str


def paper_runs(systems: list[str]) -> Iterator[Realization]:
    """Of the paper's grid the smaller r_eff, and the brightest and the faintest host."""
    for system in systems:
        runs = [run.realization for run in expand(Grid(preset=f"h0licow-vi/{system}"))]
        small = min(run.host.r_eff for run in runs)
        magnitudes = {run.host.magnitude for run in runs}
        ends = (min(magnitudes), max(magnitudes))
        yield from (run for run in runs if run.host.r_eff == small and run.host.magnitude in ends)


def errors_of(scene: Scene, fit: ParametricFit) -> tuple[float, float, float, float]:
    """Errors of theta_E (relative), q, slope and host magnitude (model minus truth)."""
    zero_point = scene.camera.zero_point
    return (
        fit.lens.theta_E / scene.lens.theta_E - 1.0,
        fit.lens.q - scene.lens.q,
        fit.lens.slope - scene.lens.slope,
        rate_to_magnitude(fit.host.flux, zero_point) - rate_to_magnitude(scene.host.flux, zero_point),
    )


def land(realization: Realization, *, blind: bool) -> Landing:
    """Simulate and fit one realization."""
    simulation = simulate_realization(realization)
    scene = simulation.scene
    told = {
        "agn_images": None if blind else len(scene.agn),
        "shear": None if blind else scene.lens.gamma1 != 0.0 or scene.lens.gamma2 != 0.0,
    }
    began = time.perf_counter()
    try:
        fit = fit_parametric(simulation.observation, deflector=scene.deflector is not None, **told)  # type: ignore[arg-type]
    except EngineError as error:
        return Landing(realization, time.perf_counter() - began, None, f"{type(error).__name__}: {error}")
    seconds = time.perf_counter() - began
    bounds = f"at bound {' '.join(fit.at_bound)}" if fit.at_bound else ""
    images = f"{len(fit.agn)} AGN " if len(fit.agn) != len(scene.agn) else ""
    note = f"chi2/dof {fit.chi2 / fit.degrees_of_freedom:.2f} {images}{bounds}"
    return Landing(realization, seconds, errors_of(scene, fit), note)


def main(arguments: list[str] | None = None) -> int:
    """Print the table; the exit code is the number of failed starts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("systems", nargs="*", metavar="SYSTEM", help=f"of {', '.join(system_names())}; all without")
    parser.add_argument("--blind", action="store_true", help="number of AGN images and shear are not told")
    options = parser.parse_args(arguments)
    print("system    l_eta n    mag   | theta_E %      q   slope   host mag |  time")
    landings = []
    for realization in paper_runs(options.systems or list(system_names())):
        landing = land(realization, blind=options.blind)
        landings.append(landing)
        host = realization.host
        line = f"{realization.system_name:9s} {realization.l_eta:4.1f} {host.n:2.0f} {host.magnitude:6.2f}   | "
        if landing.errors is None:
            line += "failed"
        else:
            theta_E, q, slope, magnitude = landing.errors
            line += f"{100 * theta_E:+8.2f} {q:+7.3f} {slope:+7.3f} {magnitude:+8.3f}  | {landing.seconds:5.1f} s"
        print(f"{line}  {landing.note}", flush=True)
    errors = np.abs([landing.errors for landing in landings if landing.errors is not None])
    failed = len(landings) - len(errors)
    if len(errors):
        medians = np.median(errors, axis=0)
        close = int((errors < np.array(_CLOSE)).all(axis=1).sum())
        print(
            f"{len(landings)} starts, {failed} failed; median error {100 * medians[0]:.2f} % in theta_E, "
            f"{medians[1]:.3f} in q, {medians[2]:.3f} in slope, {medians[3]:.3f} mag; {close} within "
            f"{100 * _CLOSE[0]:g} %, {_CLOSE[1]:g}, {_CLOSE[2]:g} and {_CLOSE[3]:g} mag; "
            f"median time {np.median([landing.seconds for landing in landings]):.1f} s"
        )
    return failed


if __name__ == "__main__":
    sys.exit(main())
