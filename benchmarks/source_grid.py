"""Residual, evidence and time against number and layout of the source pixels, for all eight systems.

    python -m benchmarks.source_grid [--systems HE0435 ...]

Each system is simulated with hosts of n = 2 and 4 and inverted at the true lens, with lambda at its optimum for the
noisy data. The residual is that of the noise-free data under the same likelihood and lambda: what no source of that
grid can describe. Its parametric fit is that of the noisy data. Independent noise everywhere, as in ``paper``.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from engine import Analysis, Host, Realization
from engine.catalogue import read_catalogue, system_names
from engine.conventions import FloatArray
from engine.errors import EngineError
from engine.imaging.drizzling import drizzle
from engine.lensing.power_law import PowerLawLens
from engine.likelihood.amplitudes import MarginalLikelihood
from engine.likelihood.evidence import invert, ln_evidence
from engine.likelihood.problem import Problem, prepare_problem
from engine.likelihood.strength import find_strength
from engine.parametric.fit import fit_parametric
from engine.simulation.simulate import Simulation, simulate_realization
from engine.source.regularisation import SourceModel

TABLE = Path(__file__).resolve().parent.parent / "docs" / "tables" / "source_grid.md"
INDICES = (2.0, 4.0)
SEED = 5


@dataclass(frozen=True)
class Layout:
    """Nodes a side, and whether the source is regularised relative to the envelope."""

    side: int
    envelope: bool = True

    @property
    def name(self) -> str:
        """As in the tables."""
        return f"{self.side} x {self.side}, {'envelope' if self.envelope else 'no envelope'}"

    @property
    def model(self) -> SourceModel:
        """The regularised source."""
        return SourceModel((self.side, self.side))


LAYOUTS = (
    *(Layout(side) for side in (15, 20, 30, 40)),
    Layout(30, envelope=False),
)


@dataclass(frozen=True)
class Point:
    """What one layout leaves of one observation."""

    rms: float
    worst: float
    ln_z: float
    effective: float
    ms: float


def cpu_ms(function: Callable[[], object], repetitions: int = 5) -> float:
    """CPU milliseconds of this thread in the fastest of several calls, after one that warms up."""
    function()
    times = []
    for _ in range(repetitions):
        began = time.thread_time()
        function()
        times.append(time.thread_time() - began)
    return 1e3 * min(times)


def with_data(likelihood: MarginalLikelihood, data: FloatArray) -> MarginalLikelihood:
    """The likelihood of other data (M,) on the same mask with the same noise."""
    white = likelihood.whitened
    d = white.noise.whiten(data)
    q, _ = np.linalg.qr(white.columns)
    projected = d - q @ (q.T @ d)
    return replace(
        likelihood,
        wd=np.asarray(likelihood.blurring.T @ white.noise.whiten_transposed(projected)),
        dd=float(projected @ projected),
        whitened=replace(white, data=d),
    )


def measure(problem: Problem, clean: FloatArray, noise: FloatArray, lens: PowerLawLens, layout: Layout) -> Point:
    """One layout: ``clean`` (ny, nx) is the image without noise, ``noise`` (ny, nx) its standard deviation."""
    likelihood, model, mask = problem.likelihood, layout.model, problem.mask
    found = find_strength(likelihood, lens, model)
    decided = invert(likelihood, lens, found.ln_lambda, model).effective_parameters()
    ln_z = ln_evidence(likelihood, lens, found.ln_lambda, model)
    bare = with_data(likelihood, clean[mask])
    inversion = invert(bare, lens, found.ln_lambda, model)
    arc = bare.blurring @ inversion.lensing.apply(inversion.source.ravel())
    image = arc + problem.amplitude_images[:, mask].T @ bare.fit_amplitudes(arc)
    residual = ((clean[mask] - image) / noise[mask])[~problem.core[mask]]
    ms = cpu_ms(lambda: ln_evidence(likelihood, lens, found.ln_lambda, model))
    rms = float(np.sqrt(np.mean(residual**2)))
    return Point(rms, float(np.abs(residual).max()), ln_z, decided, ms)


def host_of(system: str, n: float) -> Host:
    """Small radius and second brightest magnitude of the paper's grid; HE0435 at 20.5 mag, its brightest."""
    values = read_catalogue("h0licow_vi")["systems"][system]
    magnitude = values["magnitude"][0 if system == "HE0435" else 1]
    return Host(n=n, r_eff=float(values["r_eff"]["small"]), magnitude=float(magnitude))


def problems(simulation: Simulation) -> dict[bool, Problem]:
    """The linear problem with the envelope and, of the profile ``paper``, without."""
    scene, observation = simulation.scene, simulation.observation
    fit = fit_parametric(
        observation,
        agn_images=len(scene.agn),
        deflector=scene.deflector is not None,
        shear=scene.lens.gamma1 != 0.0 or scene.lens.gamma2 != 0.0,
    )
    return {
        True: prepare_problem(observation, fit, Analysis(noise_treatment="diagonal")),
        False: prepare_problem(observation, fit, Analysis(profile="paper")),
    }


def of_system(system: str, n: float) -> tuple[str, list[Point]]:
    """Heading and points of one observation, in the order of the layouts."""
    host = host_of(system, n)
    simulation = simulate_realization(Realization(system=system, l_eta=1.0, host=host, seed=SEED))
    clean = drizzle(simulation.exposures.noiseless, simulation.exposures.geometry)
    prepared = problems(simulation)
    observation, lens = simulation.observation, simulation.scene.lens
    points = [measure(prepared[each.envelope], clean, observation.noise, lens, each) for each in LAYOUTS]
    data = prepared[True].likelihood.data_points
    heading = f"{system}, n = {n:g}, {host.magnitude:g} mag, R_eff = {host.r_eff:g} arcsec, {data:,} pixels"
    return heading, points


def rows(points: list[Point]) -> list[str]:
    """The table of one observation."""
    lines = [
        "| source | residual rms | residual max | ln Z | parameters | ms |",
        "|---|---|---|---|---|---|",
    ]
    for layout, p in zip(LAYOUTS, points, strict=True):
        lines.append(
            f"| {layout.name} | {p.rms:.3f} | {p.worst:.2f} | {p.ln_z:,.1f} | {p.effective:.0f} | {p.ms:.1f} |"
        )
    return lines


def summary(found: list[list[Point]]) -> list[str]:
    """Medians and extremes over all observations."""
    lines = [
        "| source | rms: median | largest | max: median | largest | ln Z - that of 20 x 20: median | ms: median |",
        "|---|---|---|---|---|---|---|",
    ]
    reference = LAYOUTS.index(Layout(20))
    for k, layout in enumerate(LAYOUTS):
        rms, worst = np.array([[points[k].rms, points[k].worst] for points in found]).T
        gain = np.median([points[k].ln_z - points[reference].ln_z for points in found])
        ms = np.median([points[k].ms for points in found])
        lines.append(
            f"| {layout.name} | {np.median(rms):.3f} | {rms.max():.3f} | {np.median(worst):.2f} | {worst.max():.2f} | "
            f"{gain:+,.0f} | {ms:.1f} |"
        )
    return lines


HEADING = f"""# Residual, evidence and time against the source pixels

Written by `python -m benchmarks.source_grid`. Each inversion is at the true lens, lambda at its optimum for the noisy
data, seed {SEED}, l_eta = 1.0, small R_eff and the second brightest magnitude of the paper's grid (HE0435: the
brightest). All of them take the noise of the pixels as independent, as the profile `paper` does, so that they compare;
a run's default is the covariance of the drizzle. `residual` is what is left of the *noise-free* image outside the AGN
cores, in units of the noise, with the lens' AGN positions, deflector shape and envelope from the parametric fit of the
noisy image; `parameters` is tr(A^-1 F); `ms` is CPU time of one evaluation, least of five. The two layouts without
envelope are of the profile `paper`, the even one is its setting.
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--systems", nargs="+", default=list(system_names()), choices=system_names())
    systems = parser.parse_args().systems
    began, found, text, refused = time.process_time(), [], [], []
    for system, n in product(systems, INDICES):
        try:
            with threadpool_limits(1):
                heading, points = of_system(system, n)
        except EngineError as error:
            refused.append(f"Not measured: {system}, n = {n:g}: {error}")
            print(refused[-1], flush=True)
        else:
            lines = rows(points)
            print(f"\n{heading} ({time.process_time() - began:.0f} s)", *lines, sep="\n", flush=True)
            found.append(points)
            text += [f"### {heading}", "", *lines, ""]
        if found and set(systems) == set(system_names()):
            # After each, so that a run cut short leaves what it has found.
            body = [
                HEADING,
                f"## All {len(found)} observations",
                "",
                *summary(found),
                "",
                *refused,
                "## Each",
                "",
                *text,
            ]
            TABLE.write_text("\n".join(body).rstrip() + "\n", encoding="utf-8")
    if found:
        print("", *summary(found), sep="\n")


if __name__ == "__main__":
    main()
